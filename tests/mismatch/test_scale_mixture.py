"""Noise of two levels, sample by sample: found, named, repaired, told from episodes and from isolated outliers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import signal as dsp
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch.likelihoods.laws.two_levels import TwoLevels
from gyrofuse.mismatch.mechanisms.regimes.scale_mixture import ScaleMixture
from gyrofuse.mismatch.signals.prediction_errors import scaled_innovations

N = 16384
NOISE = gf.ArrayModel.from_sensors([gf.WhiteNoise(1.0) + gf.AR1(0.99, 1e-5) for _ in range(2)])


def mixed(seed: int, share: float, ratio: float, n: int = N) -> Tensor:
    """White noise of variance one, of two levels in the first sensor, on a slow AR1."""
    g = torch.Generator().manual_seed(seed)
    white = torch.randn(2, n, generator=g, dtype=torch.float64)
    loud = torch.rand(n, generator=g, dtype=torch.float64) < share
    white[0] *= torch.where(loud, ratio, 1.0) / math.sqrt(1 - share + share * ratio**2)
    steps = math.sqrt(1e-5) * torch.randn(2, n + 2000, generator=g, dtype=torch.float64)
    return white + torch.from_numpy(dsp.lfilter([1.0], [1.0, -0.99], steps.numpy())[:, 2000:].copy())


@pytest.mark.slow
@pytest.mark.parametrize(("share", "ratio"), [(0.2, 3.0), (0.5, 6.0)])
def test_two_levels_are_named_with_their_numbers(share: float, ratio: float):
    report = gf.diagnose(mixed(1, share, ratio), NOISE, rate=100.0)
    assert [finding.mechanism for finding in report.findings] == ["scale_mixture"]
    found = report.findings[0]
    assert found.sensors == (0,)
    for name, true in (("share[0]", 100 * share), ("ratio[0]", ratio)):
        entry = found.parameters[name]
        assert entry.low < true < entry.high
        assert entry.high - entry.low < 0.4 * true
    assert found.held_out_gain is not None
    assert found.held_out_gain > 100
    assert report.unexplained == ()
    assert report.held_out.after < 1.5


def test_the_repaired_simulation_has_tails_and_spectrum():
    effect = ScaleMixture(torch.tensor([0.2, 0.0]), torch.tensor([5.0, 1.0]))
    clean = NOISE.simulate(2**17, generator=torch.Generator().manual_seed(2))
    made = effect.apply(clean, None, torch.Generator().manual_seed(3))  # type: ignore[arg-type]  # it asks for nothing
    assert torch.equal(made[1], clean[1])
    frequency = dsp.welch(clean[0].numpy(), nperseg=256)[0]
    powers = [dsp.welch(x[0].numpy(), nperseg=256)[1] for x in (clean, made)]
    assert np.abs(np.log(powers[1] / powers[0]))[frequency > 0.01].max() < 0.25
    kurtosis = [float(x[0].diff().pow(4).mean() / x[0].diff().square().mean() ** 2) for x in (clean, made)]
    assert kurtosis[0] == pytest.approx(3.0, abs=0.1)
    assert kurtosis[1] > 6
    # Of mean square one: `E s^4 = (1 - q + q r^4) / (1 - q + q r^2)^2` times the kurtosis of normal values.
    expected = 3 * (0.8 + 0.2 * 5**4) / (0.8 + 0.2 * 25) ** 2
    white = torch.randn(1, 2**16, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    alone = replace_first(effect).apply(white, None, torch.Generator().manual_seed(5))  # type: ignore[arg-type]
    assert float(alone.pow(4).mean() / alone.square().mean() ** 2) == pytest.approx(expected, rel=0.1)


def replace_first(effect: ScaleMixture) -> ScaleMixture:
    return ScaleMixture(effect.share[:1], effect.ratio[:1])


def test_innovations_scaled_by_one_leave_a_record_as_it_is():
    signal = NOISE.simulate(1000, batch=(3,), generator=torch.Generator().manual_seed(6))
    torch.testing.assert_close(scaled_innovations(signal, torch.ones_like(signal)), signal)
    short = signal[..., :50]
    torch.testing.assert_close(scaled_innovations(short, torch.ones_like(short)), short)


def test_the_law_is_the_likeliest():
    """Beside a grid of laws around it."""
    z = mixed(7, 0.3, 4.0)[0]
    z = z / z.std()
    law = TwoLevels.fitted(z)
    best = float(torch.logaddexp(*law.log_densities(z)).sum())
    for share in (0.95, 1.0, 1.05):
        for small in (0.97, 1.0, 1.03):
            for large in (0.97, 1.0, 1.03):
                other = TwoLevels(law.share * share, law.small * small, law.large * large)
                assert float(torch.logaddexp(*other.log_densities(z)).sum()) <= best + 1e-6


@pytest.mark.slow
def test_episodes_and_gaussian_noise_are_none():
    g = torch.Generator().manual_seed(8)
    quiet = NOISE.simulate(N, generator=g)
    assert gf.diagnose(quiet, NOISE, rate=100.0).findings == ()
    episodes = (torch.arange(N) // 400) % 5 == 0  # a fifth of the samples, 400 at a time
    louder = torch.where(episodes, 3.0, 1.0) * quiet
    names = [finding.mechanism for finding in gf.diagnose(louder, NOISE, rate=100.0).findings]
    assert "scale_mixture" not in names


def test_jumps_that_a_filter_draws_out_are_no_second_level():
    """Of a telegraph behind a converter's filter, each jump is louder for some samples."""
    n, rate = 16_384, 800.0
    g = torch.Generator().manual_seed(7)
    fine = 8
    stays = torch.empty(400, dtype=torch.float64).exponential_(generator=g) * 180 * fine
    switches = torch.searchsorted(stays.cumsum(0), torch.arange(n * fine, dtype=torch.float64))
    jumps = dsp.decimate((1.0 - 2.0 * (switches % 2)).numpy(), fine)
    signal = torch.randn(2, n, generator=g, dtype=torch.float64)
    signal[0] += 4.5 * torch.from_numpy(jumps.copy())
    report = gf.diagnose(signal, gf.WhiteNoise(1.0), rate=rate)
    assert [finding.mechanism for finding in report.findings] == ["random_telegraph"]
    assert report.findings[0].parameters["half_step[0]"].value == pytest.approx(4.5, rel=0.02)
