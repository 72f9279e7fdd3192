"""Spectral refinement of a noise model: from the moments' estimate to the maximum of a Whittle likelihood.

The orthonormal DCT-II of a record, `y_k = sqrt(2/T) sum_t x_t cos(pi k (t + 1/2) / T)`, makes white noise and random
walks independent normal variables and AR1s nearly so, without differencing and without a taper. Their log likelihood is
`-1/2 sum_k (ln 2 pi v_k + y_k^2 / v_k)` with the variances `v_k = sum_m p_m u_mk(x)`, linear in the variances `p` of
the processes. For the processes here `u_mk` is exact at every length, see `gyrofuse.fitting.spectral.bands`; the mean,
`k = 0`, is left out.

Tones and a ramp are not noise: they are measured with the fitted spectrum, taken out, and the noise is fitted again.

References:
    P. Whittle, Arkiv foer Matematik 2, 1953; A. Contreras-Cristan et al., Journal of Econometrics 130, 2006.
    P. McCullagh, J. A. Nelder, Generalized Linear Models, chapter 8: the score for variances that add up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_floating, check_positive_integer
from gyrofuse._base.chunks import CACHE, items_at_once
from gyrofuse._base.results import scattered
from gyrofuse._base.transforms import cosine_ordinates, ramp_ordinates
from gyrofuse.fitting.spectral.bands import BandSpectrum, Bins
from gyrofuse.fitting.spectral.search import maximise, uncertainty
from gyrofuse.fitting.spectral.tones import FEWEST_SAMPLES, Tones, find_tones
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.dct_bands import SINGLE
from gyrofuse.noise.processes import Sinusoid

# Degrees of freedom left to an ordinate that a spectral line or the drift takes all of: none, but for a division by it.
LEAST_COUNT = 1e-3


@dataclass(frozen=True, eq=False)
class WhittleFit:
    """Maximum of the likelihood; NaN and not converged for items that could not be fitted.

    The unknowns are `ln p` of the processes followed by `x` of the shaped ones, as `ModelStructure` has them.

    Attributes:
        linear: Linear parameters `p`, `(item, process)`: variances, squared amplitudes, the squared slope. A variance
            is 0 where raising it would not raise the likelihood.
        shape: Nonlinear parameters `x`, `(item, shaped)`.
        covariance: Covariance of the unknowns, from the Fisher information, `(item, unknown, unknown)`; zero rows for a
            variance at 0 and for the `x` of its AR1. NaN where unknowns are not identified.
        edge_sd: Standard error of `p` itself, as if variances at 0 could be negative, for upper limits,
            `(item, process)`.
        tones: Spectral lines from high to low frequency as in `shape`, `(item, tone)`; None without sinusoids.
        slope: Slope of the drift, with its sign, `(item,)`, signal per sample; 0 without one.
        slope_sd: Its standard error over the fitted noise, `(item,)`: too small where a random walk was estimated as 0.
        log_likelihood: Log likelihood of the record without sinusoids and drift, `(item,)`, nats.
        energy: Sums of squared ordinates of that record, `(item, bin)`.
        count: Ordinates in each sum less the degrees of freedom of sinusoids and drift, `(item, bin)`.
        converged: Whether a maximum was reached, `(item,)`.
    """

    linear: Tensor
    shape: Tensor
    covariance: Tensor
    edge_sd: Tensor
    tones: Tones | None
    slope: Tensor
    slope_sd: Tensor
    log_likelihood: Tensor
    energy: Tensor
    count: Tensor
    converged: Tensor


def refine_whittle(
    signal: Tensor,
    structure: ModelStructure,
    linear: Tensor,
    shape: Tensor,
    *,
    tones: Tones | None = None,
    n_rounds: int = 2,
) -> WhittleFit:
    """Maximise the Whittle likelihood of records from where a moment fit ended.

    Scoring for the variances, which stay >= 0 by non-negative least squares in each step, and for `atanh phi`,
    damped so that no step lowers the likelihood. The search finds the maximum next to the start only, and a weak line
    that the start takes for noise stays noise. AR1s that alternate quickly, `phi` below -0.9, depend on the ends of a
    record, which the likelihood contains in part only: estimates scatter somewhat more.

    Args:
        signal: Records `(item, time)` of at least 32 samples. An item with missing samples is not fitted.
        structure: Structure of the model.
        linear: `p` to start from, `(item, process)`; a zero may become positive again.
        shape: `x` to start from, `(item, shaped)`; frequencies of sinusoids are found anew.
        tones: Known spectral lines of the sinusoids, from high to low frequency, `(item, tone)`: kept in records where
            others are found, as a start that takes a line for noise would hide it. None by default.
        n_rounds: Number of rounds of measuring sinusoids and drift and fitting the noise; one where there are none.

    Returns:
        The fit, float64.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: Shapes that do not fit each other, too few samples, or a model without noise.
    """
    n_rounds = check_positive_integer("n_rounds", n_rounds)
    _check(signal, structure, linear, shape)
    signal = signal.detach()
    linear, shape = linear.detach().to(torch.float64).clone(), shape.detach().to(torch.float64).clone()
    noise = BandSpectrum(structure)
    at_tones = [structure.nonlinear.index(k) for k in structure.nonlinear if structure.processes[k].has_line]
    started = linear[:, noise.which]
    usable = signal.sum(-1, dtype=torch.float64).isfinite() & (signal != signal[:, :1]).any(-1)
    usable &= (started >= 0).all(-1) & (started.sum(-1) > 0) & started.isfinite().all(-1)
    usable &= shape[:, noise.at_x].isfinite().all(-1)
    known = None if tones is None else items_of(tones, usable)
    whole = _refined(signal[usable], structure, noise, at_tones, linear[usable], shape[usable], known, n_rounds)
    return _placed(whole, usable)


def _check(signal: Tensor, structure: ModelStructure, linear: Tensor, shape: Tensor) -> None:
    check_floating("signal", signal)
    if signal.ndim != 2 or signal.shape[-1] < FEWEST_SAMPLES:
        raise ValueError(
            f"`signal`: expected (item, time) with at least {FEWEST_SAMPLES} samples, got shape "
            f"{tuple(signal.shape)}; flatten the batch, or record longer"
        )
    for name, value, size in (("linear", linear, structure.n_linear), ("shape", shape, len(structure.nonlinear))):
        check_floating(name, value)
        if value.shape != (len(signal), size):
            raise ValueError(
                f"`{name}`: expected {(len(signal), size)} for {structure.name} and {len(signal)} records, got "
                f"{tuple(value.shape)}; give what the moment fit of the same records returned"
            )
    if not any(p.gaussian for p in structure.processes):
        raise ValueError(f"`structure`: expected a noise such as WN, got {structure.name}; add WhiteNoise()")


def _refined(
    signal: Tensor,
    structure: ModelStructure,
    noise: BandSpectrum,
    at_tones: list[int],
    linear: Tensor,
    shape: Tensor,
    known: Tones | None,
    n_rounds: int,
) -> WhittleFit:
    """`refine_whittle` for items that can be fitted."""
    n_items, n_samples = signal.shape
    bins = Bins(n_samples, signal.device)
    tone_at = [structure.nonlinear[i] for i in at_tones]
    ramp_at = [k for k, p in enumerate(structure.processes) if p.deterministic]
    p, x = linear[:, noise.which], shape[:, noise.at_x]
    ramp = _Ramp(bins, signal, noise) if ramp_at else None
    tones = None
    slope, slope_sd = p.new_zeros(n_items), p.new_zeros(n_items)
    reached = torch.ones_like(slope, dtype=torch.bool)
    if ramp is not None and at_tones:
        # A ramp would hide tones of few cycles.
        slope, slope_sd, _ = ramp.measured(signal, None, p, x)
    for _ in range(n_rounds if at_tones or ramp_at else 1):
        if at_tones:
            tones = _measured_tones(signal, slope, len(at_tones), noise, p, x)
            tones = tones if known is None else _kept(known, tones, n_samples)
        if ramp is not None:
            slope, slope_sd, taken = ramp.measured(signal, tones, p, x)
        energy = bins.energy(ordinates_left(signal, tones, slope if ramp is not None else None))
        count = bins.count.expand(n_items, -1).clone()
        if ramp is not None:
            count[:, : taken.shape[-1]] -= taken
        if tones is not None:
            count -= bins.taken_by(tones.beta, tones.phase)
        count = count.clamp(min=LEAST_COUNT)
        p, x, reached = maximise(energy, count, bins, noise, p, x)
    linear[:, noise.which], shape[:, noise.at_x] = p, x
    if tones is not None:
        linear[:, tone_at] = tones.amplitude.square()
        shape[:, at_tones] = Sinusoid.to_unconstrained(tones.beta)
    linear[:, ramp_at] = slope.square()[:, None]
    linear, shape = structure.ordered(linear, shape)
    p, x = linear[:, noise.which], shape[:, noise.at_x]
    own, edge_sd = uncertainty(count, bins, noise, p, x)
    variance = noise.variances(bins, p, x)
    log_likelihood = -(bins.count * (2 * math.pi * variance).log() + energy / variance).sum(-1) / 2
    covariance, edge = _assembled(own, edge_sd, structure, noise, at_tones, tones, slope, slope_sd, ramp_at)
    return WhittleFit(linear, shape, covariance, edge, tones, slope, slope_sd, log_likelihood, energy, count, reached)


def ordinates_left(signal: Tensor, tones: Tones | None, slope: Tensor | None) -> Iterator[Tensor]:
    """Ordinates `(item, k)` of records without spectral lines and drift, for some items at a time."""
    n = signal.shape[-1]
    time = torch.arange(n, dtype=torch.float64, device=signal.device)
    size = items_at_once(n, CACHE)
    for first in range(0, max(len(signal), 1), size):
        part = slice(first, first + size)
        rest = signal[part].to(torch.float64)
        if tones is not None:
            rest = rest - items_of(tones, part).waveform(n)
        if slope is not None:
            rest = rest - slope[part, None] * time
        yield cosine_ordinates(rest)


class _Ramp:
    """A ramp `slope * t` by weighted least squares on the first ordinates, where all but 1e-6 of it shows."""

    def __init__(self, bins: Bins, signal: Tensor, noise: BandSpectrum) -> None:
        n_first = min(SINGLE, bins.n_samples - 1)
        self.shown = ramp_ordinates(bins.n_samples, signal.device)[1 : n_first + 1]
        self._bins, self._noise = bins, noise

    def measured(self, signal: Tensor, tones: Tones | None, p: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Slope without the sinusoids, its standard error, and the degrees of freedom that it takes by ordinate."""
        first = torch.cat([rest[:, 1 : len(self.shown) + 1] for rest in ordinates_left(signal, tones, None)])
        weight = 1 / self._noise.variances(self._bins, p, x)[:, : len(self.shown)]
        information = (weight * self.shown.square()).sum(-1)
        slope = (weight * self.shown * first).sum(-1) / information
        return slope, information.rsqrt(), weight * self.shown.square() / information[:, None]


def items_of(tones: Tones, part: slice | Tensor) -> Tones:
    """Spectral lines of some items."""
    return Tones(*(getattr(tones, f.name)[part] for f in fields(Tones)))


def _kept(known: Tones, found: Tones, n_samples: int) -> Tones:
    """Lines found that agree with the known ones, within half a cycle in the record, and else the known ones."""
    same = ((found.beta - known.beta).abs() < math.pi / n_samples).all(-1, keepdim=True)
    return Tones(*(torch.where(same, getattr(found, f.name), getattr(known, f.name)) for f in fields(Tones)))


def _measured_tones(signal: Tensor, slope: Tensor, n_tones: int, noise: BandSpectrum, p: Tensor, x: Tensor) -> Tones:
    """Spectral lines from high to low frequency over the fitted noise."""
    if not len(signal):
        return Tones(*(p.new_empty(0, n_tones) for _ in fields(Tones)))
    rest = signal.to(torch.float64)
    if bool((slope != 0).any()):
        rest = rest - slope[:, None] * torch.arange(rest.shape[-1], dtype=torch.float64, device=rest.device)
    found = find_tones(rest, n_tones, lambda f: noise.density(f, p, x))
    order = found.beta.argsort(-1, descending=True)
    return Tones(*(getattr(found, f.name).gather(-1, order) for f in fields(Tones)))


def _assembled(
    own: Tensor,
    edge_sd: Tensor,
    structure: ModelStructure,
    noise: BandSpectrum,
    at_tones: list[int],
    tones: Tones | None,
    slope: Tensor,
    slope_sd: Tensor,
    ramp_at: list[int],
) -> tuple[Tensor, Tensor]:
    """Covariance of all unknowns, sinusoids and drift on the diagonal, and `edge_sd` of all processes."""
    n_unknown = structure.n_linear + len(structure.nonlinear)
    covariance = own.new_zeros(len(slope), n_unknown, n_unknown)
    edge = own.new_zeros(len(slope), structure.n_linear)
    place = torch.tensor([*noise.which, *(structure.n_linear + i for i in noise.at_x)], device=own.device)
    covariance[:, place[:, None], place] = own
    edge[:, noise.which] = edge_sd
    if tones is not None:
        for n, i in enumerate(at_tones):
            k, wide = structure.nonlinear[i], structure.n_linear + i
            amplitude, sd = tones.amplitude[:, n], tones.amplitude_sd[:, n]
            part = tones.beta[:, n] / torch.pi
            covariance[:, k, k] = (2 * sd / amplitude).square()  # of ln a^2
            covariance[:, wide, wide] = (tones.beta_sd[:, n] / (torch.pi * part * (1 - part))).square()
            edge[:, k] = 2 * amplitude * sd
    for k in ramp_at:
        covariance[:, k, k] = (2 * slope_sd / slope).square()
        edge[:, k] = 2 * slope.abs() * slope_sd
    return covariance, edge


def _placed(fit: WhittleFit, usable: Tensor) -> WhittleFit:
    """Put items back into their places among all."""

    def placed(value: Any) -> Any:
        if isinstance(value, Tensor):
            return scattered(value, usable, usable.shape, False if value.dtype == torch.bool else torch.nan)
        return None if value is None else Tones(*(placed(part) for part in vars(value).values()))

    return WhittleFit(*(placed(value) for value in vars(fit).values()))
