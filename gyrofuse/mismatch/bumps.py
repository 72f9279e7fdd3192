"""Bumps of a spectrum wider than a line and narrower than an octave.

The power of every stretch of 4, 8, 16, .. bins is set against its flanks: slopes and the unknown level of the noise
cancel. In wider ones the sensors' correlations are tested as well: of independent sensors their determinant is a
product of Beta variables, and a source of all sensors stands out where no power does.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import NamedTuple

import torch
from scipy import stats
from scipy.signal import windows
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._transforms import fast_length
from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import Evidence, corrected
from gyrofuse.mismatch.lines import simulated_lines, whitened, without_lines
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.shape_law import decorrelated, smooth_coherence
from gyrofuse.mismatch.witnesses import level_of

_NARROWEST = 4  # bins
_FLANK, _GAP = 1.5, 0.5  # widths
_ENDS = 0.1  # of the record, under the taper: lines leak as far as twenty bins
_DEPENDENT = 1.15  # bins under it for an independent one, as far tails have it
_LOWEST = 12  # bins
_TRIES = 6
_MOST = 3.4  # medians of a modulus: one bin in three thousand is above
_LINE = 0.6  # of the excess in three bins
_AS_WELL = 0.01  # p value at which the simulation has it as well
_ORDINATES = 2.5  # for each sensor, behind correlations


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


def bump_witness(case: Case) -> Evidence:
    """The strongest bump that the simulation does not have."""
    found = strongest_bump(case)
    f = found.frequency * case.scene.rate
    names = ", ".join(case.scene.sensors[i] for i in found.sensors)
    return Evidence(
        "bump",
        found.p_value,
        f"a bump {found.width * case.scene.rate:.3g} Hz wide at {f:.5g} Hz in sensors {names}",
        sensors=found.sensors,
        levels=(level_of(found.frequency),),
        frequency_hz=f,
    )


@remembered
def strongest_bump(case: Case) -> Stretch:
    """The most conspicuous bump of the recording that is neither a line nor in the simulation."""
    transform, length = _transformed(case.lineless)
    power = transform.abs().square()
    shared = _effective_sensors(case)
    known = torch.zeros(power.shape[-1], dtype=torch.bool)
    simulated: tuple[Tensor, int] | None = None
    apart = _apart(transform, length, case)
    power_apart = apart.abs().square()
    starts, widths, scores = _scanned(power, power_apart, length, case, shared)
    together = _correlated(apart, length, case)
    starts, widths = torch.cat([starts, together[0]]), torch.cat([widths, together[1]])
    n_places = scores.numel() + 2 * len(together[0])
    scores = pad(scores, (0, len(together[0])), value=-math.inf)
    scores = torch.cat([scores, pad(together[2], (scores.shape[1] - len(together[0]), 0), value=-math.inf)])
    for _ in range(_TRIES):
        flat = int(scores.argmax())
        row, column = divmod(flat, scores.shape[1])
        a, n = int(starts[column]), int(widths[column])
        tail = float(stats.norm.sf(float(scores[row, column])))
        if row < len(scores) - len(together[2]):
            tail = _tail(power, power_apart, row, a, n, length, case, shared)
        p = corrected(tail, n_places)
        stretch = Stretch((a + (n - 1) / 2) / length, n / length, p, _alone(power, a, n, length, case))
        if p > _AS_WELL:
            return stretch
        inside = power[:, a : a + n].mean(0)
        excess = (inside - _flanks(power, a, n).mean()).clamp(min=0)
        line = float(excess.topk(3).values.sum()) > _LINE * float(excess.sum())
        if simulated is None:
            bare = without_lines(case.simulated.signal, simulated_lines(case.simulated))
            simulated = _transformed(whitened(bare, case.base))
        if not line and not _has_it(simulated, stretch, case, row, coherent=row >= len(scores) - len(together[2])):
            return stretch
        known[max(a - n, 0) : a + 2 * n] = True
        over = _sums(known[None].to(torch.float64), starts, widths)[0] > 0
        scores[:, over] = -math.inf
        if not bool(scores.isfinite().any()):
            break
    return stretch._replace(p_value=1.0)


@functools.lru_cache(maxsize=8)
def light_taper(n: int) -> Tensor:
    """For whitened samples `(n,)`, of squares that sum to one: one that holds back what is red costs half of them."""
    taper = torch.from_numpy(windows.tukey(n, _ENDS))
    return taper / taper.square().sum().sqrt()


def _transformed(white: Tensor) -> tuple[Tensor, int]:
    """Transform of whitened samples, `(..., sensor, bin)`, and the length padded to."""
    n = white.shape[-1]
    length = fast_length(n)
    return torch.fft.rfft(white * light_taper(n), n=length), length


def _apart(transform: Tensor, length: int, case: Case) -> Tensor:
    """Without what sensors `(sensor, bin)` share over broad bands of both; zero above the last of them.

    Bins are cut to a few times the power around: lines are nothing that bands share.
    """
    last = _last(length, case)
    scale = length / case.n_samples
    edges = [0, *(round(e * scale) for e in case.bands.edges[1:-1]), last]
    parts = [transform[:, a:b] for a, b in itertools.pairwise(edges)]
    limits = [_MOST * part.abs().median(-1, keepdim=True).values for part in parts]
    cut = [part * (limit / part.abs()).clamp(max=1) for part, limit in zip(parts, limits, strict=True)]
    apart = decorrelated(torch.cat(cut, -1), edges, case.recorded.dof)
    return pad(apart, (0, transform.shape[-1] - last))


def _last(length: int, case: Case) -> int:
    return int((0.5 - 2 / case.n_samples) * length)


def _correlated(apart: Tensor, length: int, case: Case) -> tuple[Tensor, Tensor, Tensor]:
    """First bins and widths of wide stretches, and normal scores of their correlations `(2, stretch)`."""
    p, last = len(apart), _last(length, case)
    n = 2 ** math.ceil(math.log2(_ORDINATES * _DEPENDENT * p * length / case.n_samples))
    nothing = torch.zeros(0, dtype=torch.int64)
    starts, widths, scores = [nothing], [nothing], [torch.zeros(2, 0, dtype=torch.float64)]
    if p > 1 and 2 * n < last:
        half = apart[:, : last // (n // 2) * (n // 2)].unflatten(-1, (-1, n // 2)).movedim(1, 0)
        blocks = half @ half.mH  # (block, sensor, sensor)
        while n <= last // 8 and len(blocks) > 1:
            a = torch.arange(len(blocks) - 1) * (n // 2)
            inside = a >= max(int(_LOWEST + (_FLANK + _GAP) * n), 4 * n)
            inside &= a + n + int((_FLANK + _GAP) * n) + 1 < last
            starts.append(a[inside])
            widths.append(torch.full_like(a[inside], n))
            scores.append(_coherent_scores((blocks[:-1] + blocks[1:])[inside], float(_dof(n, length, case))))
            blocks = blocks[: len(blocks) // 2 * 2].unflatten(0, (-1, 2)).sum(1)
            n *= 2
    return torch.cat(starts), torch.cat(widths), torch.cat(scores, -1)


def _coherent_scores(matrices: Tensor, d: float) -> Tensor:
    """Normal scores of correlations in phase, and of any, `(2, stretch)`, from sums of `d` ordinates.

    Of independent sensors `det K` is a product of Beta variables of `d - k` and `k`, `k = 1 .. p - 1`; of real parts
    they are half as large, and the ordinates twice as many. Its logarithm is Gamma distributed, to rounding.
    """
    k = torch.arange(1, matrices.shape[-1], dtype=torch.float64)
    found = []
    for own, a, b in ((matrices.real, d - k / 2, k / 2), (matrices, d - k, k)):
        size = own.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300).rsqrt()
        q = -torch.linalg.slogdet(own * (size[:, :, None] * size[:, None, :])).logabsdet
        mean = float((torch.digamma(a + b) - torch.digamma(a)).sum())
        variance = float((torch.polygamma(1, a) - torch.polygamma(1, a + b)).sum())
        found.append(_normal_of_gamma(q / mean, mean**2 / variance))
    return torch.stack(found)


def _normal_of_gamma(ratio: Tensor, shape: float) -> Tensor:
    """Normal score of a Gamma variable over its mean (Wilson and Hilferty)."""
    return (ratio.clamp(min=1e-12).pow(1 / 3) - 1 + 1 / (9 * shape)) * 3 * math.sqrt(shape)


def _effective_sensors(case: Case) -> Tensor:
    """How many independent sensors a mean over all is worth in each band, `(band,)`."""
    p = case.n_sensors
    c = smooth_coherence(case.recorded.coherence, case.recorded.dof).abs().square().sum((-1, -2))
    return (p**2 / c).clamp(1.0, float(p))


def _sums(power: Tensor, starts: Tensor, n: Tensor) -> Tensor:
    total = torch.cat([torch.zeros_like(power[:, :1]), power.cumsum(-1)], -1)
    return total[:, starts + n] - total[:, starts]


def _flank_places(a: Tensor, n: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    wide, gap = (_FLANK * n).long(), (_GAP * n).long()
    return a - gap - wide, a + n + gap, wide


def _flanks(power: Tensor, a: int, n: int) -> Tensor:
    """Mean of both flanks, `(sensor,)`."""
    left, right, wide = _flank_places(torch.tensor([a]), torch.tensor([n]))
    return ((_sums(power, left, wide) + _sums(power, right, wide)) / (2 * wide))[:, 0]


def _dof(n: Tensor | float, length: int, case: Case) -> Tensor:
    return (torch.as_tensor(n, dtype=torch.float64) * case.n_samples / length / _DEPENDENT).clamp(min=1.0)


def _scanned(power: Tensor, apart: Tensor, length: int, case: Case, shared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """First bins and widths of all stretches, and their scores `(sensor + 2, stretch)`, normal but for rounding.

    Of each sensor, of the mean over all, and of those that rise, whichever they are.
    """
    last = _last(length, case)
    starts, widths, n = [], [], _NARROWEST
    while n <= last // 8:
        first = max(int(_LOWEST + (_FLANK + _GAP) * n), 4 * n)  # no wider than a quarter of its frequency
        a = torch.arange(first, last - int((1 + _FLANK + _GAP) * n) - 1, max(n // 2, 1))
        starts.append(a)
        widths.append(torch.full_like(a, n))
        n *= 2
    start, width = torch.cat(starts), torch.cat(widths)
    d = _dof(width, length, case)
    ratio = _ratios(power, start, width)
    scores = [_normal(ratio, d, 2 * _FLANK * d)]
    if len(power) > 1:
        worth = d * shared[band_of(start + width / 2, length, case)]
        scores.append(_normal(ratio.mean(0, keepdim=True), worth, 2 * _FLANK * worth))
        rises = _normal(_ratios(apart, start, width), d, 2 * _FLANK * d).clamp(min=0).square().sum(0)
        scores.append(_normal_of_rises(rises, len(power))[None])
    return start, width, torch.cat(scores)


def _ratios(power: Tensor, start: Tensor, width: Tensor) -> Tensor:
    """Means over stretches over those of their flanks, `(sensor, stretch)`."""
    left, right, wide = _flank_places(start, width)
    return (_sums(power, start, width) / width) / ((_sums(power, left, wide) + _sums(power, right, wide)) / (2 * wide))


def _tail_of_rises(total: Tensor, p: int) -> Tensor:
    """Tail of a sum of squares of those of `p` normal variables that are positive."""
    k = torch.arange(1, p + 1, dtype=torch.float64)
    weights = torch.tensor([math.comb(p, j) * 0.5**p for j in range(1, p + 1)], dtype=torch.float64)
    return (weights * torch.special.gammaincc(k / 2, total[..., None] / 2)).sum(-1)


def _normal_of_rises(total: Tensor, p: int) -> Tensor:
    """Normal score of such a sum."""
    return -torch.special.ndtri(_tail_of_rises(total, p).clamp(min=1e-300))


def band_of(place: Tensor, length: int, case: Case) -> Tensor:
    edges = torch.tensor(case.bands.edges[1:-1], dtype=torch.float64) / case.n_samples
    return torch.bucketize(place.to(torch.float64) / length, edges, right=True)


def _normal(ratio: Tensor, d: Tensor, flank: Tensor) -> Tensor:
    """Normal score of an F-distributed ratio, to rounding (Wilson and Hilferty; Paulson)."""
    a, b = 1 / (9 * d), 1 / (9 * flank)
    root = ratio.clamp(min=1e-12).pow(1 / 3)
    return ((1 - b) * root - (1 - a)) / (b * root.square() + a).sqrt()


def _tail(power: Tensor, apart: Tensor, row: int, a: int, n: int, length: int, case: Case, shared: Tensor) -> float:
    """Tail of a score, without rounding."""
    p, d = len(power), float(_dof(n, length, case))
    if row == p + 1:
        ratios = apart[:, a : a + n].mean(-1) / _flanks(apart, a, n)
        scores = torch.from_numpy(stats.norm.isf(stats.f.sf(ratios.numpy(), 2 * d, 2 * d * 2 * _FLANK)))
        return float(_tail_of_rises(scores.clamp(0, 37).square().sum(), p))
    ratio = power[:, a : a + n].mean(-1) / _flanks(power, a, n)
    if row < p:
        value = float(ratio[row])
    else:
        value = float(ratio.mean())
        d *= float(shared[int(band_of(torch.tensor(a + n / 2), length, case))])
    return float(stats.f.sf(value, 2 * d, 2 * d * 2 * _FLANK))


def _alone(power: Tensor, a: int, n: int, length: int, case: Case) -> tuple[int, ...]:
    d = float(_dof(n, length, case))
    tails = stats.f.sf((power[:, a : a + n].mean(-1) / _flanks(power, a, n)).numpy(), 2 * d, 4 * _FLANK * d)
    p = len(power)
    return tuple(i for i in range(p) if corrected(float(tails[i]), p) < 0.01) or (int(tails.argmin()),)


def _has_it(simulated: tuple[Tensor, int], stretch: Stretch, case: Case, row: int, *, coherent: bool) -> bool:
    """Whether the simulation has a bump at the same place."""
    transform, length = simulated
    power = transform.abs().square().mean(0)
    n = max(round(stretch.width * length), _NARROWEST)
    a = round(stretch.frequency * length - (n - 1) / 2)
    if a < int(_LOWEST + (_FLANK + _GAP) * n) or a + int((1 + _FLANK + _GAP) * n) + 1 >= power.shape[-1]:
        return False
    rows = slice(row, row + 1) if row < len(power) else slice(None)
    ratio = float((power[:, a : a + n].mean(-1) / _flanks(power, a, n))[rows].mean())
    own = len(case.simulated.signal) * case.simulated.signal.shape[-1] / case.n_samples
    d = max(n * own / _DEPENDENT, 1.0)
    if coherent and d > len(power):
        inside = transform[..., a : a + n].movedim(0, 1).flatten(1)
        return float(_coherent_scores((inside @ inside.mH)[None], d).max()) > float(stats.norm.isf(_AS_WELL))
    return float(stats.f.sf(ratio, 2 * d, 4 * _FLANK * d)) < _AS_WELL
