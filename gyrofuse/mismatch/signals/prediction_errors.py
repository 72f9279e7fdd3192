"""Leave-one-out prediction errors of samples, and whitened records.

A record is whitened by its own smooth spectrum in the orthonormal DCT-II, `e = C^T y / sqrt(S)`, which has no ends that
meet; `C^T y / S` over the mean of `1/S`, less where `S` follows the ordinates, is the error of a sample predicted from
all others (the inverse covariance's row over its diagonal), most sensitive to an outlier of one sample. The smooth
spectrum is made of geometric means over bands, so that lines do not raise it, and ordinates of lines are left out.

References:
    Christensen, Pearson and Johnson, Case-deletion diagnostics for mixed models, Technometrics 34 (1992), 38.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import fft
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.noise_spectrum import let_in
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.kurtosis import clipped_sd

ENDS = 64  # parts of a record: the skirt of a line reaches over one of them at each end
MOST_RECORDS = 2  # records of the simulation that are used: null laws from more are no better


class LeftOut(NamedTuple):
    """Samples against their prediction from all others.

    Attributes:
        error: Prediction errors, `(record, sensor, time)`, unit of the signal.
        sd: Robust sd of the errors between known episodes, `(record, sensor)`.
        z: Errors over their sd, that of episodes within them, `(record, sensor, time)`.
        white: Whitened record, `(record, sensor, time)`, of robust sd 1, likewise.
        at_ends: Errors where those of the ends are their own; in `error` and `white` the samples next to the ends stand
            for them where lines or a steep filter make them larger.
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

        Those of an end are zero where they are 1.3 times as large as elsewhere, by the skirts of lines.
        """
        error, m = self.at_ends.clone(), self.at_ends.shape[-1] // ENDS
        for end in (error[..., :m], error[..., -m:]):
            end.mul_((median_sd(end) < 1.3 * self.sd)[..., None])
        return error


@derived
def left_out(side: Records) -> LeftOut:
    """Prediction errors of the first records of one side."""
    rows = [_errors(row) for row in side.noise[:MOST_RECORDS].flatten(0, 1)]  # one after the other, to save memory
    shape = side.noise[:MOST_RECORDS].shape
    error, white, leaks = (torch.stack(v).view(*shape[:2], -1) for v in zip(*rows, strict=True))
    at_ends = error
    if bool(leaks.any()):
        white, error = (torch.where(leaks, _mirrored(v), v) for v in (white, error))
    step = _relative_step(side.signal[:MOST_RECORDS])
    coarse = step > 0.3  # sd of the noise: medians of fewer steps are a matter of luck
    z, white = (values / side.level**0.5 if side.loud else values for values in (error, white))
    sd = _sd(z, coarse)
    # Up to 0.7 sd: of what hardly leaves a step the few samples that do remain distinct.
    grain = torch.where(coarse, (step / math.sqrt(12)).clamp(max=0.7), 0.0)
    return LeftOut(error, sd, z / sd[..., None], white / _sd(white, coarse)[..., None], at_ends, grain)


def predicted(side: Records, at: Tensor, generator: torch.Generator) -> Tensor:
    """The first record `(sensor, time)` with some samples predicted from all others, with noise as the others have."""
    expected = left_out(side)
    noise = torch.randn(at.shape, generator=generator, dtype=torch.float64) * expected.sd[0][:, None]
    return torch.where(at, side.signal[0] - expected.correctable()[0] + noise, side.signal[0])


def whitened_without(side: Records, off: Tensor) -> Tensor:
    """The first record whitened as in `left_out`, with some samples `(sensor, time)` as all others predict them.

    A whitened sample that is far off has more of it beside: where noise is slow, next to nothing is left of their sum,
    and a gap in its place would be a slow pulse.
    """
    rows = []
    for signal, at in zip(side.noise[0], off, strict=True):
        _, white, leaks = _errors_of(signal - torch.where(at, _single(signal), 0.0))
        rows.append(_mirrored(white) if bool(leaks) else white)
    white = torch.stack(rows)
    white = white / torch.as_tensor(side.level) ** 0.5 if side.loud else white
    return white / clipped_sd(white)[..., None]


def _single(signal: Tensor) -> Tensor:
    """What a single sample `(time,)` would have to be less to leave the whitened signal with the least energy."""
    y = torch.from_numpy(fft.dct(signal.numpy(), norm="ortho"))[1:]
    inverse = 1 / _smooth_spectrum(y)[0]
    return _inverse_dct(y * inverse) / inverse.mean()


def scaled_innovations(signal: Tensor, factors: Tensor) -> Tensor:
    """Signals `(..., time)` whose innovations were multiplied by factors `(..., time)`: of the same smooth spectrum.

    Innovations are those of a filter without phase, by the smooth spectrum of each record.
    """
    if signal.shape[-1] < 2 * ENDS:  # of so few samples no spectrum is known: they are taken for white
        mean = signal.mean(-1, keepdim=True)
        return mean + (signal - mean) * factors
    y = torch.from_numpy(fft.dct(signal.numpy(), norm="ortho", axis=-1))[..., 1:]
    root = _smooth_spectrum(y)[0].sqrt()
    white = _inverse_dct(y / root) * factors
    made = torch.from_numpy(fft.dct(white.numpy(), norm="ortho", axis=-1))[..., 1:] * root
    return _inverse_dct(made) + signal.mean(-1, keepdim=True)


def _errors(signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Prediction errors and whitened signal `(time,)`, and whether its ends are larger than the rest.

    Samples that are far off are no part of the spectrum, nor of what predicts their neighbours: they are taken out
    until no other one is.
    """
    far, apart, rounds, most = 30.0, 9, 4, len(signal) // 200  # sd; samples, of which the farthest is off; number
    found, taken = _errors_of(signal), torch.zeros_like(signal)
    for _ in range(rounds):
        size = found[0].abs()
        off = (size > far * median_sd(found[0])) & (size == max_pool1d(size[None], apart, 1, apart // 2)[0])
        if not bool(off.any()):
            break
        taken = taken + torch.where(off, found[0], 0.0)
        if int((taken != 0).sum()) > most:  # more than outliers
            return _errors_of(signal)
        found = _errors_of(signal - taken)
    error, white, leaks = found
    return error + taken, white + taken / median_sd(error), leaks


def _errors_of(signal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same with all samples in."""
    y = torch.from_numpy(fft.dct(signal.numpy(), norm="ortho"))[1:]
    spectrum, followed = _smooth_spectrum(y)
    lines = _lines(y, spectrum)
    y = torch.where(lines, 0.0, y)
    white = _inverse_dct(y / spectrum.sqrt())
    inverse = _inverse(spectrum)
    error = _inverse_dct(y * inverse) / (inverse * (1 - followed)).mean()
    return error, white, lines.any() | _nothing_slow(spectrum) | _steep(spectrum) | _ends_leak(error, white)


def _steep(spectrum: Tensor) -> Tensor:
    """Whether a density `(k,)` is 20 dB below its median in a twentieth: there the ends ring, as loud as noise."""
    fast = spectrum[len(spectrum) // 10 :]
    fast = fast[:: 1 + len(fast) // 2**24]  # of more numbers no quantile is worked out
    return fast.quantile(0.05) < 0.01 * fast.median()


def _nothing_slow(spectrum: Tensor) -> Tensor:
    """Whether slow ordinates of a density `(k,)` hold little but what the ends let in, as after a high-pass."""
    share, n, middle = 0.05, len(spectrum), 16  # of white noise it is an 80th of that ordinate
    f = torch.arange(1, n + 1, dtype=torch.float64) / (2 * n)
    return let_in(f, spectrum, f[middle - 1 : middle], n)[0] > share * spectrum[:middle].mean()


def _inverse(spectrum: Tensor) -> Tensor:
    """One over a density `(k,)`, which weighs ordinates in an error: no more unequal than that errors stay apart.

    What is 40 dB below half of the ordinates is leakage, and predicts no sample. Where a steep filter leaves all weight
    to a narrow band, errors of neighbouring samples are one, which a law of single samples would count many times: a
    power of the density below one is taken until two samples have what one would in a row, down to the root, with
    which the record is white.
    """
    held = spectrum.maximum(1e-4 * spectrum.median())
    for tenths in range(10, 4, -1):
        inverse = held ** (-tenths / 10)
        power = spectrum * inverse.square()  # of the errors
        if power.mean() ** 2 > power.square().mean() / 2:
            break
    return inverse


def _inverse_dct(ordinates: Tensor) -> Tensor:
    """Signals `(..., time)` of mean zero from the ordinates of the DCT-II above it."""
    return torch.from_numpy(fft.idct(pad(ordinates, (1, 0)).numpy(), norm="ortho", axis=-1))


def _smooth_spectrum(y: Tensor) -> tuple[Tensor, Tensor]:
    """Geometric means over bands of ordinates `(..., k)`, interpolated, and how far each ordinate is followed.

    Bands are a quarter, an eighth and a sixteenth of their frequency wide; narrower ones count where they differ from
    wider ones by 3 sd. A mean of 50 ordinates would be a third off, which costs a twentieth of an outlier's size, and
    weak ones half of their nats.
    """
    mean, sd = -1.2703628454614782, math.pi / math.sqrt(2)  # of log chi2_1
    log_power = y.square().clamp(min=1e-300).log() - mean
    curve, followed = torch.zeros_like(log_power), torch.zeros_like(log_power)
    for number, (part, most) in enumerate(((4, 2048), (8, 512), (16, 64))):
        ends = torch.tensor(_edges(y.shape[-1], part, most))
        width = ends.diff()
        means = pad((log_power - curve).cumsum(-1), (1, 0))[..., ends].diff(dim=-1) / width
        counts = (means.abs() > 3.0 * sd / width.sqrt()) | (number == 0)
        curve = curve + _interpolated(means * counts, ends)
        # An ordinate is followed by three quarters of its share in a band, interpolated, and squared.
        followed = followed.maximum(1.5 * (counts / width).repeat_interleave(width, -1))
    return curve.exp(), followed


def _edges(n: int, part: int, most: int) -> list[int]:
    """First ordinates of bands of `n`, and the end; bands are 32 ordinates wide at least."""
    narrowest, edges = 32, [0]
    while edges[-1] < n:
        edges.append(edges[-1] + min(max(edges[-1] // part, narrowest), most))
    edges[-1] = n
    if edges[-1] - edges[-2] < narrowest:
        del edges[-2]
    return edges


def _interpolated(means: Tensor, ends: Tensor) -> Tensor:
    """Values `(..., k)` between the middles of bands that have `means`, flat beyond them."""
    centre = (ends[1:] + ends[:-1] - 1) / 2
    k = torch.arange(int(ends[-1]), dtype=torch.float64)
    right = torch.bucketize(k, centre).clamp(1, len(centre) - 1)
    share = ((k - centre[right - 1]) / (centre[right] - centre[right - 1])).clamp(0, 1)
    return torch.lerp(means[..., right - 1], means[..., right], share.expand_as(means[..., right]))


def _lines(y: Tensor, spectrum: Tensor) -> Tensor:
    """Ordinates `(..., k)` of lines, 5 sd above the spectrum, and of their skirts.

    A stretch belongs to a line where one of eight ordinates is so far up, at any width from four to either side on:
    skirts that fall as the square of the distance reach as far as that.
    """
    lines = off = y.square() > 25.0 * spectrum
    n, reach = y.shape[-1], 4
    while reach < n // ENDS and bool((off.sum(-1) > 1).any()):  # two neighbours at least make a skirt
        total = pad(off.cumsum(-1), (reach + 1, 0))
        total = torch.cat([total, total[..., -1:].expand(*total.shape[:-1], reach)], -1)  # windows end with the record
        lines = lines | (total[..., 2 * reach + 1 :] - total[..., :n] > (2 * reach + 1) / 8)
        reach *= 2
    return lines


def _ends_leak(error: Tensor, white: Tensor) -> Tensor:
    """Whether either end of a record is larger than chance has it.

    The kink that a record's end is to a cosine transform is all that is there where a filter passes next to nothing, in
    16 samples of the whitened record `(time,)`. In the errors, which weigh ordinates by one over their power, it
    rings for as long as a stop band is narrow, a whole end or more; a louder end is so in the whitened record as well.
    By chance 2.5 times the sd are exceeded by one end in 10,000.
    """
    n = white.shape[-1]
    m = n // ENDS

    def both(values: Tensor, a: int, b: int) -> Tensor:
        return median_sd(torch.stack([values[..., a:b], values[..., n - b : n - a]]))

    kinks = both(white, 0, 16) > 2.5 * both(white, m, 2 * m)
    rings = both(error, 0, m) / median_sd(error) > 2.5 * both(white, 0, m) / median_sd(white)
    # A zero of an average rings in the outermost samples alone: six sd come by chance once in 10^8 ends.
    outermost = torch.stack([error[..., :4], error[..., -4:]]).abs().amax(-1) > 6.0 * median_sd(error)
    return (kinks | rings | outermost).any()


def _mirrored(values: Tensor) -> Tensor:
    """Values with their ends `(..., time)` replaced by those next to them."""
    m = values.shape[-1] // ENDS
    inner = values[..., m:-m]
    return torch.cat([inner[..., :m].flip(-1), inner, inner[..., -m:].flip(-1)], -1)


def _relative_step(signal: Tensor) -> Tensor:
    """Usual distance of neighbouring values `(..., time)` over the sd of their noise, `(...)`, in the first samples."""
    part = signal[..., :4096].flatten(0, -2)
    gaps = torch.stack([g.median() if len(g := row.unique().diff()) else g.new_zeros(()) for row in part])
    noise = part.diff().square().mean(-1).sqrt() / math.sqrt(2)
    return (gaps / noise.clamp(min=1e-300)).view(signal.shape[:-1])


def _sd(values: Tensor, coarse: Tensor) -> Tensor:
    """Robust sd; of values on few steps one that moves little with each of them."""
    sd = median_sd(values)
    return torch.where(coarse, clipped_sd(values), sd) if bool(coarse.any()) else sd


def median_sd(values: Tensor) -> Tensor:
    """Standard deviation from the median modulus, or the mean square where half of the values are zero."""
    robust = values.abs().median(-1).values / 0.6744897501960817  # median modulus of a standard normal variable
    return torch.where(robust > 0, robust, values.square().mean(-1).sqrt().clamp(min=1e-300))
