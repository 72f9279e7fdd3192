"""What is sudden: outliers and jumps.

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
from scipy import fft, stats
from torch import Tensor

from gyrofuse.mismatch.case import Case
from gyrofuse.mismatch.evidence import Evidence, corrected, surpassing
from gyrofuse.mismatch.remembered import remembered
from gyrofuse.mismatch.shocks import WeakOutliers, weak_outliers
from gyrofuse.mismatch.side import Side

_NARROWEST = 32  # bands, ordinates
_WIDTHS = ((4, 2048), (8, 512), (16, 64))  # of them: the part of their lowest ordinate, and at most
_LOG_CHI2, _LOG_CHI2_SD = -1.2703628454614782, math.pi / math.sqrt(2)  # mean and sd of log chi2_1
_FOLLOWED = 3.0  # sd by which narrower bands have to differ
_OWN = 1.5  # of an ordinate's share in its band: it is followed by three quarters, interpolated, and squared
_LINE = 25.0  # ordinates this far above the spectrum are lines
_SKIRT = 1 / 8  # share of ordinates of a line, beyond which the stretch around belongs to it
ENDS = 64  # a line's skirt is felt in so small a part of the record at each end
_AS_ELSEWHERE = 1.3  # times the sd of the errors, at an end that no line reaches
_MOST_RECORDS = 2  # of the simulation: as honest as more
_MAD = 0.6744897501960817
_FEW, _COARSE = 4096, 0.3  # samples that show a lattice, and its step in sd of the noise, from which it matters
_TUNING, _STEPS = 1.5, 20
_TAILS = (3.5, 4.0, 4.5, 5.0, 6.0, 8.0)
_HEAVY = 0.05  # p value of tails that the simulation may have as well
_TOP = 6  # levels at the top that have too few coefficients
_NEIGHBOURS = 8  # thinned Haar coefficients that are correlated


class LeftOut(NamedTuple):
    """Samples against their prediction from all others.

    Attributes:
        error: `(record, sensor, time)`, unit of the signal.
        sd: Of the errors between known episodes, robust, `(record, sensor)`.
        z: Errors over their sd, that of episodes within them, `(record, sensor, time)`.
        white: Whitened record, `(record, sensor, time)`, robust sd 1, likewise.
        at_ends: Errors where those of the ends are their own; in `error` and `white` their neighbours stand for them
            if there are lines.
    """

    error: Tensor
    sd: Tensor
    z: Tensor
    white: Tensor
    at_ends: Tensor

    def correctable(self) -> Tensor:
        """Errors `(record, sensor, time)` by which single samples may be corrected.

        Those of the ends are zero where the skirts of lines make them larger than elsewhere.
        """
        error, m = self.at_ends.clone(), self.at_ends.shape[-1] // ENDS
        for end in (error[..., :m], error[..., -m:]):
            end.mul_((_robust_sd(end) < _AS_ELSEWHERE * self.sd)[..., None])
        return error


@remembered
def left_out(side: Side) -> LeftOut:
    """Of one side, of its first records."""
    signal = side.noise[:_MOST_RECORDS]
    y = torch.from_numpy(fft.dct(signal.numpy(), norm="ortho", axis=-1))[..., 1:]
    spectrum, followed = _smooth_spectrum(y)
    lines = _lines(y, spectrum)
    y = torch.where(lines, 0.0, y)
    white, inverse = _back(y / spectrum.sqrt()), 1 / spectrum
    error = _back(y * inverse) / (inverse * (1 - followed)).mean(-1, keepdim=True)
    has_lines, at_ends = lines.any(-1, keepdim=True), error
    white, error = (torch.where(has_lines, _mirrored(v), v) for v in (white, error))
    stepped = _stepped(side.signal[:_MOST_RECORDS])
    z, white = (values / side.level**0.5 for values in (error, white))
    sd = _sd(z, stepped)
    return LeftOut(error, sd, z / sd[..., None], white / _sd(white, stepped)[..., None], at_ends)


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


def _stepped(signal: Tensor) -> Tensor:
    """Whether values `(..., time)` have few steps in their noise, `(...)`: medians of such are a matter of luck."""
    part = signal[..., :_FEW].flatten(0, -2)
    gaps = torch.stack([g.median() if len(g := row.unique().diff()) else g.new_zeros(()) for row in part])
    noise = part.diff().square().mean(-1).sqrt() / math.sqrt(2)
    return (gaps > _COARSE * noise).view(signal.shape[:-1])


def _sd(values: Tensor, stepped: Tensor) -> Tensor:
    """Robust sd; of what has few steps one that moves little with each of them."""
    return torch.where(stepped, _smooth_sd(values), _robust_sd(values)) if bool(stepped.any()) else _robust_sd(values)


def _smooth_sd(values: Tensor) -> Tensor:
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


def _tail_p(recorded: Tensor, simulated: Tensor, probability: float) -> Tensor:
    """p value of so many exceedances, `(..., time)` each, of a level that noise exceeds with `probability`."""
    own, other = recorded.sum(-1).to(torch.float64).numpy(), simulated.sum(-1).to(torch.float64)
    n, m = recorded.shape[-1], simulated.shape[-1]
    gaussian = stats.poisson.sf(own - 1, n * probability)
    heavy = stats.poisson.sf(other.numpy() - 1, m * probability) < _HEAVY
    two_sample = stats.binom.sf(own - 1, own + other.numpy(), n / (n + m))
    return torch.where(torch.as_tensor(heavy), torch.as_tensor(two_sample), torch.as_tensor(gaussian))


def spike_p_values(case: Case) -> Tensor:
    """p values of the tails of each sensor, and of all together, `(sensor + 1,)`, for all the levels looked at."""
    z, other = left_out(case.recorded).z, left_out(case.simulated).z
    own_q, other_q = pooled_squares(z)[0], pooled_squares(other).flatten()
    z, other = z[0].abs(), other.abs().movedim(1, 0).flatten(1)
    best = torch.ones(case.n_sensors + 1, dtype=torch.float64)
    for level in _TAILS:
        p = 2 * float(stats.norm.sf(level))
        together = float(stats.chi2.isf(p, case.n_sensors))
        single = _tail_p(z > level, other > level, p)
        pooled = _tail_p(own_q > together, other_q > together, p)
        best = torch.minimum(best, torch.cat([single, pooled[None]]))
    return -torch.expm1(len(_TAILS) * torch.log1p(-best.clamp(max=1 - 1e-16)))


def spike_p_value(case: Case) -> float:
    """p value of outliers anywhere, by the tails or by many weak ones."""
    tails = spike_p_values(case)
    p_value = corrected(float(tails.min()), len(tails))
    many = surpassing(likely_outliers(case.recorded).p_value, likely_outliers(case.simulated).p_value)
    return corrected(min(p_value, many), 2)


@remembered
def likely_outliers(side: Side) -> WeakOutliers:
    """Evidence of weak outliers in the first record."""
    return weak_outliers(left_out(side).z[0])


def spike_witness(case: Case) -> Evidence:
    """Outliers of single samples, sensor by sensor and all together."""
    p_values, p_value = spike_p_values(case), spike_p_value(case)
    z = left_out(case.recorded).z[0].abs()
    worst = int(p_values[:-1].argmin())
    at = int(z[worst].argmax())
    count = int((z[worst] > 5).sum())
    words = (
        f"{count} samples beyond 5 sd in sensor {case.scene.sensors[worst]}, the largest {float(z[worst, at]):.3g} sd"
    )
    sensors: tuple[int, ...] = (worst,)
    if corrected(float(p_values.min()), len(p_values)) > p_value:
        many = likely_outliers(case.recorded)
        sensors = tuple((many.sensors > 0.5).nonzero()[:, 0].tolist()) or sensors
        words = f"outliers of {many.size:g} sd {'in several sensors at once' if many.shock else 'in single sensors'}"
    return Evidence("spike", p_value, words, sensors=sensors, levels=(1,), time_s=at / case.scene.rate)


def kurtosis_p_values(case: Case) -> Tensor:
    """Two-sided p values of the kurtosis of Haar coefficients, `(level, sensor)`, from level 1 to J - 6."""
    n_levels = int(math.log2(case.n_samples)) - _TOP
    scores = _kurtosis_scores(case.recorded)[:n_levels]
    simulated = _kurtosis_scores(case.simulated)
    # Levels too high for a shorter simulation have none to compare with.
    known = min(len(simulated), len(scores))
    scores = scores[:known] - simulated[:known].sign() * (simulated[:known].abs() - 3.5).clamp(min=0)
    return 2 * torch.special.ndtr(-scores.abs())


@remembered
def _kurtosis_scores(side: Side) -> Tensor:
    """Kurtosis of thinned Haar coefficients as a standard normal variable, `(level, sensor)`; mean of the records."""
    mean = side.steady[:_MOST_RECORDS]
    mean = mean - mean.mean(-1, keepdim=True)
    scores, stride = [], 1
    for level in range(1, int(math.log2(side.signal.shape[-1])) - _TOP + 1):
        half = 2 ** (level - 1) // stride  # samples of the thinned mean in half a wavelet
        w = (mean[..., half:] - mean[..., :-half]) / 2
        w = w[..., :: max(half // 2, 1)]
        centred = w - w.mean(-1, keepdim=True)
        kurtosis = centred.pow(4).mean(-1) / centred.square().mean(-1).square()
        scores.append(_normal_kurtosis(kurtosis, _independent(centred)).mean(0))
        mean = (mean[..., half:] + mean[..., :-half]) / 2
        if half == 4:
            mean, stride = mean[..., ::2], stride * 2
    return torch.stack(scores)


def _independent(w: Tensor) -> Tensor:
    """How many independent normal values `(...)` have a kurtosis as certain as that of `(..., time)`.

    The fourth Hermite polynomials of two values correlated by `rho` are correlated by `rho^4`.
    """
    energy = w.square().sum(-1)
    rho = [(w[..., lag:] * w[..., :-lag]).sum(-1) / energy for lag in range(1, _NEIGHBOURS + 1)]
    return w.shape[-1] / (1 + 2 * torch.stack(rho).pow(4).sum(0))


def _normal_kurtosis(b2: Tensor, n: Tensor) -> Tensor:
    """Standard normal score of a sample kurtosis of `n` independent values (Anscombe and Glynn, 1983)."""
    mean = 3 * (n - 1) / (n + 1)
    variance = 24 * n * (n - 2) * (n - 3) / ((n + 1).square() * (n + 3) * (n + 5))
    x = (b2 - mean) / variance.sqrt()
    tail = (6 * (n + 3) * (n + 5) / (n * (n - 2) * (n - 3))).sqrt()
    skew = 6 * (n * n - 5 * n + 2) / ((n + 7) * (n + 9)) * tail
    a = 6 + 8 / skew * (2 / skew + (1 + 4 / skew.square()).sqrt())
    ratio = (1 - 2 / a) / (1 + x * (2 / (a - 4)).sqrt())
    return (1 - 2 / (9 * a) - ratio.sign() * ratio.abs().pow(1 / 3)) / (2 / (9 * a)).sqrt()


def jump_witness(case: Case) -> Evidence:
    """Jumps between levels, from the kurtosis of Haar coefficients at every scale."""
    tails = kurtosis_p_values(case)
    level, sensor = divmod(int(tails.argmin()), tails.shape[1])
    return Evidence(
        "jump",
        corrected(float(tails.min()), tails.numel()),
        f"wavelet coefficients at level {level + 1} that are not normal in sensor {case.scene.sensors[sensor]}",
        sensors=(sensor,),
        levels=(level + 1,),
    )
