"""Bumps of a spectrum fitted closely: centre, width and gains, beside level and slope of the noise where that pays."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.spectra.peaks import Stretch, strongest_peak
from gyrofuse.mismatch.likelihoods.spectra.choice import cost_of
from gyrofuse.mismatch.likelihoods.spectra.common_sources import CommonBump
from gyrofuse.mismatch.likelihoods.spectra.components import Peak, Term
from gyrofuse.mismatch.likelihoods.spectra.data import ratios_around
from gyrofuse.mismatch.likelihoods.spectra.fit import Fit, fit
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Ground
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.records import Records


@dataclass(frozen=True, eq=False)
class Oscillation:
    """A bump as fitted.

    Attributes:
        stretch: Stretch of the spectrum that stands out.
        centre, width: Centre and half width, cycles per sample.
        log_sd: Standard deviations of their logarithms.
        variance, variance_sd: Variances and their standard deviations, `(sensor,)`.
        gain: Complex gains of a common source `(sensor,)`; None where sensors have bumps of their own.
        nats: Gain in log likelihood, less what the numbers cost.
    """

    stretch: Stretch
    centre: float
    width: float
    log_sd: tuple[float, float]
    variance: Tensor
    variance_sd: Tensor
    gain: Tensor | None
    nats: float

    @classmethod
    def of(cls, stretch: Stretch, term: Peak | CommonBump, sd: tuple[Tensor, Tensor], nats: float) -> Oscillation:
        """From a fitted term, with the standard deviations of its local and its shared numbers."""
        local_sd, log_sd = sd
        if isinstance(term, CommonBump):
            gain = torch.complex(*term.local)
            variance, spread = gain.abs().square(), 2 * gain.abs() * local_sd.square().nanmean(0).sqrt()
        else:
            gain, variance, spread = None, term.local[0], local_sd[0].nan_to_num(nan=math.inf)
        (centre, width), (centre_sd, width_sd) = term.shared.exp().tolist(), log_sd.tolist()
        return cls(stretch, centre, width, (centre_sd, width_sd), variance, spread, gain, nats)


@dataclass(frozen=True, eq=False)
class Background(Term):
    """Level and slope of the noise around a bump: local are the logarithm at the centre and its rise to the end."""

    name: ClassVar[str] = "background"
    acts: ClassVar[str] = "scale"

    @classmethod
    def start(cls, n_sensors: int) -> Background:
        free = torch.ones(2, n_sensors, dtype=torch.bool)
        return cls(torch.zeros(2, n_sensors, dtype=torch.float64), free, torch.zeros(0, dtype=torch.float64))

    def values(self, ground: Ground, local: Tensor, shared: Tensor) -> Tensor:
        low, high = ground.nodes[0], ground.nodes[-1]
        x = (2 * ground.nodes - low - high) / (high - low)
        return (local[..., 0, :, None] + local[..., 1, :, None] * x).exp()

    def within(self) -> Background:
        # Where powers are too far apart nothing else would hold them, and numbers could not be worked out.
        return replace(self, local=self.local.clamp(-30, 30))


@derived
def oscillation_of(comparison: Comparison) -> Oscillation | None:
    """The strongest bump, fitted; None where it is no oscillation."""
    return _closely(comparison, strongest_peak(comparison))


def bump_at(comparison: Comparison, side: Records, stretch: Stretch) -> Oscillation | None:
    """The bump that a side itself has at a stretch, over its own simple spectrum and what sensors share beside it."""
    return _closely(replace(comparison, observed=side, reference=side), stretch, beside=1.5 * stretch.width)


def _closely(comparison: Comparison, stretch: Stretch, beside: float = 0.0) -> Oscillation | None:
    """Fitted in cells of a quarter of the stretch, in finer ones while its half width is less than a tenth of it."""
    times = 3
    found = _in_cells(comparison, stretch, beside)
    for _ in range(times):
        if found is None or found.width > stretch.width / 10:
            break
        stretch = stretch._replace(frequency=found.centre, width=stretch.width / 4)
        found = _in_cells(comparison, stretch, beside) or found
    return found


def _in_cells(comparison: Comparison, stretch: Stretch, beside: float) -> Oscillation | None:
    data = ratios_around(comparison, stretch.frequency, stretch.width, beside)
    if data is None:
        return None
    # Where a filter takes two fifths off, flanks are not alike: the whole spectrum has to decide.
    nodes = data.ground.nodes[[0, -1]]
    first, last = (int((comparison.bands.frequency - f).abs().argmin()) for f in nodes)
    passed = comparison.observed.power / comparison.reference.power.clamp(min=1e-300)
    if float(passed[:, first : last + 1].mean(0).min()) < 0.6:
        return None
    background = fit(data, [Background.start(comparison.n_sensors)])
    return _best(comparison, stretch, data, background)


def _best(comparison: Comparison, stretch: Stretch, data: Ratios, background: Fit) -> Oscillation | None:
    ground, p = data.ground, comparison.n_sensors
    middle = len(ground.bands.frequency) // 2
    least = max(1.5 / comparison.n_samples, stretch.width / 40) / stretch.frequency
    excess = data.observed - background.model
    height = excess.diagonal(dim1=-2, dim2=-1).real[middle - 2 : middle + 2].mean(0)
    level = ground.mean[:, middle] * height.clamp(min=1e-3)

    def value(found: Fit) -> float:
        return found.gain - cost_of(found)

    tried: list[Fit] = []
    for company, share in itertools.product(([], background.terms), (0.25, 0.6)):
        width = share * stretch.width
        peak = Peak.start(stretch.frequency, width, level * 2 * math.pi * width)
        own = fit(data, [*company, Peak(peak.local, peak.free, peak.shared, least)])
        tried.append(own)
        if p > 1:
            source = CommonBump.start(ground, excess, data.information, "oscillation", own.terms[-1].shared)
            source = CommonBump(source.local, source.free, source.shared, narrowest=least)
            tried.append(fit(data, [*company, source]))
    best = max(tried, key=value)
    nats = value(best) - max(value(background), 0.0)
    term = best.terms[-1]
    assert isinstance(term, Peak | CommonBump)
    found = Oscillation.of(stretch, term, best.sd(-1), nats)
    # Fits allow half widths up to half of the centre: a broader peak needs the whole spectrum.
    return None if found.centre < 2.1 * found.width or nats < 0 else found
