"""Spectral lines of an array above its own local background.

Each sensor is whitened with the smooth spectrum of the simulation, which leaves no steep slope to leak, and transformed
without a taper, four times as finely as its bins: a taper would cost a third of a line's power. With `M` the mean of
`z z^H` over `m` independent bins nearby, without those next to it, a set of `k` sensors has

    (m - k + 1) / (k m) z^H M^-1 z ~ F(2k, 2(m - k + 1)),

complex Hotelling's, for lines of any amplitudes and phases, and with the cross-spectral matrix `C` of some bands

    |h^H z|^2 / (h^H M h) ~ F(2, 2m),   h = C^-1 d,

for one source with the signature `d`: the same amplitude and phase in each sensor of the set. Noise that sensors share
counts in neither; in a plain sum it would look like a line.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from scipy import fft, special
from torch import Tensor
from torch.nn.functional import avg_pool1d, max_pool1d

from gyrofuse._base.transforms import fast_length
from gyrofuse.mismatch.decisions import CERTAIN
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.known_lines import amplitudes, precise
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.multiplicity import sidak

_FINER = 4  # bins of the padded transform in a bin of the record: a line between two loses 5 % of its power
GUARD = 3  # bins next to a line, which hold its main lobe and are no background
_NARROW, _WIDE = 32, 512  # bins on either side that estimate the background


@dataclass(frozen=True)
class FoundLine:
    """The least probable line.

    Attributes:
        frequency: Cycles per sample, to a fraction of a bin.
        p_value: Corrected for all bins and, in each, all sets of sensors.
        sensors: The set in which it is least probable.
    """

    frequency: float
    p_value: float
    sensors: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Lines:
    """Candidates of one record, strongest in all sensors first.

    Attributes:
        frequency: Cycles per sample, `(candidate,)`.
        log_p: Of each, for the sets of sensors but not for the bins, `(candidate,)`.
        best: Index of the set in which it is least probable, `(candidate,)`.
        n_bins: Number of bins that were searched.
    """

    frequency: Tensor
    log_p: Tensor
    best: Tensor
    n_bins: int


def strongest_line(
    observed: Records, reference: Records, steady: Callable[[Tensor], Tensor] = torch.ones_like
) -> FoundLine:
    """The least probable line of a recording that the simulation does not have.

    Args:
        observed, reference: Both sides.
        steady: Share of the ordinates at frequencies, cycles per sample, that powers are known from: where lines of the
            simulation wander they stand still for a while by chance.
    """
    z, length = _transformed(observed.signal[0], reference.base)
    f = torch.arange(z.shape[-1], dtype=torch.float64) / length
    shortest = min(observed.signal.shape[-1], reference.signal.shape[-1])
    known = torch.zeros_like(f, dtype=torch.bool)
    for line in _shared(simulated_lines(reference), observed, reference):
        here = (f - line).abs() < (GUARD + 1) / shortest
        known |= here | ((f - line).abs() < _reach(z[:, here]) / observed.signal.shape[-1])
    lines = _lines(z, length, observed, reference.base, known)
    lines = replace(lines, log_p=lines.log_p * steady(lines.frequency))
    # Of lines that are all beyond doubt the strongest is the first: by how much they are depends on the bins nearby.
    beyond_doubt = -100.0  # logarithm of a p value
    order = lines.log_p.clamp(min=beyond_doubt).argsort(stable=True).tolist()
    at = next((k for k in order if not _as_faint(float(lines.frequency[k]), observed, reference)), order[-1])
    # Neighbouring fine bins share their noise: 0.6 of them are independent.
    p_value = sidak(math.exp(float(lines.log_p[at])), 0.6 * lines.n_bins)
    sensors = sets_of(len(z))[0][int(lines.best[at])].nonzero()[:, 0].tolist()
    # Where lines of the simulation cover all, there is no candidate but frequency zero.
    return FoundLine(max(float(lines.frequency[at]), 1 / length), p_value, tuple(sensors))


def _as_faint(f: float, observed: Records, reference: Records) -> bool:
    """Whether a line stands out in the simulation as well, though not in all of its spectrum, and is about as large.

    Two faint ones, of which by chance one is below what is seen among all frequencies, are no difference.
    """
    near = 1 / min(observed.signal.shape[-1], reference.signal.shape[-1])
    there = [
        float(line)
        for lines, _ in _lines_of_records(reference)
        for line, log_p in zip(lines.frequency, lines.log_p.tolist(), strict=True)
        if log_p < math.log(CERTAIN) and abs(float(line) - f) < near
    ]
    if not there:
        return False
    own, others = _powers(tuple(there[:1]), observed, reference)
    return bool(others / 4 < own) and bool(own < 4 * others)


def _shared(lines: tuple[float, ...], observed: Records, reference: Records) -> list[float]:
    """Those of the simulation's lines that the recording has as well, half as large or larger.

    Where it has not, a line next to that frequency is the recording's own.
    """
    if not lines:
        return []
    own, others = _powers(lines, observed, reference)
    return [f for f, yes in zip(lines, (own > others / 4).tolist(), strict=True) if yes]


def _powers(lines: tuple[float, ...], observed: Records, reference: Records) -> tuple[Tensor, Tensor]:
    """Of lines on both sides, mean of their records, `(line,)`."""
    own, others = (amplitudes(side.signal, lines).square().mean(0).sum(0) for side in (observed, reference))
    return own, others


@derived
def _lines_of_records(side: Records) -> tuple[tuple[Lines, list[float]], ...]:
    """Candidates of each record of noise, and how far each reaches, cycles per sample."""
    found = []
    for signal in side.noise:
        z, length = _transformed(signal, side.base)
        lines = _lines(z, length, side, side.base, torch.zeros(z.shape[-1], dtype=torch.bool))
        reach = [_reach(z[:, round(f * length)][:, None]) / signal.shape[-1] for f in lines.frequency.tolist()]
        found.append((lines, reach))
    return tuple(found)


@derived
def simulated_lines(side: Records) -> tuple[float, ...]:
    """Frequencies of lines that a simulation has in any of its records, cycles per sample.

    Those that are known, and others by their p value, strongest first.
    """
    found: list[tuple[float, float, float]] = []
    for lines, reaches in _lines_of_records(side):
        for log_p, f, far in zip(lines.log_p.tolist(), lines.frequency.tolist(), reaches, strict=True):
            if log_p + math.log(lines.n_bins * len(side.signal)) < math.log(CERTAIN):
                found.append((log_p, f, far))
    kept: list[tuple[float, float]] = []
    for _, f, reach in sorted(found):
        if all(abs(f - other) > far for other, far in kept):
            kept.append((f, reach))
    return (*side.lines, *_steady(side, precise(side.noise, tuple(f for f, _ in kept))))


def _steady(side: Records, lines: tuple[float, ...]) -> tuple[float, ...]:
    """Those that every record has: the power of a peak of noise, which a model may have, is exponential."""
    if not side.gaussian or len(side.noise) < 4 or not lines:
        return lines
    density = side.base.spectrum(torch.tensor(lines, dtype=torch.float64))  # (sensor, line)
    power = amplitudes(side.noise, lines).square() / density * (side.noise.shape[-1] / 4)  # of noise one on average
    excess = (power - 1).sum(1)  # (record, line)
    # Of four exponential powers the usual one is a third of the largest at most.
    steady = excess.median(0).values > 0.45 * excess.amax(0)
    return tuple(f for f, yes in zip(lines, steady.tolist(), strict=True) if yes)


def _reach(z: Tensor) -> float:
    """Bins up to which the side lobes `1 / (pi d)^2` of a line `(sensor, bin)` are above a tenth of the noise."""
    return max(GUARD + 1.0, math.sqrt(float(z.abs().square().sum(0).amax()) / 0.1) / math.pi)


def _lines(z: Tensor, length: int, side: Records, base: NoiseSpectrum, known: Tensor) -> Lines:
    """Candidates in one whitened transform `(sensor, bin)`, those that are known left out."""
    p, n = len(z), side.signal.shape[-1]
    fine = length / n  # fine bins in a bin
    bins = torch.arange(z.shape[-1])
    known = known | (bins < 10 * fine) | (bins > (n / 2 - GUARD) * fine)
    band = torch.tensor(side.bands.edges[1:-1], dtype=torch.float64) / side.bands.n_samples
    of_band = torch.bucketize(bins / length, band, right=True)
    inverses = torch.linalg.inv(side.over(base))  # (band, sensor, sensor)
    parts = z.split(of_band.bincount(minlength=len(inverses)).tolist(), -1)
    q = torch.cat([(part.conj() * (own @ part)).sum(0).real for own, part in zip(inverses, parts, strict=True)])
    q = q.masked_fill(known, 0.0)
    peak = q == max_pool1d(q[None, None], 2 * _FINER + 1, 1, _FINER)[0, 0]
    # Over what is around, the line itself included: in a stop band of the recording the edge is far above any line.
    around = avg_pool1d(q[None, None], 2 * _NARROW * _FINER + 1, 1, _NARROW * _FINER, count_include_pad=False)[0, 0]
    at = (q / around.clamp(min=1e-300) * peak).topk(min(64, len(q))).indices
    at = at[z[:, at].abs().square().sum(0).argsort(descending=True)]
    inverse = inverses[of_band[at]]
    matrices, m = _nearby(z, at, fine, inverse)
    here = z[:, at].mT  # (candidate, sensor)
    sets, log_chance = sets_of(p)
    log_any = log_hotelling(here, matrices, sets, m)
    signatures = sets / base.spectrum(at / length).sqrt().mT[:, None, :]  # (candidate, set, sensor)
    filters = signatures.to(z.dtype) @ inverse.mT  # rows h^H, since C is Hermitian
    power = (filters @ here[..., None])[..., 0].abs().square()
    expected = ((filters @ matrices) * filters.conj()).sum(-1).real
    log_same = -m * torch.log1p(power / expected / m)
    least, best = (torch.minimum(log_any, log_same) - log_chance).min(-1)
    return Lines(at / length, (least + math.log(2.0)).clamp(max=0.0), best, int((~known).sum()))


def _nearby(z: Tensor, at: Tensor, fine: float, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Means of `z z^H` beside fine bins, `(candidate, sensor, sensor)`, and over how many bins, `(candidate, 1)`.

    Over as many bins as half the frequency, and only over the nearest where these are louder by more than chance.

    Args:
        z: Whitened transform `(sensor, bin)`.
        at: Fine bins `(candidate,)`.
        fine: Fine bins in a bin.
        inverse: Of the covariances in their bands, `(candidate, sensor, sensor)`.
    """
    apart = torch.cat([torch.arange(-_WIDE, -GUARD), torch.arange(GUARD + 1, _WIDE + 1)])
    beside = at[:, None] + (apart * fine).round().long()
    usable = (beside >= fine) & (beside < z.shape[-1] - fine)
    usable &= apart.abs() <= (at / fine / 2).clamp(min=_NARROW)[:, None]
    around = z[:, beside.clamp(0, z.shape[-1] - 1)].movedim(0, 1) * usable[:, None]  # (candidate, sensor, nearby)
    inner = apart.abs() <= _NARROW

    def level(matrices: Tensor) -> Tensor:
        return (inverse * matrices.mT).sum((-1, -2)).real

    wide, narrow = around @ around.mH, around[..., inner] @ around[..., inner].mH
    m_wide, m_narrow = usable.sum(-1), usable[:, inner].sum(-1)
    excess = level(narrow) / m_narrow / (level(wide) / m_wide) - 1
    hump = excess > 4 / (m_narrow * len(z)).sqrt()  # standard deviations
    m = torch.where(hump, m_narrow, m_wide).to(torch.float64)
    return torch.where(hump[:, None, None], narrow, wide) / m[:, None, None], m[:, None]


def log_hotelling(z: Tensor, matrices: Tensor, sets: Tensor, m: Tensor) -> Tensor:
    """Logarithm of the p value of lines of any amplitudes and phases, `(candidate, set)`.

    Args:
        z: `(candidate, sensor)`.
        matrices: Their covariances from bins nearby, `(candidate, sensor, sensor)`.
        sets: `(set, sensor)`, ones and zeros.
        m: How many bins, `(candidate, 1)`.
    """
    own = z[:, None] * sets  # (candidate, set, sensor)
    both = matrices[:, None] * (sets[:, :, None] * sets[:, None, :]) + torch.diag_embed(1 - sets)
    k = sets.sum(-1)
    t2 = (own.conj() * torch.linalg.solve(both, own)).sum(-1).real
    rest = (m - k + 1).clamp(min=1.0)
    tail = special.betainc(rest.numpy(), k.expand_as(rest).numpy(), (m / (m + t2)).numpy())
    return torch.from_numpy(tail).clamp(min=1e-300).log()


def whitened(signal: Tensor, base: NoiseSpectrum) -> Tensor:
    """Signals `(..., sensor, time)` in units of the noise of a base, without their means."""
    return with_factors(signal, base.of_ordinates(signal.shape[-1]).rsqrt())


def with_factors(signal: Tensor, factors: Tensor) -> Tensor:
    """Signals `(..., time)` with factors `(..., ordinate)` on their cosine ordinates, without their means.

    A Fourier transform has ends meet that do not, and a record that wanders would jump there.
    """
    ordinates = torch.from_numpy(fft.dct(signal.numpy(), norm="ortho", axis=-1)) * factors
    ordinates[..., 0] = 0.0
    return torch.from_numpy(fft.idct(ordinates.numpy(), norm="ortho", axis=-1))


def _transformed(signal: Tensor, base: NoiseSpectrum) -> tuple[Tensor, int]:
    """Transform `(sensor, bin)` of whitened signals over the root of their length, and the padded length."""
    n = signal.shape[-1]
    finer = fast_length(_FINER * n)
    return torch.fft.rfft(whitened(signal, base), n=finer) / math.sqrt(n), finer


def sets_of(p: int) -> tuple[Tensor, Tensor]:
    """Sets of sensors as rows of ones and zeros, `(set, sensor)`, and the logarithm of the error given to each.

    All sets, or where those are many each sensor alone and all together. These have half of the error, of the other
    sizes each has the same share, and of a size each set.
    """
    if p <= 8:  # 255 sets
        sets = (torch.arange(1, 2**p)[:, None] >> torch.arange(p) & 1).to(torch.float64)
    else:
        sets = torch.cat([torch.eye(p, dtype=torch.float64), torch.ones(1, p, dtype=torch.float64)])
    sizes = sets.sum(-1).long()
    counts = sizes.bincount()
    share = torch.where(sizes == p, 0.5, 0.5 / max(int((counts > 0).sum()) - 1, 1)).to(torch.float64)
    return sets, (share / counts[sizes]).log()
