"""Lines that wander in both alike: what powers, sizes of lines, sweeps and clocks know of chance."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import signal
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.detectors.tests import run_tests
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.signals.known_lines import line_wander, wandering
from gyrofuse.mismatch.signals.psd import bands, steady_shares
from gyrofuse.mismatch.signals.records import Records

N, RATE = 12_000, 200.0


def wandering_tone(seed: int, n: int, frequency: float, sd: float, tau: float) -> np.ndarray:
    """A tone of amplitude one whose frequency, Hz, is an AR1 of so many seconds about another."""
    rng, phi = np.random.default_rng(seed), math.exp(-1 / (tau * RATE))
    steps = rng.standard_normal(n + int(5 * tau * RATE))
    f = frequency + sd * signal.lfilter([math.sqrt(1 - phi**2)], [1, -phi], steps)[-n:]
    return np.cos(2 * math.pi * (np.cumsum(f) / RATE + rng.uniform()))


def scene(seed: int, n: int = N) -> Tensor:
    """White noise with two such tones, that all sensors have with factors of their own."""
    noise = np.random.default_rng(seed + 1000).standard_normal((3, n))
    near = np.array([[5.0], [-3.0], [1.0]]) * wandering_tone(seed, n, 27.0, 0.7, 1.2)
    far = np.array([[0.4], [0.8], [-1.5]]) * wandering_tone(seed + 500, n, 60.0, 3.0, 1.5)
    return torch.from_numpy(noise + near + far)


def test_a_band_through_which_a_line_wanders_is_known_from_fewer_ordinates() -> None:
    own = bands(N)
    share = Records(scene(1)[None], own).steady_shares(own)
    at = [int((own.frequency - f / RATE).abs().argmin()) for f in (27.0, 60.0)]
    assert float(share[at].max()) < 0.3


def test_of_noise_that_is_alike_at_all_times_all_ordinates_count() -> None:
    g = torch.Generator().manual_seed(3)
    shares = torch.stack(
        [steady_shares(torch.randn(1, 3, 8192, generator=g, dtype=torch.float64), bands(8192)) for _ in range(40)]
    )
    assert float((shares < 1).to(torch.float64).mean()) < 0.01  # one in a thousand by chance, of several sensors


def test_power_that_varies_in_all_bands_is_a_matter_of_its_level() -> None:
    level = torch.sin(2 * math.pi * 3 * torch.arange(N, dtype=torch.float64) / N).exp()
    white = torch.randn(1, 2, N, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    assert float((steady_shares(level * white, bands(N)) < 1).to(torch.float64).mean()) < 0.05


def test_a_line_that_stands_still_does_not_wander_and_its_amplitude_is_known() -> None:
    g, n = torch.Generator().manual_seed(7), N
    white = torch.randn(2, 1, n, generator=g, dtype=torch.float64)
    tone = 0.5 * torch.cos(2 * math.pi * 0.2137 * torch.arange(n, dtype=torch.float64))
    moving = torch.from_numpy(wandering_tone(4, n, 20.0, 0.05, 2.0))
    one = torch.ones(1, 1, dtype=torch.float64)
    assert wandering(white + tone, (0.2137,), one) == ()
    assert wandering(white + moving, (0.1,), one) == (0.1,)
    assert float(line_wander(white + moving, (0.1,), one).sqrt()) > 0.05


def test_records_of_a_gaussian_model_have_none() -> None:
    side = Records(scene(2)[None], bands(N), gaussian=True)
    assert bool((side.steady_shares(bands(N)) == 1).all())


@pytest.mark.parametrize("seed", [11, 12, 13, 14])
def test_what_wanders_alike_in_both_is_no_difference(seed: int) -> None:
    """But for the level: that of whitened noise goes up and down where a line is most of it."""
    recording, simulation = (gf.Recording(x, rate=RATE) for x in (scene(seed), scene(seed + 50, N // 2)))
    start = prepared(recording, simulation, None, torch.Generator().manual_seed(0))
    assert min(result.p_value for result in run_tests(start) if result.test != "variance") > 1e-4


def test_what_differs_beside_them_is_named() -> None:
    t = torch.arange(N, dtype=torch.float64) / RATE
    recording = scene(21) + torch.tensor([[0.0], [0.3], [0.0]]) * torch.cos(2 * math.pi * 83.3 * t)
    report = gf.diagnose(gf.Recording(recording, rate=RATE), gf.Recording(scene(71), rate=RATE))
    assert [f.mechanism for f in report.findings] == ["vibration_tone"]
    assert report.findings[0].parameters["frequency"].value == pytest.approx(83.3, abs=0.01)
    assert report.findings[0].sensors == (1,)


def test_noise_without_a_part_in_common_can_be_told_apart() -> None:
    """White noise beside a walk: of two sensors that share no part nothing is asked for."""
    g = torch.Generator().manual_seed(1)

    def pair() -> Tensor:
        white = torch.randn(2, N, generator=g, dtype=torch.float64)
        return torch.stack([1e-3 * white[0], white[1].cumsum(-1)])

    report = gf.diagnose(gf.Recording(pair(), rate=RATE), gf.Recording(pair(), rate=RATE))
    assert report.findings == ()
