"""Simulations that are models fitted to another record: their sampling error is no physics, what exceeds it is."""

from __future__ import annotations

import functools
import json
import math
from dataclasses import replace

import pytest
import torch

import gyrofuse as gf
from gyrofuse.mismatch.detectors.lines.line_sizes import line_sizes
from gyrofuse.mismatch.detectors.spectra.band_tests import coherence_test, spectrum_test
from gyrofuse.mismatch.detectors.spectra.fit_verdict import fit_verdict
from gyrofuse.mismatch.detectors.spectra.pooled_coherence import common_source_test
from gyrofuse.mismatch.detectors.spectra.shape_scan import fitted_scans, shape_test
from gyrofuse.mismatch.detectors.variance.noise_level import compared_levels
from gyrofuse.mismatch.likelihoods.slow_noise import simulated_slow_noise
from gyrofuse.mismatch.repair.inputs import modelled, prepared
from gyrofuse.mismatch.signals.fitted_spectra import SpectralUncertainty, as_array
from gyrofuse.noise.estimation import EstimatedFrom

TRUE = gf.parse_model("WN(variance=1.0) + AR1(phi=0.975, variance=0.03) + RW(variance=1e-5)")
WALKING = gf.parse_model("WN(variance=1.0) + RW(variance=1e-5)")
FORMULA = "WN + AR1 + RW"
SHORT, LONG = 4099, 16411
LEVEL = 1e-3
N_RUNS = 8


def record(n, seed, n_sensors=1):
    return TRUE.simulate(n, batch=(n_sensors,), generator=torch.Generator().manual_seed(seed))


@functools.cache
def fitted(seed=0, n=SHORT, n_sensors=1):
    return gf.fit_gmwm(record(n, 1000 + seed, n_sensors), FORMULA)


def comparison(recording, simulation, fitted_samples=None):
    return prepared(recording, modelled(simulation, recording, fitted_samples), None, torch.Generator().manual_seed(0))


@functools.cache
def against_another(seed):
    """A recording and a model fitted to another, shorter one."""
    return comparison(record(LONG, seed), fitted(seed))


def as_if_known(given):
    return replace(given, reference=replace(given.reference, uncertainty=None))


def at_most(n, p, chance=1e-3):
    """Successes of n with probability p that are exceeded with no more than a chance."""
    total = 0.0
    for k in range(n + 1):
        total += math.comb(n, k) * p**k * (1 - p) ** (n - k)
        if total >= 1 - chance:
            return k
    return n


# how far spectra may be off


@pytest.mark.statistical
def test_log_spectra_of_fits_scatter_by_what_is_said():
    # Of 120 records variances are known to 13 %.
    many = gf.fit_gmwm(record(2 * SHORT, 5, 120), FORMULA)
    f = torch.tensor([2e-3, 0.02, 0.1, 0.4], dtype=torch.float64)
    seen = many.model.spectrum(f).log().var(0)
    said = SpectralUncertainty.of(as_array(gf.Model([TRUE], estimated_from=EstimatedFrom(2 * SHORT)), 1)).variance(f)[0]
    rows = many.model.spectrum_jacobian(f) / many.model.spectrum(f)[..., None]
    own = torch.einsum("sfp,spq,sfq->sf", rows, many.param_cov, rows).median(0).values
    assert ((seen / own).log().abs() < 0.45).all()
    assert ((seen / said).log().abs() < 0.45).all()


def test_white_noise_is_known_as_well_as_its_samples_say():
    white = gf.Model([gf.WhiteNoise(3.0)], estimated_from=EstimatedFrom(1000))
    assert SpectralUncertainty.of(as_array(white, 1)).variance(torch.tensor([0.1]).double()).item() == pytest.approx(
        2 / 1000, rel=0.01
    )
    root = torch.tensor([[1.0, 0.0], [0.5, 1.0]]).double()
    both = gf.ArrayModel([(gf.WhiteNoise(1.0), root @ root.mT)], estimated_from=EstimatedFrom(1000))
    # Covariances of sample covariances, (a_ik a_jl + a_il a_jk) / n.
    r, a = root @ root.mT, torch.triu_indices(2, 2).mT.tolist()
    expected = [[(r[i, k] * r[j, m] + r[i, m] * r[j, k]) / 1000 for k, m in a] for i, j in a]
    torch.testing.assert_close(
        SpectralUncertainty.of(both).covariance, torch.tensor(expected).double(), rtol=0.01, atol=1e-9
    )


def test_a_variance_at_zero_and_what_a_fit_does_not_tell_have_the_spread_of_the_information():
    spread = torch.diag(torch.tensor([1e-4, 1e-6, 1e-5, 0.0]).double())
    flat = TRUE.params * torch.tensor([1.0, 1.0, 1.0, 0.0])
    found = SpectralUncertainty.of(as_array(TRUE.with_params(flat, estimated_from=EstimatedFrom(SHORT, spread)), 1))
    told_by_samples = SpectralUncertainty.of(as_array(TRUE.with_params(flat, estimated_from=EstimatedFrom(SHORT)), 1))
    assert found.at_zero.tolist() == [False, False, False, True]
    torch.testing.assert_close(found.covariance.diagonal()[:3], spread.diagonal()[:3])
    assert found.covariance[3, 3] == told_by_samples.covariance[3, 3] > 0
    assert float(found.at_zero_power(torch.tensor([1.0 / SHORT]).double())) > 0.1
    lost = spread.clone()
    lost[1] = lost[:, 1] = torch.nan
    other = SpectralUncertainty.of(
        as_array(TRUE.with_params(TRUE.params, estimated_from=EstimatedFrom(SHORT, lost)), 1)
    )
    assert other.covariance.isfinite().all()
    assert other.covariance[0, 0] == spread[0, 0]
    assert other.covariance[1, 1] > 0


def test_one_estimate_for_all_sensors_is_off_alike_and_one_for_each_is_not():
    f = torch.tensor([0.01, 0.3]).double()
    shared = gf.Model([TRUE], estimated_from=EstimatedFrom(SHORT))
    one = SpectralUncertainty.of(as_array(shared, 2)).errors(f)
    each = TRUE.params.repeat(2, 1)
    two = SpectralUncertainty.of(as_array(TRUE.with_params(each, estimated_from=EstimatedFrom(SHORT)), 2)).errors(f)
    for errors, together in ((one, 1.0), (two, 0.0)):
        variance, across = errors.square().sum(-1), (errors[0] * errors[1]).sum(-1)
        torch.testing.assert_close(across, together * variance[0], rtol=1e-6, atol=1e-12)
    torch.testing.assert_close(one.square().sum(-1), two.square().sum(-1), rtol=1e-6, atol=0)


@pytest.mark.statistical
def test_the_parameters_chi_square_has_the_law_of_chance():
    p = [fitted_scans(against_another(s)).parameters for s in range(N_RUNS)]
    assert 0.15 < sum(p) / len(p) < 0.85
    assert sum(x < 0.05 for x in p) <= at_most(len(p), 0.05)


# alarms


def test_a_model_fitted_to_a_shorter_record_raises_no_alarm_by_its_spectra():
    comparisons = [against_another(s) for s in range(N_RUNS)]
    exact = [fitted_scans(given).exact.p_value for given in comparisons]
    seen = [shape_test(given).p_value for given in comparisons]
    bands = [spectrum_test(given).p_value for given in comparisons]
    assert sum(p < 0.01 for p in exact) > at_most(N_RUNS, 0.01)  # what it would be taken for, were its numbers exact
    assert sum(p < 0.01 for p in seen) <= at_most(N_RUNS, 0.01)
    assert sum(p < 0.01 for p in bands) <= at_most(N_RUNS, 0.01)


@pytest.mark.statistical
def test_a_model_says_nothing_of_what_is_slower_than_the_record_it_was_fitted_to():
    """There a walk that it hardly shows, and that is fitted too large by chance, would stand over everything else."""
    slow = gf.parse_model("WN(variance=1.0) + AR1(phi=0.9995, variance=4e-7) + RW(variance=2e-7)")
    g, p_values = torch.Generator().manual_seed(7), []
    for _ in range(2):
        earlier, recording = slow.simulate(2048, batch=(8,), generator=g), slow.simulate(8192, batch=(8,), generator=g)
        given = comparison(recording, gf.fit_array_gmwm(earlier, FORMULA).model)
        assert (given.reference.power_dof[:, given.bands.frequency < 1 / 2048] == 0).all()
        p_values.append(shape_test(given).p_value)
    assert min(p_values) > LEVEL


def test_a_model_fitted_to_the_recording_itself_is_held_against_no_more():
    for s in range(2):
        x = record(2 * SHORT, 50 + s)
        given = comparison(x, gf.fit_gmwm(x, FORMULA))
        assert shape_test(given).p_value > 0.05
        assert spectrum_test(given).p_value > spectrum_test(as_if_known(given)).p_value * 0.999


def test_power_that_a_fit_hardly_tells_may_be_missing():
    # An AR1 at half the rate, as fits have where nothing tells of one: the recording has a tenth of the power there.
    model = gf.parse_model("WN(variance=1.0) + AR1(phi=-0.995, variance=1e-3)")
    cov = torch.diag(torch.tensor([1e-2, 1e4, 1e2], dtype=torch.float64))
    recording = gf.parse_model("WN(variance=1.0)").simulate(
        LONG, batch=(2,), generator=torch.Generator().manual_seed(3)
    )
    unsure = comparison(recording, gf.Model([model], estimated_from=EstimatedFrom(LONG, cov)))
    assert spectrum_test(unsure).p_value > 0.01
    assert spectrum_test(as_if_known(unsure)).p_value < 1e-6


def test_the_level_of_a_model_is_known_as_well_as_from_the_record_it_was_fitted_to():
    recording = record(LONG, 7, 2)
    given = comparison(recording, WALKING.with_params(WALKING.params * 1.0), SHORT)
    assert compared_levels(given).reference.n_samples == SHORT
    assert compared_levels(comparison(recording, WALKING)).reference.n_samples == LONG * len(given.reference.signal)


def test_what_an_array_was_found_to_share_is_as_uncertain_as_its_fit():
    root = torch.linalg.cholesky(0.5 * torch.eye(3).double() + 0.5)
    exact, seen = [], []
    for s in range(3):
        fit = gf.fit_array_gmwm(
            root @ WALKING.simulate(SHORT, batch=(3,), generator=torch.Generator().manual_seed(300 + s)), "WN + RW"
        )
        given = comparison(
            root @ WALKING.simulate(LONG, batch=(3,), generator=torch.Generator().manual_seed(400 + s)), fit
        )
        exact.append(common_source_test(as_if_known(given)).p_value)
        seen += [common_source_test(given).p_value, coherence_test(given).p_value]
    assert min(exact) < 1e-4  # where the walks' matrix has one direction, found in a quarter of the record
    assert sum(p < 0.01 for p in seen) <= at_most(6, 0.01)


def test_slow_noise_is_as_uncertain_as_the_fit():
    given = comparison(record(LONG, 1), fitted(0))
    known, off = simulated_slow_noise(as_if_known(given)), simulated_slow_noise(given)
    assert off.spread[1] > known.spread[1]
    flat = TRUE.params * torch.tensor([1.0, 1.0, 1.0, 0.0])
    walkless = comparison(record(LONG, 1), TRUE.with_params(flat, estimated_from=EstimatedFrom(SHORT)))
    assert simulated_slow_noise(walkless).centre[-1] > simulated_slow_noise(as_if_known(walkless)).centre[-1] + 0.5


# verdicts


def louder(x, factor):
    """With more white noise."""
    return x + math.sqrt(factor - 1) * torch.randn(x.shape, generator=torch.Generator().manual_seed(9)).double()


def with_bump(x, size):
    """With a bump around a twentieth of a cycle per sample."""
    f = torch.fft.rfftfreq(x.shape[-1]).double()
    shape = size * torch.exp(-((f.clamp(min=1e-9) / 0.05).log() / 0.15).square())
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(9)).double()
    return x + torch.fft.irfft(torch.fft.rfft(noise) * shape.sqrt(), n=x.shape[-1])


def test_a_missing_component_other_numbers_and_the_uncertainty_of_a_fit_are_told_apart():
    fit = fitted(3)
    assert fit_verdict(comparison(with_bump(record(LONG, 3), 1.5), fit), LEVEL).kind == "component_missing"
    other = fit_verdict(comparison(louder(record(LONG, 3), 1.25), fit), LEVEL)
    assert other.kind == "other_numbers"
    assert "other numbers of the same processes" in other.words
    within = [fit_verdict(against_another(s), LEVEL) for s in range(6)]
    assert {v.kind for v in within} <= {"agrees", "within_uncertainty"}
    assert "within_uncertainty" in {v.kind for v in within}
    assert all(v.n_samples == SHORT for v in within)
    assert fit_verdict(comparison(record(LONG, 3), TRUE), LEVEL) is None


def test_a_diagnosis_says_what_the_numbers_of_a_simulation_are_taken_for():
    fit = fitted(0, n=SHORT + 1)
    report = gf.diagnose(record(SHORT, 1), fit)
    assert not report.mismatch
    assert report.fit is not None
    assert report.notes == (report.fit.words,)
    assert f"fitted to {SHORT + 1} samples" in str(report)
    plain = report.to_dict()
    assert plain["fit"]["verdict"] in ("agrees", "within_uncertainty")
    assert plain["fit"]["n_samples"] == SHORT + 1
    # The noise of the repaired simulation goes on to know where it is from.
    again = gf.model_from_dict(json.loads(json.dumps(plain["model"]["noise"])))
    assert again.estimated_from.n_samples == SHORT + 1
    torch.testing.assert_close(
        SpectralUncertainty.of(again).covariance, SpectralUncertainty.of(as_array(fit.model, 1)).covariance
    )


# what counts as a fit


def test_fits_of_all_kinds_stand_for_their_models():
    x, y = record(SHORT, 7, 2), record(SHORT, 8, 2)
    fits = (
        gf.fit_gmwm(y, FORMULA),
        gf.fit_array_gmwm(y, "WN + RW"),
        gf.fit_gmwm_joint([y, record(SHORT, 9, 2)], "WN + AR1"),
        gf.rank_models(y, ["WN + AR1"]),
    )
    for fit, n in zip(fits, (SHORT, SHORT, 2 * SHORT, SHORT), strict=True):
        given = comparison(x, fit)
        assert given.reference.uncertainty.n_samples == n
        assert given.reference.in_bands(narrow_of(given)).uncertainty is given.reference.uncertainty
    assert comparison(x, y).reference.uncertainty is None
    assert comparison(x, TRUE).reference.uncertainty is None


def narrow_of(given):
    return given.reference.bands


def test_samples_behind_a_model_that_does_not_know_them_can_be_told():
    x, f = record(SHORT, 7), torch.tensor([0.4]).double()
    effective_samples = [float(comparison(x, TRUE, n).reference.uncertainty.variance(f)) for n in (1000, 4000)]
    assert effective_samples[0] / effective_samples[1] == pytest.approx(4, rel=0.05)
    assert comparison(x, gf.ArrayModel.from_sensors([TRUE]), 1000).reference.uncertainty.n_samples == 1000
    with pytest.raises(ValueError, match=r"`fitted_samples`: expected with a noise model .* one that has its own"):
        comparison(x, fitted(), 1000)
    with pytest.raises(ValueError, match=r"`fitted_samples`: expected with a noise model .* Tensor; leave it out"):
        comparison(x, x, 1000)
    with pytest.raises(ValueError, match="`fitted_samples`"):
        comparison(x, TRUE, 0)
    with pytest.raises(ValueError, match="`simulation`: expected a ranking with the fit of every sensor"):
        comparison(x, gf.rank_models(x, ["WN"], fit=False))


def test_tones_of_a_fitted_model_are_as_uncertain_as_the_record():
    model = gf.WhiteNoise(1.0) + gf.Sinusoid(0.5, 0.9)
    x = model.simulate(4 * SHORT, batch=(1,), generator=torch.Generator().manual_seed(0))
    known, off = line_sizes(comparison(x, model)), line_sizes(comparison(x, model, SHORT))
    assert float(off.simulated_sd[0, 0]) == pytest.approx(math.sqrt(2 / SHORT), rel=0.1)
    assert off.simulated_sd[0, 0] > 1.5 * known.simulated_sd[0, 0]


def test_a_model_file_and_the_command_line_say_what_a_model_was_fitted_to(run, tmp_path):
    for name, seed in (("log.npz", 1), ("other.npz", 2)):
        gf.Recording(record(SHORT, seed), rate=50.0, unit="deg/s", sensors=("1",)).save(tmp_path / name)
    assert run("fit", "other.npz", "--model", "WN + AR1", "--model-out", "model.json").status == 0
    description = json.loads((tmp_path / "model.json").read_text())
    assert description["estimated_from"]["n_samples"] == SHORT
    done = run("diagnose", "log.npz", "--simulation", "model.json")
    assert done.status == 0
    assert f"The model was fitted to {SHORT} samples" in done.out
    (tmp_path / "old.json").write_text(json.dumps({k: v for k, v in description.items() if k != "estimated_from"}))
    refused = run("diagnose", "log.npz", "--simulation", "model.json", "--fitted-samples", "100")
    assert refused.status == 2
    assert "`--fitted-samples`: expected with a noise model" in refused.err
    told_by_hand = run("diagnose", "log.npz", "--simulation", "old.json", "--fitted-samples", "5000")
    assert told_by_hand.status == 0
    assert "The model was fitted to 5000 samples" in told_by_hand.out


def test_a_model_of_one_sensor_simulates_each_of_an_array():
    """A fit of one row has its numbers for all, with their uncertainty."""
    model = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-6)
    x = model.simulate(8192, batch=(3,), generator=torch.Generator().manual_seed(1))
    fit = gf.fit_gmwm(gf.Recording(x[:1], rate=100.0, unit="deg/s"), "WN + RW")
    for simulation in (fit, fit.model):
        report = gf.diagnose(gf.Recording(x, rate=100.0, unit="deg/s"), simulation)
        assert not report.mismatch
        assert "8192 samples" in str(report)
