"""Spectral lines of rate signals: vibration tones found in the noise and measured to the Cramer-Rao bound.

A tone `a sin(beta t + phase)` stands out of a periodogram with a Hann taper, whose side lobes die out within a few
dozen bins, so that neither a random walk nor another tone hides it. It is measured by weighted least squares on the
orthonormal DCT-II, which diagonalises white noise and random walks: `y_k = sqrt(2/T) sum_t x_t cos(pi k (t + 1/2) / T)`
has the variance `S(k / 2T)`. On the clock `u` that is 0 in the middle of the record the even `k` see only the tone's
cosine and the odd ones only its sine, both through the Dirichlet kernel `D(x) = sin(T x / 2) / sin(x / 2)`.

Inside, a record is in units of its rms, frequencies are bins of one of the two transforms, and a batch is
`(item, time)`.

References:
    E. J. Hannan, The estimation of frequency, Journal of Applied Probability 10, 1973: the bounds
    `var beta = 24 S / (a^2 T^3)`, `var a = 2 S / T`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.checks import check_floating, check_positive_integer
from gyrofuse._base.chunks import CACHE, items_at_once
from gyrofuse._base.transforms import fast_length, taper_kernel, tone_in_hann
from gyrofuse.fitting.spectral.line import Line
from gyrofuse.fitting.spectral.line_background import frequency_coordinate, smooth_background

NoiseSpectrum = Callable[[Tensor], Tensor]

# Fewest samples of a record: 16 for a spectral line, and as many for the noise around it.
FEWEST_SAMPLES = 32
# Cycles in the record, and from half the sampling rate, below which amplitude, phase and frequency of a line are not
# identified, nor distinguished from a trend.
FEWEST_CYCLES = 3
# Cycles from 0 and from half the sampling rate from which on lines are searched: the width of the taper's main lobe.
_FIRST_CYCLE = 2
# Bins of the DCT on either side of a line that its fit uses: its power further out is below a hundredth.
_HALF_WIDTH = 32


@dataclass(frozen=True, eq=False)
class Tones:
    """Tones `amplitude * sin(beta * t + phase)`, `t = 1, 2, ..`, by decreasing power, all in float64.

    Attributes:
        beta: `(..., tone)`, rad per sample, in `(0, pi)`.
        amplitude: `(..., tone)`, signal.
        phase: `(..., tone)`, rad.
        beta_sd: `(..., tone)`, Cramer-Rao bound at the noise around the line. NaN: not identifiable, for a tone with
            fewer than three cycles in the record, or as close to half the sampling rate.
        amplitude_sd: `(..., tone)`, signal, likewise.
        p_value: `(..., tone)`, of the test that what remained when the tone was found was noise alone.
    """

    beta: Tensor
    amplitude: Tensor
    phase: Tensor
    beta_sd: Tensor
    amplitude_sd: Tensor
    p_value: Tensor

    def waveform(self, n_samples: int) -> Tensor:
        """Sum of the tones over a record, `(..., time)`, signal."""
        size = math.isqrt(n_samples - 1) + 1
        n_blocks = -(-n_samples // size)
        start = size * torch.arange(n_blocks, dtype=self.beta.dtype, device=self.beta.device)
        within = torch.arange(1, size + 1, dtype=self.beta.dtype, device=self.beta.device)
        # sin(a + b) = sin a cos b + cos a sin b, of block and place in it, for all tones in one product.
        a = self.beta[..., None] * start + self.phase[..., None]  # (..., tone, block)
        b = self.beta[..., None] * within
        size_of = self.amplitude[..., None]
        blocks = torch.cat([size_of * a.sin(), size_of * a.cos()], -2).mT @ torch.cat([b.cos(), b.sin()], -2)
        return blocks.flatten(-2)[..., :n_samples]


def find_tones(
    signal: Tensor, n_tones: int, noise_spectrum: NoiseSpectrum | None = None, *, highest: float = math.pi
) -> Tones:
    """Find the largest spectral lines and measure their frequencies and amplitudes.

    One after the other: the largest ratio of periodogram to background, a fit over the bins around it, its removal
    from these bins; then all are fitted again until none sees the others.

    Args:
        signal: `(..., time)`, at least 32 samples.
        n_tones: How many lines, whether significant or not; see `Tones.p_value`.
        noise_spectrum: Two-sided density per sample of the noise without tones at frequencies `(frequency,)` in cycles
            per sample, for instance `Model.spectrum` of a fitted model: `(..., frequency)`, signal^2. By default a
            smooth background is taken from the periodogram itself, and p values allow for its error; below some ten
            cycles in the record, or as close to half the sampling rate, it absorbs all but strong lines, and the
            standard deviations of what is left come out too small.
        highest: Frequency up to which lines are looked for, rad per sample; p values are of a line up to there.

    Returns:
        The tones of every item, on the device of `signal`.

    Raises:
        TypeError: Not a floating point tensor.
        ValueError: Too few samples, missing or constant ones, too many tones, a highest frequency with no line
            below, or a spectrum that is not positive or does not fit the batch.
    """
    n_tones = check_positive_integer("n_tones", n_tones)
    _check(signal)
    n_samples = signal.shape[-1]
    if n_tones > n_samples // 16:
        raise ValueError(
            f"`n_tones`: expected at most {n_samples // 16} for {n_samples} samples (16 for each), got {n_tones}; "
            "ask for fewer or give a longer signal"
        )
    lowest = 2 * math.pi * FEWEST_CYCLES / n_samples
    if not lowest <= highest <= math.pi:
        raise ValueError(
            f"`highest`: expected a frequency from {lowest:.3g} ({FEWEST_CYCLES} cycles in the record) to pi, got "
            f"{highest!r}; it is in rad per sample"
        )
    found = [record.find(n_tones) for record in _records(signal, noise_spectrum, highest)]
    shape = (*signal.shape[:-1], n_tones)
    return Tones(*(torch.cat(parts).reshape(shape) for parts in zip(*found, strict=True)))


def line_p_value(signal: Tensor, noise_spectrum: NoiseSpectrum | None = None) -> Tensor:
    """Test whether the largest line of the periodogram is more than noise.

    A Hann ordinate over the noise density is exponential, and the largest of `n` of them exceeds `x` with the
    probability `1 - (1 - e^-x)^n`.

    Args:
        signal: `(..., time)`, at least 32 samples.
        noise_spectrum: As for `find_tones`.

    Returns:
        P values `(...)`, float64.

    Raises:
        TypeError: Not a floating point tensor.
        ValueError: As for `find_tones`.
    """
    _check(signal)
    return torch.cat([record.peak()[1] for record in _records(signal, noise_spectrum)]).reshape(signal.shape[:-1])


def _check(signal: Tensor) -> None:
    check_floating("signal", signal)
    if signal.ndim == 0 or signal.shape[-1] < FEWEST_SAMPLES or signal.numel() == 0:
        raise ValueError(
            f"`signal`: expected (..., time) with at least one record of at least {FEWEST_SAMPLES} samples, "
            f"got shape {tuple(signal.shape)}; give a longer signal"
        )
    low, high = torch.aminmax(signal.detach(), dim=-1)
    if not bool((low.isfinite() & high.isfinite()).all()):
        raise ValueError("`signal`: expected finite samples, got NaN or infinity; cut the record where samples miss")
    if bool((low == high).any()):
        raise ValueError(
            f"`signal`: expected records that vary, got {int((low == high).sum())} constant; leave out dead sensors"
        )


def _records(signal: Tensor, noise_spectrum: NoiseSpectrum | None, highest: float = math.pi) -> Iterator[_Records]:
    """The batch in parts of bounded size, one at a time."""
    items = signal.detach().reshape(-1, signal.shape[-1])
    n_samples = items.shape[-1]
    length = fast_length(n_samples)
    density = low = None
    if noise_spectrum is not None:
        f = torch.arange(1, length // 2 + 1, dtype=torch.float64, device=signal.device) / length
        density = _density(noise_spectrum, f, signal)
        fine, kernel = (torch.from_numpy(v).to(signal.device) for v in taper_kernel(n_samples, length))
        low = _density(noise_spectrum, fine, signal) @ kernel.T
    size = items_at_once(n_samples, CACHE)
    for first in range(0, len(items), size):
        part = slice(first, first + size)
        own = None if density is None or low is None else (density[part], low[part])
        yield _Records(items[part], length, own, highest)


def _density(noise_spectrum: NoiseSpectrum, f: Tensor, signal: Tensor) -> Tensor:
    """Noise density `(item, frequency)`, checked."""
    batch = signal.shape[:-1]
    density = torch.as_tensor(noise_spectrum(f)).detach().to(device=f.device, dtype=f.dtype)
    try:
        density = density.expand(*batch, len(f))
    except RuntimeError:
        raise ValueError(
            f"`noise_spectrum`: expected a density {(*batch, len(f))} or one that broadcasts to it for frequencies "
            f"{(len(f),)}, got shape {tuple(density.shape)}"
        ) from None
    if not bool((density.isfinite() & (density > 0)).all()):
        raise ValueError(
            "`noise_spectrum`: expected a finite density > 0 at all frequencies in (0, 1/2], got others; "
            "give a model with white noise or leave it out"
        )
    return density.reshape(-1, len(f))


class _Records:
    """Records of one length with their periodograms, from which the lines found so far are taken out.

    Args:
        items: `(item, time)`.
        length: Of the transform.
        density: Of the noise, at the bins from 1 on and as the taper shows it at the lowest: `(item, bin)` both.
        highest: Frequency up to which lines are looked for, rad per sample.
    """

    def __init__(self, items: Tensor, length: int, density: tuple[Tensor, Tensor] | None, highest: float) -> None:
        self._length, self._density, self._n = length, density, items.shape[-1]
        self._first = math.ceil(_FIRST_CYCLE * length / self._n)  # bins in which there may be lines
        self._last = length // 2 - self._first + 1
        n_bins = self._last - self._first + 1
        n_searched = min(math.floor(highest * length / (2 * math.pi)) - self._first + 1, n_bins)
        self._searched = slice(self._first - 1, self._first - 1 + n_searched)  # of the bins from 1 on
        self._n_ordinates = (self._n / 2 - 2 * _FIRST_CYCLE) * (n_searched / n_bins)
        n, device = self._n, items.device
        u = torch.arange(n, dtype=torch.float64, device=device) - (n - 1) / 2
        taper = (1 + torch.cos(2 * math.pi / n * u)) / 2
        signal = items.to(torch.float64)
        # Any constant would do for size; dividing twice keeps the squares of tiny and of huge records within range.
        largest = signal.abs().amax(-1, keepdim=True)
        signal = signal / largest
        signal -= (signal @ taper / taper.sum())[:, None]
        rms = signal.square().mean(-1, keepdim=True).sqrt()
        self._signal = signal.div_(rms)
        self._unit = largest * rms  # (item, 1)
        self._spectrum = torch.fft.rfft(self._signal * taper, n=self._length)
        self._highest = self._length // 2
        k = torch.arange(1, self._highest + 1, dtype=torch.float64, device=device)
        self._coordinate = frequency_coordinate(k, self._highest)
        if self._density is not None:
            log_size = 2 * self._unit.log()
            self._log_s = self._density[0].log() - log_size
            self._log_seen = self._log_s.clone()
            n_low = self._density[1].shape[-1]
            self._log_seen[:, :n_low] = self._density[1].log() - log_size

    def find(self, n_tones: int) -> tuple[Tensor, ...]:
        """`beta, amplitude, phase, beta_sd, amplitude_sd, p_value`, all `(item, tone)`."""
        lines: list[Line] = []
        p_values = []
        for _ in range(n_tones):
            peak, p_value = self.peak()
            lines.append(self._coefficients(2 * math.pi / self._length * peak.to(torch.float64)))
            p_values.append(p_value)
            self._fit(lines, len(lines) - 1, search=True)
            # Three rounds, until none of the lines sees the others.
            for _ in range(3 if len(lines) > 1 else 0):
                for i in range(len(lines)):
                    self._fit(lines, i)
        self._set_background(self._power())  # without the lines
        for i in range(n_tones):
            self._fit(lines, i)
        beta, amplitude, phase = (torch.stack(v, -1) for v in zip(*(line.polar() for line in lines), strict=True))
        sds = [line.standard_deviations(self._weights(line), self._n) for line in lines]
        beta_sd, amplitude_sd = (torch.stack(v, -1) for v in zip(*sds, strict=True))
        cycles = torch.minimum(beta, math.pi - beta) * self._n / (2 * math.pi)
        hidden = cycles < FEWEST_CYCLES
        phase = torch.remainder(phase - beta * (self._n + 1) / 2, 2 * math.pi)
        results = (
            beta,
            amplitude * self._unit,
            phase,
            beta_sd.masked_fill(hidden, torch.nan),
            (amplitude_sd * self._unit).masked_fill(hidden, torch.nan),
            torch.stack(p_values, -1),
        )
        order = amplitude.argsort(dim=-1, descending=True, stable=True)
        return tuple(v.gather(-1, order) for v in results)

    def peak(self) -> tuple[Tensor, Tensor]:
        """Bin of the largest line and its p value, both `(item,)`."""
        power = self._power()
        dof = self._set_background(power)
        ratio = self._log_seen[:, self._searched].neg().exp_().mul_(power[:, self._searched])
        if dof is not None:
            # An exponential variable over a background known to `dof` looks: 2 and 2 dof degrees of freedom.
            looks = dof[self._searched]
            ratio = ratio.div_(looks).log1p_().mul_(looks)
        largest, at = ratio.max(-1)
        p_value = -torch.expm1(self._n_ordinates * torch.log1p(-torch.exp(-largest)))
        return at + self._first, p_value

    def _power(self) -> Tensor:
        """Periodogram at the bins from 1 on, with the mean `S`, floored where rounding is all there is."""
        spectrum = self._spectrum[:, 1 : self._highest + 1]
        power = spectrum.real.square().add_(spectrum.imag.square())
        return power.mul_(8 / 3 / self._n).clamp_(min=1e-30)

    def _set_background(self, power: Tensor) -> Tensor | None:
        """Smooth density of the noise from the periodogram; returns degrees of freedom by bin, or None when given."""
        if self._density is not None:
            return None
        self._log_s, variance = smooth_background(power, self._coordinate, self._first, self._last)
        self._log_seen = self._log_s
        return 1 / variance

    def _coefficients(self, beta: Tensor) -> Line:
        """DCT-II coefficients around frequencies `(item,)`, without another transform.

        Sums over 256 blocks of time, with eight powers of time within a block, give them to 1e-10.
        """
        most_blocks, n_powers = 256, 8
        n, device = self._n, beta.device
        middle = (beta * n / math.pi).round().clamp(1, n - 1)  # (item,)
        size = -(-n // most_blocks)
        n_blocks = -(-n // size)
        blocks = torch.nn.functional.pad(self._signal, (0, n_blocks * size - n)).unflatten(-1, (n_blocks, size))
        within = torch.arange(size, dtype=torch.float64, device=device) - (size - 1) / 2
        centre = torch.arange(n_blocks, dtype=torch.float64, device=device) * size + size / 2  # of t + 1/2
        omega = math.pi / n * middle
        carrier = torch.polar(torch.ones_like(within), -omega[:, None] * within)  # (item, time in block)
        power = torch.arange(n_powers, dtype=torch.float64, device=device)
        powers = (within[:, None] * (2 / size)) ** power  # (time in block, power)
        table = torch.view_as_real(carrier[..., None] * powers).flatten(-2)
        moments = torch.view_as_complex((blocks @ table).unflatten(-1, (n_powers, 2)))  # (item, block, power)
        moments = moments * torch.polar(torch.ones_like(centre), -omega[:, None] * centre)[..., None]
        offset = torch.arange(-_HALF_WIDTH, _HALF_WIDTH + 1, dtype=torch.float64, device=device)
        delta = math.pi / n * offset
        # exp(-i delta (centre + within)), the second factor as a series.
        factors = (delta * (-0.5j * size)) / power[1:, None]
        series = torch.cat([torch.ones_like(factors[:1]), factors.cumprod(0)])  # (power, bin)
        outer = torch.polar(torch.ones(1, dtype=torch.float64, device=device), -delta * centre[:, None])
        kernel = (outer[:, None] * series).flatten(0, 1)  # (block power, bin)
        k = middle[:, None] + offset
        values = math.sqrt(2 / n) * (moments.flatten(1) @ kernel).real
        inside = (k >= 1) & (k <= n - 1)
        zero = torch.zeros_like(beta)
        return Line(k, torch.where(inside, values, 0.0), inside, beta, zero, zero)

    def _weights(self, line: Line) -> Tensor:
        """`1/S` at the bins of a fit, `S` interpolated as a power law."""
        position = (line.k * (self._length / (2 * self._n))).clamp(min=0.25)
        index = position.floor().long().clamp(1, self._log_s.shape[-1] - 1) - 1
        low, high = self._coordinate[index], self._coordinate[index + 1]
        weight = (frequency_coordinate(position, self._highest) - low) / (high - low)
        log_s = torch.lerp(self._log_s.gather(-1, index), self._log_s.gather(-1, index + 1), weight)
        return torch.where(line.inside, torch.exp(-log_s), 0.0)

    def _fit(self, lines: list[Line], which: int, search: bool = False) -> None:
        """Fit one line to what the others leave, and take it out of the periodogram instead of what it was."""
        line = lines[which]
        values = line.values
        for other in lines[:which] + lines[which + 1 :]:
            values = values - other.at(line.k, self._n)
        values = torch.where(line.inside, values, 0.0)
        fitted = line.fitted(values, self._weights(line), self._n, search)
        self._add_to_spectrum(line, 1)
        self._add_to_spectrum(fitted, -1)
        lines[which] = fitted

    def _add_to_spectrum(self, line: Line, sign: int, half_width: int = 64) -> None:
        """Add a line, or with `sign=-1` subtract it, at `half_width` bins on either side, where its side lobes end."""
        n, length = self._n, self._length
        centre = (line.beta * length / (2 * math.pi)).round().long()
        reach = torch.arange(-half_width, half_width + 1, device=centre.device)
        index = centre[:, None] + reach
        inside = (index >= 0) & (index < self._spectrum.shape[-1])
        omega = 2 * math.pi / length * index.to(torch.float64)
        complex_amplitude = torch.complex(line.cosine, -line.sine)[:, None]
        beta = line.beta[:, None]
        shown = complex_amplitude * tone_in_hann(beta - omega, n) + complex_amplitude.conj() * tone_in_hann(
            beta + omega, n
        )
        # The clock of the transform starts with the record, that of the tone in its middle.
        shown = shown * torch.polar(torch.full_like(omega, sign / 2), -omega * (n - 1) / 2)
        shown = torch.where(inside, shown, 0.0)
        self._spectrum.scatter_add_(-1, index.clamp(0, self._spectrum.shape[-1] - 1), shown)
