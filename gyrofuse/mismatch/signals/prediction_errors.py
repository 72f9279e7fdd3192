"""Samples against their prediction from all others, and whitened records.

A record is whitened by its own smooth spectrum in the orthonormal DCT-II, `e = C^T y / sqrt(S)`, which has no ends
that meet; `C^T y / S` over the mean of `1/S`, less where `S` follows the ordinates, is the error of a sample predicted
from all others, most sensitive to an outlier of one sample. The smooth spectrum is made of geometric means over bands,
so that lines do not raise it, and ordinates of lines are left out. Bands are as wide as the spectrum allows: a mean of
50 ordinates is a third off, which costs a twentieth of an outlier's size, and weak ones half of what they tell.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import fft
from torch import Tensor

from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.records import Records

_NARROWEST = 32  # bands, ordinates
_WIDTHS = ((4, 2048), (8, 512), (16, 64))  # of them: the part of their lowest ordinate, and at most
_LOG_CHI2, _LOG_CHI2_SD = -1.2703628454614782, math.pi / math.sqrt(2)  # mean and sd of log chi2_1
_FOLLOWED = 3.0  # sd by which narrower bands have to differ
_OWN = 1.5  # of an ordinate's share in its band: it is followed by three quarters, interpolated, and squared
_LINE = 25.0  # ordinates this far above the spectrum are lines
_SKIRT = 1 / 8  # share of ordinates of a line, beyond which the stretch around belongs to it
ENDS = 64  # a line's skirt is felt in so small a part of the record at each end
_AS_ELSEWHERE = 1.3  # times the sd of the errors, at an end that no line reaches
_KINK, _KINK_SAMPLES = 2.5, 16  # times the sd of what is next to it, of so many samples: by chance in 1 of 10 000
_FLOOR = 1e-4  # of the median power: what is 40 dB below half of the ordinates is leakage, and predicts no sample
MOST_RECORDS = 2  # of the simulation: as honest as more
_MAD = 0.6744897501960817
_FEW, _COARSE = 4096, 0.3  # samples that show a lattice, and its step in sd of the noise, from which it matters
_MOST_GRAIN = 0.7  # sd: of what hardly leaves a step the few that do are still told from the others
_TUNING, _STEPS = 1.5, 20


class LeftOut(NamedTuple):
    """Samples against their prediction from all others.

    Attributes:
        error: `(record, sensor, time)`, unit of the signal.
        sd: Of the errors between known episodes, robust, `(record, sensor)`.
        z: Errors over their sd, that of episodes within them, `(record, sensor, time)`.
        white: Whitened record, `(record, sensor, time)`, robust sd 1, likewise.
        at_ends: Errors where those of the ends are their own; in `error` and `white` their neighbours stand for them
            where lines or a steep filter are felt there.
        grain: Modulus below which rounding to few steps leaves nothing known of `white`, `(record, sensor)`.
    """

    error: Tensor
    sd: Tensor
    z: Tensor
    white: Tensor
    at_ends: Tensor
    grain: Tensor

    def correctable(self) -> Tensor:
        """Errors `(record, sensor, time)` by which single samples may be corrected.

        Those of the ends are zero where the skirts of lines make them larger than elsewhere.
        """
        error, m = self.at_ends.clone(), self.at_ends.shape[-1] // ENDS
        for end in (error[..., :m], error[..., -m:]):
            end.mul_((_robust_sd(end) < _AS_ELSEWHERE * self.sd)[..., None])
        return error


@derived
def left_out(side: Records) -> LeftOut:
    """Of one side, of its first records."""
    signal = side.noise[:MOST_RECORDS]
    y = torch.from_numpy(fft.dct(signal.numpy(), norm="ortho", axis=-1))[..., 1:]
    spectrum, followed = _smooth_spectrum(y)
    lines = _lines(y, spectrum)
    y = torch.where(lines, 0.0, y)
    white = _back(y / spectrum.sqrt())
    inverse = 1 / spectrum.maximum(_FLOOR * spectrum.median(-1, keepdim=True).values)
    error = _back(y * inverse) / (inverse * (1 - followed)).mean(-1, keepdim=True)
    leaks, at_ends = lines.any(-1, keepdim=True) | _leaks(white) | _rings(error, white), error
    white, error = (torch.where(leaks, _mirrored(v), v) for v in (white, error))
    step = _step(side.signal[:MOST_RECORDS])
    stepped = step > _COARSE
    z, white = (values / side.level**0.5 for values in (error, white))
    sd = _sd(z, stepped)
    grain = torch.where(stepped, (step / math.sqrt(12)).clamp(max=_MOST_GRAIN), 0.0)
    return LeftOut(error, sd, z / sd[..., None], white / _sd(white, stepped)[..., None], at_ends, grain)


def _lines(y: Tensor, spectrum: Tensor) -> Tensor:
    """Ordinates `(..., k)` of lines and of their skirts, at every width."""
    lines = y.square() > _LINE * spectrum
    n, reach = y.shape[-1], 4
    # Two neighbours at least make a skirt.
    while reach < n // ENDS and bool((lines.sum(-1) > 1).any()):
        total = torch.nn.functional.pad(lines.cumsum(-1), (reach + 1, 0))
        # Windows that would reach beyond an end are cut off there.
        total = torch.cat([total, total[..., -1:].expand(*total.shape[:-1], reach)], -1)
        within = total[..., 2 * reach + 1 :] - total[..., :n]
        lines = lines | (within > _SKIRT * (2 * reach + 1))
        reach *= 2
    return lines


def _leaks(white: Tensor) -> Tensor:
    """Whether either end `(..., time)` is plainly larger than what is next to it, `(..., 1)`.

    Where a filter passes next to nothing, the kink that a record's end is to a cosine transform is all that is there.
    """
    m = white.shape[-1] // ENDS
    ends = _robust_sd(torch.stack([white[..., :_KINK_SAMPLES], white[..., -_KINK_SAMPLES:]]))
    inner = _robust_sd(torch.stack([white[..., m : 2 * m], white[..., -2 * m : -m]]))
    return (ends > _KINK * inner).any(0)[..., None]


def _rings(error: Tensor, white: Tensor) -> Tensor:
    """Whether either end of the errors `(..., time)` is plainly larger than that of the whitened record, `(..., 1)`.

    Errors weigh ordinates by one over their power. In a narrow stop band, a kink rings for as long as that is narrow,
    longer than what is next to an end; a louder end is so in the whitened record as well.
    """
    m = white.shape[-1] // ENDS
    ends = [torch.stack([_robust_sd(v[..., :m]), _robust_sd(v[..., -m:])]) / _robust_sd(v) for v in (error, white)]
    return (ends[0] > _KINK * ends[1]).any(0)[..., None]


def _mirrored(values: Tensor) -> Tensor:
    """With the ends `(..., time)` replaced by what is next to them."""
    m = values.shape[-1] // ENDS
    inner = values[..., m:-m]
    return torch.cat([inner[..., :m].flip(-1), inner, inner[..., -m:].flip(-1)], -1)


def _back(ordinates: Tensor) -> Tensor:
    with_mean = torch.nn.functional.pad(ordinates, (1, 0))
    return torch.from_numpy(fft.idct(with_mean.numpy(), norm="ortho", axis=-1))


def _smooth_spectrum(y: Tensor) -> tuple[Tensor, Tensor]:
    """Geometric means over bands of ordinates `(..., k)`, interpolated, and how far each ordinate is followed.

    Narrower bands count where they differ from wider ones by more than chance.
    """
    log_power = y.square().clamp(min=1e-300).log() - _LOG_CHI2
    curve, followed = torch.zeros_like(log_power), torch.zeros_like(log_power)
    for number, (part, most) in enumerate(_WIDTHS):
        ends = torch.tensor(_edges(y.shape[-1], part, most))
        width = ends.diff()
        total = torch.nn.functional.pad((log_power - curve).cumsum(-1), (1, 0))[..., ends]
        means, sd = total.diff(dim=-1) / width, _LOG_CHI2_SD / width.sqrt()
        counts = (means.abs() > _FOLLOWED * sd) | (number == 0)
        curve = curve + _interpolated(means * counts, ends)
        own = (counts / width).repeat_interleave(width, -1)
        followed = followed.maximum(_OWN * own)
    return curve.exp(), followed


def _edges(n: int, part: int, most: int) -> list[int]:
    """First ordinates of bands of `n`, and the end."""
    edges = [0]
    while edges[-1] < n:
        edges.append(edges[-1] + min(max(edges[-1] // part, _NARROWEST), most))
    edges[-1] = n
    if edges[-1] - edges[-2] < _NARROWEST:
        del edges[-2]
    return edges


def _interpolated(means: Tensor, ends: Tensor) -> Tensor:
    """Values `(..., k)` between the middles of bands that have `means`."""
    centre = (ends[1:] + ends[:-1] - 1) / 2
    k = torch.arange(int(ends[-1]), dtype=torch.float64)
    right = torch.bucketize(k, centre).clamp(1, len(centre) - 1)
    share = ((k - centre[right - 1]) / (centre[right] - centre[right - 1])).clamp(0, 1)
    return means[..., right - 1] + share * (means[..., right] - means[..., right - 1])


def _step(signal: Tensor) -> Tensor:
    """Usual distance of neighbouring values `(..., time)` over the sd of their noise, `(...)`.

    Beyond `_COARSE` there are few steps in the noise, and medians of it a matter of luck.
    """
    part = signal[..., :_FEW].flatten(0, -2)
    gaps = torch.stack([g.median() if len(g := row.unique().diff()) else g.new_zeros(()) for row in part])
    noise = part.diff().square().mean(-1).sqrt() / math.sqrt(2)
    return (gaps / noise.clamp(min=1e-300)).view(signal.shape[:-1])


def _sd(values: Tensor, stepped: Tensor) -> Tensor:
    """Robust sd; of what has few steps one that moves little with each of them."""
    return torch.where(stepped, smooth_sd(values), _robust_sd(values)) if bool(stepped.any()) else _robust_sd(values)


def smooth_sd(values: Tensor) -> Tensor:
    """The `s` of normal values with the mean of `1 - exp(-(x/s)^2/2c^2)` that they have (Welsch's M estimator)."""
    squares = values.square()
    variance = squares.mean(-1, keepdim=True).clamp(min=1e-300)
    wanted = 1 - _TUNING / math.sqrt(1 + _TUNING**2)
    for _ in range(_STEPS):
        seen = -torch.expm1(-squares / (2 * _TUNING**2 * variance)).mean(-1, keepdim=True)
        variance = variance * (seen / wanted)
    return variance[..., 0].sqrt()


def _robust_sd(values: Tensor) -> Tensor:
    """From the median modulus, or the mean square where half of the values are zero."""
    robust = values.abs().median(-1).values / _MAD
    return torch.where(robust > 0, robust, values.square().mean(-1).sqrt().clamp(min=1e-300))


def pooled_squares(z: Tensor) -> Tensor:
    """`z^T R^-1 z` over the sensors of `(record, sensor, time)`, chi-square distributed: `(record, time)`."""
    # Rank correlation of signs: outliers do not count for more.
    sign = z.sign()
    r = torch.sin(math.pi / 2 * (sign @ sign.mT) / z.shape[-1])
    root = torch.linalg.cholesky(r + 1e-6 * torch.eye(r.shape[-1], dtype=r.dtype))
    return torch.linalg.solve_triangular(root, z, upper=False).square().sum(-2)
