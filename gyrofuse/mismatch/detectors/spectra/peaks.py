"""Bumps of a spectrum wider than a line and narrower than an octave."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse._base.transforms import fast_length, squared_modulus
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.spectra.modulated_ordinates import level_correlations
from gyrofuse.mismatch.detectors.spectra.own_peak_scan import scanned_own_peaks
from gyrofuse.mismatch.detectors.spectra.shared_peak_scan import (
    LOWEST,
    Stretches,
    flank_of,
    log_ratios,
    scanned_shared_peaks,
)
from gyrofuse.mismatch.likelihoods.spectra.coherence import decorrelated
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.psd import Bands, light_taper, steady_shares
from gyrofuse.mismatch.stats.multiplicity import e_value_of_some, p_value_from_e_value, sidak

# Bins of a spectrum under the light taper, a tenth of which is at either end, for an independent one in far tails.
_DEPENDENT = 1.15
_AS_WELL = 0.01  # p value at which the simulation has a peak as well, or is too faint to be compared


class Stretch(NamedTuple):
    """Bins that stand out.

    Attributes:
        frequency: Of their middle, cycles per sample.
        width: Cycles per sample.
        p_value: For all stretches, sensor by sensor and together.
        sensors: In which it alone stands out.
    """

    frequency: float
    width: float
    p_value: float
    sensors: tuple[int, ...]


def peak_test(comparison: Comparison) -> TestResult:
    """The strongest bump that the simulation does not have."""
    found = strongest_peak(comparison)
    f = found.frequency * comparison.info.rate
    names = ", ".join(comparison.info.sensors[i] for i in found.sensors)
    return TestResult(
        "bump",
        found.p_value,
        f"a bump {found.width * comparison.info.rate:.3g} Hz wide at {f:.5g} Hz in sensors {names}",
        sensors=found.sensors,
        levels=(level_of(found.frequency),),
        frequency_hz=f,
    )


@derived
def strongest_peak(comparison: Comparison) -> Stretch:
    """The most conspicuous bump of the recording that is neither a line nor in the simulation.

    Twelve are tried, those that the simulation has as well by what they are beyond it; a line has three fifths of the
    excess in three bins.
    """
    tries = 12
    compared: set[float] = set()
    recording = _Transform.of(comparison.lineless[None])
    _, length, ordinates = recording
    transform = recording.bins[0, :, : int((0.5 - 2 / comparison.n_samples) * length)]
    levels, width = level_correlations(comparison.lineless), comparison.n_samples / length
    scans = list(scanned_own_peaks(squared_modulus(_apart(transform, length, comparison)), ordinates, levels, width))
    if comparison.n_sensors > 1:
        scans += scanned_shared_peaks(transform, ordinates, levels, width)
    power, nothing = squared_modulus(transform), Stretch(0.25, 0.5, 1.0, tuple(range(comparison.n_sensors)))
    simulation: _Transform | None = None
    for _ in range(tries if scans else 0):
        best = max(scans, key=lambda scan: float(scan.log_ratio.amax()))
        a, n = int(best.first[best.log_ratio.argmax()]), best.width
        if not bool(best.log_ratio.isfinite().any()):
            return nothing
        sensors = _alone(power, a, n, n * ordinates)
        stretch = Stretch((a + (n - 1) / 2) / length, n / length, _p_value(scans), sensors)
        if stretch.p_value > _AS_WELL or stretch.frequency in compared:
            return stretch
        excess = (power[:, a : a + n].mean(0) - _flanks(power, a, n).mean()).clamp(min=0)
        line = float(excess.topk(3).values.sum()) > 0.6 * float(excess.sum())
        if simulation is None:
            simulation = _Transform.of(comparison.lineless_reference)
        own, others = _BesideFlanks.of(recording, stretch), _BesideFlanks.of(simulation, stretch)
        if not line and own.stands_out and not others.stands_out and simulation.is_level_around(stretch):
            return stretch
        as_scanned = float(best.log_ratio.amax())
        for scan in scans:
            over = (scan.first < a + 2 * n) & (scan.first + scan.width > a - n)
            scan.log_ratio[over] = -math.inf
        if not line:
            compared.add(stretch.frequency)
            white = comparison.lineless[None], comparison.lineless_reference
            shares = [_shares_around(side, stretch, others.source) for side in white]
            own, others = (side.known_from(*map(min, *shares)) for side in (own, others))
            best.log_ratio[best.first == a] = min(as_scanned, own.over(others).log_ratio())
    return nothing


def _p_value(scans: list[Stretches]) -> float:
    """Of the mean likelihood ratio over widths and positions."""
    means = [torch.logsumexp(scan.log_ratio, 0) - math.log(len(scan.first)) for scan in scans]
    return p_value_from_e_value(float(torch.logsumexp(torch.stack(means), 0)) - math.log(len(scans)))


class _Transform(NamedTuple):
    """Of whitened samples.

    Attributes:
        bins: `(record, sensor, bin)`.
        length: Padded to.
        ordinates: Independent ones in a bin.
    """

    bins: Tensor
    length: int
    ordinates: float

    @classmethod
    def of(cls, white: Tensor) -> _Transform:
        """Of samples `(record, sensor, time)`."""
        n = white.shape[-1]
        length = fast_length(n)
        return cls(torch.fft.rfft(white * light_taper(n), n=length), length, n / length / _DEPENDENT)

    def is_level_around(self, stretch: Stretch) -> bool:
        """Whether a stretch and its flanks are as level as chance has noise: then flanks tell what is between them."""
        n, total = max(round(stretch.width * self.length), 1), self.bins.shape[-1]
        middle, reach = round(stretch.frequency * self.length), n + flank_of(n, total)
        own = squared_modulus(self.bins[..., max(middle - reach, LOWEST) : min(middle + reach, total)])
        parts = max(min(32, own.shape[-1] // max(n // 2, 8)), 2)
        cells = torch.stack([part.mean((0, -1)) for part in own.tensor_split(parts, -1)], -1)  # (sensor, cell)
        each = own.shape[0] * own.shape[-1] / parts * self.ordinates
        apart = cells.clamp(min=1e-300).log()
        chi2 = each * (apart - apart.mean(-1, keepdim=True)).square().sum()
        return bool(stats.chi2.sf(float(chi2), len(cells) * (parts - 1)) > _AS_WELL)


def _apart(transform: Tensor, length: int, comparison: Comparison) -> Tensor:
    """Without what sensors `(sensor, bin)` share over broad bands of both.

    Bins are cut to 3.4 medians of their modulus, one in three thousand of noise: lines are nothing that bands share.
    """
    scale = length / comparison.n_samples
    edges = [0, *(round(e * scale) for e in comparison.bands.edges[1:-1]), transform.shape[-1]]
    parts = [transform[:, a:b] for a, b in itertools.pairwise(edges)]
    limits = [3.4 * part.abs().median(-1, keepdim=True).values for part in parts]
    cut = [part * (limit / part.abs()).clamp(max=1) for part, limit in zip(parts, limits, strict=True)]
    return decorrelated(torch.cat(cut, -1), edges, comparison.observed.dof)


def _flanks(power: Tensor, a: int, n: int) -> Tensor:
    """Both flanks of `n` bins from `a` on, `(..., bin)`, as far as they reach."""
    gap, wide = n // 2, flank_of(n, power.shape[-1])
    left, right = power[..., max(a - gap - wide, 0) : max(a - gap, 0)], power[..., a + n + gap : a + n + gap + wide]
    return torch.cat([left, right], -1)


def _shares_around(white: Tensor, stretch: Stretch, source: Tensor) -> tuple[float, float]:
    """Share of a stretch's ordinates that its power is known from, and of those of its flanks.

    Args:
        white: Whitened samples `(record, sensor, time)`.
        stretch: The stretch.
        source: Sum of sensors `(sensor,)` that shows it best: a line that all of them have stands out in that.
    """
    n, width = white.shape[-1], stretch.width
    ends = stretch.frequency + width * torch.tensor([-2.0, -0.5, 0.5, 2.0], dtype=torch.float64)
    edges = tuple((n * ends.clamp(1 / n, 0.5)).round().int().tolist())
    around = Bands(n, edges, ends[:-1], torch.ones(3, dtype=torch.float64))
    below, own, above = steady_shares(torch.cat([white, (source @ white)[:, None]], 1), around).tolist()
    return own, min(below, above)


def _alone(power: Tensor, a: int, n: int, d: float) -> tuple[int, ...]:
    """Sensors in which `n` bins from `a` on, of `d` independent ordinates, stand out alone."""
    tails = stats.f.sf((power[:, a : a + n].mean(-1) / _flanks(power, a, n).mean(-1)).numpy(), 2 * d, 6 * d)
    p = len(power)
    return tuple(i for i in range(p) if sidak(float(tails[i]), p) < 0.01) or (int(tails.argmin()),)


class _BesideFlanks(NamedTuple):
    """A stretch beside its flanks.

    Attributes:
        inside, beside: Mean cross-spectral matrices of the stretch and of its flanks, `(sensor, sensor)`.
        m, f: Independent ordinates of each.
    """

    inside: Tensor
    beside: Tensor
    m: float
    f: float

    @classmethod
    def of(cls, side: _Transform, stretch: Stretch) -> _BesideFlanks:
        """Of all records of a side together; flanks as far as they reach."""
        n = max(round(stretch.width * side.length), 1)
        a = max(round(stretch.frequency * side.length - (n - 1) / 2), 0)
        stretches = side.bins[..., a : a + n], _flanks(side.bins, a, n)
        parts = [part.movedim(0, 1).flatten(1) for part in stretches]  # (sensor, ordinate)
        inside, beside = (part @ part.mH / part.shape[-1] for part in parts)
        return cls(inside, beside, *(part.shape[-1] * side.ordinates for part in parts))

    @property
    def source(self) -> Tensor:
        """Sum of sensors `(sensor,)` in which the stretch stands out most over its flanks."""
        root = _root(self.beside)
        left = torch.linalg.solve_triangular(root, self.inside, upper=False)
        contrast = torch.linalg.solve_triangular(root, left.mH, upper=False)
        top = torch.linalg.eigh(contrast)[1][:, -1:]
        return torch.linalg.solve_triangular(root.mH, top, upper=True)[:, 0].real

    def known_from(self, own: float, flanks: float) -> _BesideFlanks:
        """Where that is a share of the stretch's ordinates, and of those of its flanks."""
        return self._replace(m=own * self.m, f=flanks * self.f)

    def log_ratio(self) -> float:
        """Logarithm of the mean likelihood ratio of a bump of all sensors or of some."""
        inside, beside = self.m * self.inside[None], self.f * self.beside[None]
        each = (total.diagonal(dim1=-2, dim2=-1).real.mT[..., None] for total in (inside, beside))  # (sensor, 1, 1)
        own = e_value_of_some(log_ratios(next(each), next(each), self.m, self.f))
        together = log_ratios(inside, beside, self.m, self.f)[0]
        return float(torch.logaddexp(own, together)) - math.log(2)

    @property
    def stands_out(self) -> bool:
        """Whether there is a bump, were it looked for only here."""
        return p_value_from_e_value(self.log_ratio()) < _AS_WELL

    def over(self, other: _BesideFlanks) -> _BesideFlanks:
        """Where the contrast that another side has is undone."""
        towards = torch.linalg.solve_triangular(other._root(), _root(other.beside), upper=False, left=False)
        # A ratio of two contrasts varies as a contrast of fewer ordinates does.
        m, f = (1 / (1 / own + 1 / others) for own, others in ((self.m, other.m), (self.f, other.f)))
        return _BesideFlanks(towards @ self.inside @ towards.mH, self.beside, m, f)

    def _root(self) -> Tensor:
        """Of the stretch's matrix; where ordinates are few coherences are drawn towards those of the flanks."""
        p, size = len(self.inside), (self.inside.diagonal().real / self.beside.diagonal().real).sqrt()
        return _root((self.m * self.inside + p * size * self.beside * size[:, None]) / (self.m + p))


def _root(matrix: Tensor) -> Tensor:
    return torch.linalg.cholesky(matrix + 1e-9 * torch.diag(matrix.diagonal()))  # for rounding
