"""Cross-talk: sensors that have parts of the signals of others, and what is told of which has whose."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.likelihoods.spectra.mixing import mixing_of, of_known_powers

MODELS = [
    gf.WhiteNoise(1.0) + gf.AR1(0.98, 0.02),
    gf.WhiteNoise(0.5) + gf.AR1(0.9, 0.3),
    gf.WhiteNoise(2.0) + gf.RandomWalk(1e-4),
    gf.WhiteNoise(0.7) + gf.AR1(0.5, 1.0),
]


def spectra_of(mixing: Tensor, shapes: Tensor) -> Tensor:
    """Cross-spectra `(band, sensor, sensor)` of mixed sensors with powers `(band, sensor)`."""
    mixed = torch.eye(len(mixing), dtype=torch.float64) + mixing
    return (mixed @ torch.diag_embed(shapes) @ mixed.mT).to(torch.complex128)


def sides(n: int, mixing: Tensor, seed: int) -> tuple[gf.Recording, gf.Recording]:
    """A recording with a mixing and a simulation without."""
    g = torch.Generator().manual_seed(seed)
    recording, simulation = (
        torch.stack([model.simulate(length, generator=g) for model in MODELS]) for length in (n, 4 * n)
    )
    mixed = recording + mixing @ recording
    return gf.Recording(mixed, rate=100.0, unit="deg/s"), gf.Recording(simulation, rate=100.0, unit="deg/s")


def test_a_mixing_of_unlike_spectra_is_found_as_it_is():
    g = torch.Generator().manual_seed(0)
    shapes = torch.rand(40, 4, generator=g, dtype=torch.float64) * 3 + 0.2
    mixing = torch.tensor([[0, 0.2, 0, 0], [0, 0, -0.1, 0.05], [0, 0, 0, 0], [0.1, 0, 0, 0]], dtype=torch.float64)
    dof, eye = torch.full((40,), 1e7, dtype=torch.float64), torch.eye(4, dtype=torch.complex128).expand(40, 4, 4)
    found = mixing_of(spectra_of(mixing, shapes), dof, eye)
    assert torch.allclose(found.matrix, mixing, atol=1e-4)
    assert found.gain > 1e5


def test_of_alike_spectra_only_the_sum_is_known():
    shapes = torch.ones(40, 2, dtype=torch.float64)
    mixing = torch.tensor([[0, 0.1], [0, 0]], dtype=torch.float64)
    dof, eye = torch.full((40,), 400.0, dtype=torch.float64), torch.eye(2, dtype=torch.complex128).expand(40, 2, 2)
    found = mixing_of(spectra_of(mixing, shapes), dof, eye)
    assert float(found.matrix.sum()) == pytest.approx(0.1, abs=0.005)
    assert float(found.matrix[0, 1]) == pytest.approx(float(found.matrix[1, 0]), abs=1e-3)
    for truth, value, sd in zip(mixing.flatten(), found.matrix.flatten(), found.sd.flatten(), strict=True):
        assert abs(float(truth - value)) <= 1.96 * float(sd)


def test_known_powers_tell_the_mixing_of_alike_spectra_that_rotations_hide():
    """Neighbours on one board, of white noise alike: coherences leave any rotation open, and the powers none."""
    p, n_bands = 5, 40
    shapes = torch.ones(n_bands, p, dtype=torch.float64)
    mixing = torch.diag(torch.full((p - 1,), 0.3, dtype=torch.float64), 1)
    mixing = mixing + mixing.mT
    dof, eye = torch.full((n_bands,), 1e4, dtype=torch.float64), torch.eye(p, dtype=torch.complex128).repeat(40, 1, 1)
    seen = spectra_of(mixing, shapes), dof, eye
    found = of_known_powers(mixing_of(*seen), *seen, torch.diag_embed(shapes).to(torch.complex128))
    assert torch.equal(found.free, mixing != 0)
    assert torch.allclose(found.matrix, mixing, atol=1e-3)


def test_powers_that_are_others_tell_nothing_of_a_mixing():
    """A simulation may have other levels besides: what coherences tell stays."""
    g = torch.Generator().manual_seed(2)
    shapes = torch.rand(40, 3, generator=g, dtype=torch.float64) * 3 + 0.2
    mixing = torch.tensor([[0, 0.2, 0], [0, 0, -0.1], [0, 0, 0]], dtype=torch.float64)
    dof, eye = torch.full((40,), 1e5, dtype=torch.float64), torch.eye(3, dtype=torch.complex128).expand(40, 3, 3)
    seen = spectra_of(mixing, shapes), dof, eye
    found = of_known_powers(mixing_of(*seen), *seen, torch.diag_embed(torch.ones_like(shapes)).to(torch.complex128))
    assert torch.allclose(found.matrix, mixing, atol=0.01)


def test_a_band_in_which_a_simulation_has_nothing_tells_no_mixing():
    shapes = torch.ones(40, 3, dtype=torch.float64)
    mixing = torch.tensor([[0, 0.2, 0], [0.2, 0, 0], [0, 0, 0]], dtype=torch.float64)
    dof, eye = torch.full((40,), 1e4, dtype=torch.float64), torch.eye(3, dtype=torch.complex128).repeat(40, 1, 1)
    seen = spectra_of(mixing, shapes), dof, eye
    found, nothing = mixing_of(*seen), torch.diag_embed(shapes).to(torch.complex128)
    nothing[3] = 0.0
    assert of_known_powers(found, *seen, nothing) is found


@pytest.mark.statistical
def test_pairs_that_share_a_source_each_are_two_sources():
    """Two supplies: the strongest direction of both is of neither, and no cross-talk either."""
    g = torch.Generator().manual_seed(3)
    recording, simulation = gf.WhiteNoise(1.0).simulate(2**14, batch=(2, 4), generator=g)
    source = torch.randn(2, 2**14, generator=g, dtype=torch.float64)
    report = gf.diagnose(recording + source.repeat_interleave(2, 0), simulation)
    found = sorted((finding.mechanism, finding.sensors) for finding in report.findings)
    assert found == [("common_mode", (0, 1)), ("common_mode", (2, 3))]
    assert report.unexplained == ()


def test_independent_sensors_have_none():
    shapes = torch.rand(30, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.5
    dof, eye = torch.full((30,), 50.0, dtype=torch.float64), torch.eye(3, dtype=torch.complex128).expand(30, 3, 3)
    found = mixing_of(torch.diag_embed(shapes).to(torch.complex128), dof, eye)
    assert not bool(found.free.any())
    assert found.gain == 0.0


def test_a_third_of_another_sensors_signal_is_named_and_explains_all():
    mixing = torch.zeros(4, 4, dtype=torch.float64)
    mixing[1, 0], mixing[3, 2] = 0.3, -0.15
    report = gf.diagnose(*sides(16_384, mixing, 3))
    assert [f.mechanism for f in report.findings] == ["cross_talk"]
    (finding,) = report.findings
    assert "sensor 2 has" in finding.sentence
    assert "of the signal of sensor 1" in finding.sentence
    limits = finding.parameters["part_of_1[1]"]
    assert limits.low <= 0.3 <= limits.high
    assert report.held_out.after < 1.5


@pytest.mark.statistical
def test_one_source_in_all_sensors_is_no_cross_talk():
    for seed in range(4):
        given, simulation = sides(16_384, torch.zeros(4, 4, dtype=torch.float64), seed)
        g = torch.Generator().manual_seed(100 + seed)
        gains = torch.tensor([0.3, 0.2, 0.4, 0.25], dtype=torch.float64)
        shared = torch.randn(1, 16_384, generator=g, dtype=torch.float64)
        signal = given.signal + gains[:, None] * shared
        report = gf.diagnose(gf.Recording(signal, rate=100.0, unit="deg/s"), simulation)
        assert "common_mode" in [f.mechanism for f in report.findings]
        assert "cross_talk" not in [f.mechanism for f in report.findings]
