"""Gains on fast auxiliary channels: against least squares in time, size, power, limits, and what is no such gain."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from scipy import signal, stats

import gyrofuse as gf
from gyrofuse.mismatch.detectors.slow.channels import channel_test, regress, squared
from gyrofuse.mismatch.mechanisms.signals.channel_gain import ChannelGain
from gyrofuse.mismatch.mechanisms.signals.g_sensitivity import GSensitivity
from gyrofuse.mismatch.mechanisms.signals.quadratic_coupling import QuadraticCoupling
from gyrofuse.mismatch.mechanisms.signals.scale_factor import ScaleFactor
from gyrofuse.mismatch.selection.held_out import score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo

N = 2**13
NOISE = gf.WhiteNoise(1e-4) + gf.AR1(0.99, 1e-7)  # deg/s: of a sensor that may be
LEVEL = 1e-4


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def acceleration(g: torch.Generator, n_rows: int = 3) -> torch.Tensor:
    shaking = (gf.AR1(0.9, 1e-3) + gf.WhiteNoise(1e-4)).simulate(N, batch=(n_rows,), generator=g)
    shaking[-1] += 1.0
    return shaking


def comparison(g: torch.Generator, added: torch.Tensor | float = 0.0, **channels: torch.Tensor) -> Comparison:
    x = NOISE.simulate(N, batch=(5, 4), generator=g)
    return Comparison.of(RecordingInfo(100.0, "deg/s", ("1", "2", "3", "4"), channels), x[0] + added, x[1:])


def of_size(rows: torch.Tensor, gains: torch.Tensor, nats: float) -> torch.Tensor:
    """Gains scaled until half the whitened energy of what they add is `nats`."""
    added = gains @ (rows - rows.mean(-1, keepdim=True))
    f = torch.arange(1, N // 2) / N
    energy = (torch.fft.rfft(added)[:, 1 : N // 2].abs().square() / N / NOISE.spectrum(f)).sum()
    return gains * math.sqrt(nats / float(energy))


def test_in_white_noise_it_is_least_squares():
    g = generator(1)
    x = torch.randn(2, 3, N, generator=g, dtype=torch.float64)
    rows = torch.randn(2, N, generator=g, dtype=torch.float64)
    fit = regress(Comparison.of(RecordingInfo(1.0, "x", ("1", "2", "3")), x[0], x[1:]), rows)
    rows = rows - rows.mean(-1, keepdim=True)
    least_squares = torch.linalg.lstsq(rows.mT, (x[0] - x[0].mean(-1, keepdim=True)).mT).solution.mT
    # The lowest bands are left out, and weights are estimated.
    assert ((fit.gains - least_squares).abs() < 0.3 / math.sqrt(N)).all()
    sd = fit.covariance.flatten(2).flatten(0, 1).diagonal().sqrt()
    assert ((sd * math.sqrt(N) - 1).abs() < 0.1).all()


@pytest.mark.statistical
@pytest.mark.parametrize("common", [0.0, 0.8])
def test_chance_is_not_a_gain(common):
    g, n_runs = generator(2), 60
    values, statistics = [], []
    for _ in range(n_runs):
        shared = NOISE.simulate(N, batch=(2, 1), generator=g)
        x = math.sqrt(1 - common) * NOISE.simulate(N, batch=(2, 4), generator=g) + math.sqrt(common) * shared
        rows = acceleration(g)
        fit = regress(Comparison.of(RecordingInfo(1.0, "x", ("1", "2", "3", "4")), x[0], x[1:]), rows)
        values.append(fit.p_value)
        statistics.append(fit.statistic)
    hits = sum(p < 0.05 for p in values)
    assert stats.binom.sf(hits - 1, n_runs, 0.05) > 1e-3, f"{hits} of {n_runs}"
    mean = sum(statistics) / n_runs  # chi-square with 12 degrees of freedom
    assert abs(mean - 12) < 4 * math.sqrt(24 / n_runs) + 0.4


@pytest.mark.statistical
def test_a_gain_of_thirty_nats_is_found_with_limits_that_hold():
    g, found, held, stated = generator(3), 0, 0, 0
    for _ in range(25):
        shaking = acceleration(g)
        gains = torch.randn(4, 3, generator=g, dtype=torch.float64)
        gains[2:] = 0
        gains = of_size(shaking, gains, 30.0)
        finding = GSensitivity.detect_and_fit(comparison(g, gains @ shaking, acceleration=shaking), LEVEL)
        if finding is None:
            continue
        found += 1
        assert finding.channel == "acceleration"
        for i in (0, 1):
            entry = finding.parameters.get(f"gain[{i}]")
            if entry is not None:
                assert entry.unit == "deg/s/g"
                stated += 1
                held += entry.low <= float(gains[i].norm()) <= entry.high
    assert found >= 22
    assert stats.binom.cdf(held, stated, 0.95) > 1e-3, f"{held} of {stated}"


def test_a_square_is_told_from_a_gain():
    g = generator(4)
    shaking = acceleration(g)
    rows = squared(shaking)["each"]
    gains = torch.zeros(4, 6, dtype=torch.float64)
    gains[1, 0] = 1.0
    both = comparison(g, of_size(rows, gains, 60.0) @ rows, acceleration=shaking)
    finding = QuadraticCoupling.detect_and_fit(both, LEVEL)
    assert finding.sensors == (1,)
    assert finding.parameters["gain[1]"].unit == "deg/s/g^2"
    assert GSensitivity.detect_and_fit(both, LEVEL) is None
    assert channel_test(both).p_value < LEVEL


@pytest.mark.statistical
def test_a_number_times_the_square_is_found_where_a_matrix_is_not():
    g, found, by_chance = generator(10), 0, 0
    for _ in range(15):
        shaking = acceleration(g)
        square = squared(shaking)["length"]
        gains = of_size(square, torch.tensor([[1.0], [-1.0], [1.0], [0.0]], dtype=torch.float64), 25.0)
        both = comparison(g, gains @ square, acceleration=shaking)
        assert regress(both, square).p_value < 100 * regress(both, squared(shaking)["each"]).p_value
        finding = QuadraticCoupling.detect_and_fit(both, LEVEL)
        if finding is not None:
            found += 1
            assert finding.effect.kind == "length"
            sizes = {int(name[5]): entry.value for name, entry in finding.parameters.items()}
            by_chance += sizes.pop(3, None) is not None
            assert all(value * float(gains[i]) > 0 for i, value in sizes.items())
    assert found >= 13
    assert by_chance <= 2  # of 15 with 2 % each, more have probability 3e-3


@pytest.mark.statistical
def test_the_square_of_one_axis_is_told_with_its_sign():
    """Of all products the length of a vector of gains would be told, most of it noise and without a sign."""
    g, held, told = generator(14), 0, 0
    for nats in (60.0, 100.0, 300.0, 1000.0, 3600.0):
        shaking = acceleration(g)
        square = squared(shaking)["axis 2"]
        gains = of_size(square, torch.tensor([[1.0], [-1.0], [0.0], [-1.0]], dtype=torch.float64), nats)
        finding = QuadraticCoupling.detect_and_fit(comparison(g, gains @ square, acceleration=shaking), LEVEL)
        assert finding.effect.kind == "axis 2"
        assert "axis 2 of acceleration" in finding.sentence
        assert finding.sensors == (0, 1, 3)
        for i in finding.sensors:
            entry = finding.parameters[f"gain[{i}]"]
            told += 1
            held += entry.low <= float(gains[i, 0]) <= entry.high
    assert stats.binom.cdf(held, told, 0.95) > 1e-3, f"{held} of {told}"


@pytest.mark.statistical
def test_a_slow_rate_is_judged_with_as_much_doubt_as_the_simulation_leaves():
    g, n_runs, hits, found = generator(11), 40, 0, 0
    rate = torch.sin(2 * math.pi * 5 * torch.arange(N, dtype=torch.float64) / N)[None]
    gains = of_size(rate, torch.tensor([[1.0], [0.0], [-1.0], [0.0]], dtype=torch.float64), 60.0)
    for run in range(n_runs):
        x = NOISE.simulate(N, batch=(2, 4), generator=g)
        info = RecordingInfo(100.0, "deg/s", ("1", "2", "3", "4"), {"rate": rate})
        fit = regress(Comparison.of(info, x[0], x[1:]), rate)
        hits += fit.p_value < 0.05
        if run < 10:
            found += regress(Comparison.of(info, x[0] + gains @ rate, x[1:]), rate).p_value < LEVEL
    assert stats.binom.sf(hits - 1, n_runs, 0.05) > 1e-3, f"{hits} of {n_runs}"
    assert found >= 8


def test_a_slow_rate_is_seen_where_the_simulation_is_too_short_to_say_anything():
    """By what the recording itself has beside it; a strong effect is not its own noise."""
    g = generator(15)
    rate = torch.sin(2 * math.pi * 3.3 * torch.arange(N, dtype=torch.float64) / N)[None]
    gains = of_size(rate, torch.tensor([[1.0], [0.0], [-1.0], [0.0]], dtype=torch.float64), 3e4)
    x = NOISE.simulate(N, batch=(2, 4), generator=g)
    info = RecordingInfo(100.0, "deg/s", ("1", "2", "3", "4"), {"rate": rate})
    short = Comparison.of(info, x[0] + gains @ rate, x[1:, :, : N // 8])
    finding = ScaleFactor.detect_and_fit(short, LEVEL)
    assert finding.sensors == (0, 2)
    entry = finding.parameters["error[0]"]
    assert entry.low < 1e6 * float(gains[0, 0]) < entry.high


@pytest.mark.statistical
def test_slow_noise_that_is_louder_than_the_simulation_says_is_no_gain():
    g, n_runs, hits = generator(16), 60, 0
    t = torch.arange(N, dtype=torch.float64) / N
    rate = torch.stack([torch.sin(2 * math.pi * c * t + 1) for c in (2.3, 4.4, 7.1)]).sum(0)[None]
    for _ in range(n_runs):
        x = NOISE.simulate(N, batch=(2, 4), generator=g)
        x[0] += gf.RandomWalk(1e-7).simulate(N, batch=(4,), generator=g)
        hits += (
            regress(
                Comparison.of(RecordingInfo(100.0, "deg/s", ("1", "2", "3", "4"), {"rate": rate}), x[0], x[1:]), rate
            ).p_value
            < 0.05
        )
    assert stats.binom.sf(hits - 1, n_runs, 0.05) > 1e-3, f"{hits} of {n_runs}"


def test_a_motion_that_the_simulation_has_too_is_no_gain():
    t, nominated = torch.arange(N, dtype=torch.float64), 0
    for seed in range(12, 22):
        g = generator(seed)
        shaking = 1e-4 * acceleration(g)
        shaking[0] += 0.3 * torch.sin(2 * math.pi * 0.123 * t)
        x = NOISE.simulate(N, batch=(5, 4), generator=g)
        x[0] += 0.3 * torch.sin(2 * math.pi * 0.123 * t)
        x[1:] += 0.3 * torch.sin(2 * math.pi * 0.123 * t + 1.0)
        both = Comparison.of(
            RecordingInfo(100.0, "deg/s", ("1", "2", "3", "4"), {"acceleration": shaking}), x[0], x[1:]
        )
        nominated += GSensitivity.detect_and_fit(both, 0.01) is not None
        assert channel_test(both).p_value > 1e-3
    assert nominated <= 1  # of ten, at a level of 0.01


def test_a_scale_factor_follows_the_reference():
    g = generator(5)
    rate = 30 * torch.sin(2 * math.pi * 0.002 * torch.arange(N, dtype=torch.float64))[None].cumsum(-1) / 50
    rate = rate + 5 * acceleration(g, 1)
    gains = of_size(rate, torch.tensor([[1.0], [0.0], [-1.0], [0.0]], dtype=torch.float64), 60.0)
    finding = ScaleFactor.detect_and_fit(comparison(g, gains @ rate, reference_rate=rate[0]), LEVEL)
    assert finding.sensors == (0, 2)
    assert "ppm" in finding.sentence
    entry = finding.parameters["error[2]"]
    assert entry.unit == "ppm"
    assert entry.low < -1e6 * float(gains[0, 0]) < entry.high


def test_a_delay_is_no_gain():
    g = generator(6)
    shaking = acceleration(g)
    late = torch.fft.irfft(torch.fft.rfft(shaking - shaking.mean(-1, keepdim=True)) * 1j, n=N)
    gains = of_size(late, torch.ones(4, 3, dtype=torch.float64), 200.0)
    assert GSensitivity.detect_and_fit(comparison(g, gains @ late, acceleration=shaking), LEVEL) is None


def through(mount: str, rows: torch.Tensor) -> torch.Tensor:
    """Rows through a mount: of first order, of second order that rings, or a delay of 3 samples."""
    rows = rows - rows.mean(-1, keepdim=True)
    if mount == "delay":
        return torch.nn.functional.pad(rows, (3, 0))[:, :-3]
    numerator, denominator = {
        "first": signal.butter(1, 0.1),
        "second": ([0.09], [1.0, -1.4, 0.49 + 1e-9]),
        "ringing": signal.bilinear([0.2**2], [1.0, 2 * 0.3 * 0.2, 0.2**2], 1.0),
    }[mount]
    return torch.from_numpy(signal.lfilter(numerator, denominator, rows.numpy(), axis=-1))


@pytest.mark.statistical
@pytest.mark.parametrize("mount", ["first", "second", "ringing", "delay"])
def test_what_comes_through_a_mount_is_a_gain_of_another_form(mount):
    """Named, said to be of another form, and taken off but for some per cent of its evidence."""
    g = generator(17)
    shaking = acceleration(g)
    felt = through(mount, shaking)
    gains = torch.randn(4, 3, generator=g, dtype=torch.float64)
    gains[1] = 0.0
    gains = of_size(felt, gains, 3e3)
    both = comparison(g, gains @ felt, acceleration=shaking)
    finding = GSensitivity.detect_and_fit(both, LEVEL)
    assert finding.mechanism == "g_sensitivity"
    assert finding.sensors == (0, 2, 3)
    assert "its form is not quite that of a gain" in finding.sentence
    assert " ms late near " in finding.sentence
    assert score_held_out(both, finding.effect).total > 0.92 * _energy(gains @ felt)  # which scatters by 2.6 %
    if mount in ("first", "second"):
        assert channel_test(finding.repair(both, g)).p_value > 1e-3


def _energy(added: torch.Tensor) -> float:
    f = torch.arange(1, N // 2) / N
    return float((torch.fft.rfft(added)[:, 1 : N // 2].abs().square() / N / NOISE.spectrum(f)).sum())


def test_a_plain_gain_has_no_other_form():
    for seed, nats in enumerate((100.0, 1e3, 1e4)):
        g = generator(40 + seed)
        shaking = acceleration(g)
        gains = of_size(shaking, torch.randn(4, 3, generator=g, dtype=torch.float64), nats)
        finding = GSensitivity.detect_and_fit(comparison(g, gains @ shaking, acceleration=shaking), LEVEL)
        assert "form" not in finding.sentence
        assert finding.effect.response.tolist() == [1.0]


def test_what_each_sensor_feels_in_its_own_way_is_no_gain():
    """Three modes that all feel, with gains and phases of their own: no response that sensors and axes share."""
    g = generator(18)
    modes = [
        torch.from_numpy(
            signal.lfilter([1.0], [1.0, -2 * 0.99 * math.cos(w), 0.99**2], torch.randn(N, generator=g).numpy())
        )
        for w in (0.15, 0.4, 0.9)
    ]

    def mixed(count: int) -> torch.Tensor:
        turn = torch.exp(2j * math.pi * torch.rand(count, 3, generator=g)).to(torch.complex128)
        size = 0.5 + torch.rand(count, 3, generator=g, dtype=torch.float64)
        return torch.fft.irfft((size * turn) @ torch.fft.rfft(torch.stack(modes)), n=N)

    shaking = 0.05 * mixed(3)
    shaking[-1] += 1.0
    both = comparison(g, 2e-4 * mixed(4), acceleration=shaking)
    assert channel_test(both).p_value < 1e-6
    assert GSensitivity.detect_and_fit(both, LEVEL) is None


def test_a_single_line_leaves_alternatives():
    g = generator(7)
    shaking = 1e-6 * acceleration(g)
    shaking[0] += 0.3 * torch.sin(2 * math.pi * 0.123 * torch.arange(N))
    gains = of_size(shaking, torch.tensor([[1.0, 0, 0]] * 4, dtype=torch.float64), 60.0)
    finding = GSensitivity.detect_and_fit(comparison(g, gains @ shaking, acceleration=shaking), LEVEL)
    assert finding.mechanism == "not_identifiable"
    assert {"g_sensitivity", "vibration_tone"} <= set(finding.alternatives)
    assert (
        "in one narrow band alone; g sensitivity, vibration tone and common mode explain it equally well"
        in finding.sentence
    )


def test_what_was_found_is_taken_off_and_confirmed_on_other_blocks():
    g = generator(8)
    shaking = acceleration(g)
    gains = of_size(shaking, torch.randn(4, 3, generator=g, dtype=torch.float64), 100.0)
    both = comparison(g, gains @ shaking, acceleration=shaking)
    effect = GSensitivity.detect_and_fit(both, LEVEL).effect
    assert channel_test(effect.repair(both, g)).p_value > 0.01
    assert score_held_out(both, effect).total > 50
    assert torch.equal(effect.remove(effect.apply(both.recording, both.info, g), both.info), both.recording) or (
        (effect.remove(effect.apply(both.recording, both.info, g), both.info) - both.recording).abs().max() < 1e-12
    )


def test_a_simulation_needs_the_channel_for_its_whole_length():
    g = generator(9)
    both = comparison(g, 0.0, acceleration=acceleration(g))
    with pytest.raises(ValueError, match="expected 8193 samples of 'acceleration'"):
        GSensitivity("acceleration", torch.ones(4, 3).double()).apply(torch.zeros(4, N + 1).double(), both.info, g)


@pytest.mark.statistical
@pytest.mark.parametrize("unit", ["deg/s", "rad/s", "unknown"])
@pytest.mark.parametrize(
    ("mechanism", "beyond"), [(GSensitivity, 20.0), (QuadraticCoupling, 10.0)], ids=["linear", "quadratic"]
)
def test_what_no_sensor_has_is_no_coupling(mechanism: type[ChannelGain], beyond: float, unit: str):
    """What is locked to the source of an acceleration may follow it with any gain."""
    g = generator(3)
    shaking = acceleration(g)
    rows = shaking if mechanism is GSensitivity else squared(shaking)["length"]
    per = {"deg/s": 1.0, "rad/s": math.radians(1), "unknown": 1.0}[unit]
    for factor, possible in ((0.5, True), (2.0, unit == "unknown")):
        gains = torch.zeros(4, len(rows), dtype=torch.float64)
        gains[:2, 0] = factor * beyond * per
        both = comparison(g, gains @ rows, acceleration=shaking)
        both = replace(both, info=replace(both.info, unit=unit))
        finding = mechanism.detect_and_fit(both, LEVEL)
        assert (finding.mechanism == mechanism.name) == possible
        assert ("this is no " in finding.sentence) != possible
        assert finding.sensors == (0, 1)
        assert isinstance(finding.effect, mechanism)


def test_an_axis_along_which_nothing_moves_is_no_part_of_a_gain():
    """Of its gain nothing is known but an error, which would be most of the length of all three."""
    g = generator(31)
    rate = torch.stack(
        [30 * gf.AR1(0.99, 1e-2).simulate(N, generator=g), *gf.WhiteNoise(1e-6).simulate(N, batch=(2,), generator=g)]
    )
    gains = torch.zeros(4, 3, dtype=torch.float64)
    gains[1, 0] = -0.03
    found = ScaleFactor.detect_and_fit(comparison(g, gains @ rate, angular_rate=rate), LEVEL)
    assert found is not None
    _, low, high, unit = found.parameters["error[1]"]
    assert unit == "ppm"
    assert low < -0.03e6 < high
    assert high - low < 0.002e6
