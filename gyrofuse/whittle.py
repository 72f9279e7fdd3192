"""Spectral refinement of a noise model: from the moments' estimate to the maximum of a Whittle likelihood.

The orthonormal DCT-II of a record, `y_k = sqrt(2/T) sum_t x_t cos(pi k (t + 1/2) / T)`, makes white noise and random
walks independent normal variables and AR1s nearly so, without differencing and without a taper. Their log likelihood
is `-1/2 sum_k (ln 2 pi v_k + y_k^2 / v_k)` with the variances `v_k = sum_m p_m u_mk(x)`, linear in the variances `p` of
the processes. For the processes here `u_mk` is exact at every length, see `_Bins`; the mean, `k = 0`, is left out.

Tones and a ramp are not noise: they are measured with the fitted spectrum, taken out, and the noise is fitted again.

References:
    P. Whittle, Arkiv foer Matematik 2, 1953; A. Contreras-Cristan et al., Journal of Econometrics 130, 2006.
    P. McCullagh, J. A. Nelder, Generalized Linear Models, chapter 8: the score for variances that add up.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gyrofuse._checks import check_floating, check_positive_integer
from gyrofuse._composition import Composition
from gyrofuse._nnls import nonnegative_least_squares
from gyrofuse.processes import AR1, Drift, Process, QuantizationNoise, RandomWalk, Sinusoid
from gyrofuse.tones import FEWEST_SAMPLES, Tones, _templates, find_tones

# Single ordinates up to here, then means over so many bands an octave; towards the highest frequency again so many
# bands each time the distance from it halves, which alternating AR1s need.
_SINGLE, _PER_OCTAVE, _PER_OCTAVE_FROM_TOP, _OCTAVES_FROM_TOP = 48, 16, 8, 4
_STEPS = 100
# A step that promises less, in nats, is not worth taking: 0.0001 standard deviations from the top.
_ENOUGH = 1e-8
_DAMPING, _MOST_DAMPING = 1e-3, 1e10
_LARGEST_STEP = 1.0  # of atanh phi
_LONGEST = 32  # time constant of an AR1 at the end of its range, in records
_TONE_HALF_WIDTH = 32  # bins on either side of a tone over which it takes degrees of freedom
# What remains of an ordinate that a tone or the ramp takes all of.
_LEAST_COUNT = 1e-3
_CHUNK = 2**19  # samples transformed at a time: few enough for the cache


@dataclass(frozen=True, eq=False)
class WhittleFit:
    """Where the likelihood is largest; NaN and not converged for items that could not be fitted.

    The unknowns are `ln p` of the processes followed by `x` of the shaped ones, as `Composition` has them.

    Attributes:
        linear: `p`, `(item, process)`: variances, squared amplitudes, the squared slope. A variance is 0 where raising
            it would not raise the likelihood.
        shape: `x`, `(item, shaped)`.
        covariance: Of the unknowns, from the Fisher information, `(item, unknown, unknown)`; zero rows for a variance
            at 0 and for the `x` of its AR1. NaN where the data do not tell unknowns apart.
        edge_sd: Standard deviation of `p` itself when variances at 0 are let off it, for upper limits,
            `(item, process)`.
        tones: From high to low frequency as in `shape`, `(item, tone)`; None without sinusoids.
        slope: Of the ramp, with its sign, `(item,)`, signal per sample; 0 without one.
        slope_sd: With the noise as fitted, `(item,)`: too small where a random walk was estimated as 0.
        log_likelihood: Of what is left without tones and ramp, `(item,)`, nats.
        converged: `(item,)`.
    """

    linear: Tensor
    shape: Tensor
    covariance: Tensor
    edge_sd: Tensor
    tones: Tones | None
    slope: Tensor
    slope_sd: Tensor
    log_likelihood: Tensor
    converged: Tensor


def refine_whittle(
    signal: Tensor, made_of: Composition, linear: Tensor, shape: Tensor, *, n_rounds: int = 2
) -> WhittleFit:
    """Maximise the Whittle likelihood of records from where a moment fit ended.

    Scoring for the variances, which stay >= 0 by non-negative least squares in each step, and for `atanh phi`,
    damped so that no step lowers the likelihood. The search finds the maximum next to the start only, and a weak tone
    that the start takes for noise stays noise. AR1s that alternate quickly, `phi` below -0.9, show at the ends of a
    record, which the likelihood sees in part only: at 4000 samples and `phi = -0.95` estimates scatter a tenth more and
    `atanh phi` is a quarter of its standard deviation too large.

    Args:
        signal: `(item, time)`, at least 32 samples. An item with missing samples is not fitted.
        made_of: Structure of the model.
        linear: `p` to start from, `(item, process)`; zeros may leave the edge again.
        shape: `x` to start from, `(item, shaped)`; frequencies of sinusoids are found anew.
        n_rounds: How often tones and ramp are measured and the noise is fitted; once where there are none.

    Returns:
        The fit, float64.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: Shapes that do not fit each other, too few samples, or a model without noise.
    """
    n_rounds = check_positive_integer("n_rounds", n_rounds)
    _check(signal, made_of, linear, shape)
    signal = signal.detach()
    linear, shape = linear.detach().to(torch.float64).clone(), shape.detach().to(torch.float64).clone()
    noise = _Noise(made_of)
    at_tones = [made_of.shaped.index(k) for k in made_of.shaped if isinstance(made_of.processes[k], Sinusoid)]
    started = linear[:, noise.which]
    usable = signal.sum(-1, dtype=torch.float64).isfinite() & (signal != signal[:, :1]).any(-1)
    usable &= (started >= 0).all(-1) & (started.sum(-1) > 0) & started.isfinite().all(-1)
    usable &= shape[:, noise.at_x].isfinite().all(-1)
    whole = _refined(signal[usable], made_of, noise, at_tones, linear[usable], shape[usable], n_rounds)
    return _placed(whole, usable)


def _check(signal: Tensor, made_of: Composition, linear: Tensor, shape: Tensor) -> None:
    check_floating("signal", signal)
    if signal.ndim != 2 or signal.shape[-1] < FEWEST_SAMPLES:
        raise ValueError(
            f"`signal`: expected (item, time) with at least {FEWEST_SAMPLES} samples, got shape "
            f"{tuple(signal.shape)}; flatten the batch, or record longer"
        )
    for name, value, size in (("linear", linear, made_of.n_linear), ("shape", shape, len(made_of.shaped))):
        check_floating(name, value)
        if value.shape != (len(signal), size):
            raise ValueError(
                f"`{name}`: expected {(len(signal), size)} for {made_of.name} and {len(signal)} records, got "
                f"{tuple(value.shape)}; give what the moment fit of the same records returned"
            )
    if all(isinstance(p, (Sinusoid, Drift)) for p in made_of.processes):
        raise ValueError(f"`made_of`: expected a noise such as WN, got {made_of.name}; add WhiteNoise()")


def _refined(
    signal: Tensor,
    made_of: Composition,
    noise: _Noise,
    at_tones: list[int],
    linear: Tensor,
    shape: Tensor,
    n_rounds: int,
) -> WhittleFit:
    """The same for items that can be fitted."""
    n_items, n_samples = signal.shape
    bins = _Bins(n_samples, signal.device)
    tone_at = [made_of.shaped[i] for i in at_tones]
    ramp_at = [k for k, p in enumerate(made_of.processes) if isinstance(p, Drift)]
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
        if ramp is not None:
            slope, slope_sd, taken = ramp.measured(signal, tones, p, x)
        energy = bins.energy(signal, tones, slope if ramp is not None else None)
        count = bins.count.expand(n_items, -1).clone()
        if ramp is not None:
            count[:, : taken.shape[-1]] -= taken
        if tones is not None:
            count -= bins.taken_by(tones)
        p, x, reached = _maximise(energy, count.clamp(min=_LEAST_COUNT), bins, noise, p, x)
    linear[:, noise.which], shape[:, noise.at_x] = p, x
    if tones is not None:
        linear[:, tone_at] = tones.amplitude.square()
        shape[:, at_tones] = (tones.beta / torch.pi).logit()
    linear[:, ramp_at] = slope.square()[:, None]
    linear, shape = made_of.ordered(linear, shape)
    p, x = linear[:, noise.which], shape[:, noise.at_x]
    own, edge_sd = _uncertainty(count.clamp(min=_LEAST_COUNT), bins, noise, p, x)
    variance = noise.variances(bins, p, x)
    log_likelihood = -(bins.count * (2 * math.pi * variance).log() + energy / variance).sum(-1) / 2
    covariance, edge = _assembled(own, edge_sd, made_of, noise, at_tones, tones, slope, slope_sd, ramp_at)
    return WhittleFit(linear, shape, covariance, edge, tones, slope, slope_sd, log_likelihood, reached)


class _Noise:
    """The processes of a model that have a spectrum.

    Attributes:
        which: Their places among the processes.
        at_x: Places of the AR1s among the shaped processes.
        moving: Places of the AR1s in `which`.
    """

    def __init__(self, made_of: Composition) -> None:
        self.which = [k for k, p in enumerate(made_of.processes) if not isinstance(p, (Sinusoid, Drift))]
        self.processes: list[Process] = [made_of.processes[k] for k in self.which]
        self.moving = [i for i, p in enumerate(self.processes) if isinstance(p, AR1)]
        self.at_x = [made_of.shaped.index(self.which[i]) for i in self.moving]

    def columns(self, bins: _Bins, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`u` `(item, bin, process)`, and `du/dx` and `d2u/dx2` `(item, bin, AR1)`, for `x` `(item, AR1)`."""
        values, slopes, bends, at = [], [], [], iter(x.unbind(-1))
        for process in self.processes:
            if isinstance(process, AR1):
                value, slope, bend = bins.ar1(next(at).tanh())
                slopes.append(slope)
                bends.append(bend)
            elif isinstance(process, RandomWalk):
                value = bins.mean_of(0.25 / bins.sine).expand(len(x), -1)
            elif isinstance(process, QuantizationNoise):
                value = bins.mean_of(4 * bins.sine + bins.ends).expand(len(x), -1)
            else:
                value = bins.mean_of(process._spectrum(bins.frequency, torch.ones_like(bins.frequency[..., :1])))
                value = value.expand(len(x), -1)
            values.append(value)
        if not slopes:
            empty = x.new_empty(len(x), len(bins.count), 0)
            return torch.stack(values, -1), empty, empty
        return torch.stack(values, -1), torch.stack(slopes, -1), torch.stack(bends, -1)

    def variances(self, bins: _Bins, p: Tensor, x: Tensor) -> Tensor:
        """`v`, `(item, bin)`."""
        return (self.columns(bins, x)[0] @ p[..., None])[..., 0]

    def density(self, f: Tensor, p: Tensor, x: Tensor) -> Tensor:
        """Spectral density `(item, frequency)`, cycles per sample."""
        total, at = p.new_zeros(len(p), len(f)), iter(x.unbind(-1))
        for process, own in zip(self.processes, p.unbind(-1), strict=True):
            variance = own[:, None]
            if isinstance(process, AR1):
                total += process._spectrum(f, next(at)[:, None].tanh(), variance)
            else:
                total += process._spectrum(f, variance)
        return total


class _Bins:
    """Single ordinates and bands of them, and what processes of variance one give there.

    With `s = sin(pi k / 2T)`, `c = cos(pi k / 2T)`: white noise 1, random walk `1 / (4 s^2)`, both exact and
    uncorrelated. The inverse covariance of an AR1 is that of a process on a circle of mirror images, whose eigenvalues
    are `D = (1 - phi)^2 + 4 phi s^2`, and something at the two ends; by the matrix inversion lemma
    `u_k = 1/D - (4 c^2 / T) h / D^2`, `h = phi (1 - phi) (1 -+ phi^T) / (1 + phi)`, `-` for even and `+` for odd `k`.
    Quantisation noise has the covariance of second differences and more at the ends: `4 s^2 + 4 c^2 / T`.

    Attributes:
        count: Ordinates, `(bin,)`.
        sine: `s^2` at two places of each band, its middle -+ the standard deviation of its places: the mean there is
            that of all to third order, `(2, bin)`.
        ends: `4 c^2 / T`, `(2, bin)`.
        frequency: Cycles per sample, `(2, bin)`.
        sign: Mean of `(-1)^k`, `(bin,)`.
    """

    def __init__(self, n_samples: int, device: torch.device) -> None:
        self.n_samples = n_samples
        self.edges = _edges(n_samples)
        edges = torch.tensor(self.edges, dtype=torch.float64, device=device)
        self.count = edges.diff()
        middle, width = (edges[:-1] + edges[1:] - 1) / 2, ((self.count.square() - 1) / 12).sqrt()
        k = torch.stack([middle - width, middle + width])
        angle = math.pi / (2 * n_samples) * k
        self.sine, self.ends = angle.sin().square(), 4 / n_samples * angle.cos().square()
        self.frequency = k / (2 * n_samples)
        first_even = 1 - 2 * torch.remainder(edges[:-1], 2)
        self.sign = torch.where(torch.remainder(self.count, 2) == 1, first_even / self.count, 0.0)

    @staticmethod
    def mean_of(values: Tensor) -> Tensor:
        """Of the two places, `(2, bin)` -> `(bin,)`."""
        return (values[..., 0, :] + values[..., 1, :]) / 2

    def ar1(self, phi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`u`, its derivative by `x = atanh phi`, and the second one but for the ends, all `(item, bin)`."""
        z = phi[:, None, None]  # (item, 1, 1)
        n, sign = self.n_samples, self.sign
        size = z.abs().clamp(min=1e-300).log()
        odd_power = -1.0 if n % 2 else 1.0
        before = torch.exp((n - 1) * size) * torch.where(z < 0, -odd_power, 1.0)  # phi^(T-1)
        mirrored, mirrored_slope = 1 - sign * before * z, -sign * n * before
        edge = z * (1 - z) / (1 + z)
        edge_slope = (1 - 2 * z - z.square()) / (1 + z).square()
        h, h_slope = edge * mirrored, edge_slope * mirrored + edge * mirrored_slope
        d, d_slope = (1 - z).square() + 4 * z * self.sine, 4 * self.sine - 2 * (1 - z)
        value = (1 - self.ends * h / d) / d
        slope = (-d_slope - self.ends * (h_slope - 2 * h * d_slope / d)) / d.square()
        inside = (1 - z) * (1 + z)  # d phi / dx
        bend = (2 * d_slope.square() / d - 2) / d.square() * inside.square() - 2 * z * inside * slope
        return self.mean_of(value), self.mean_of(slope * inside), self.mean_of(bend)

    def energy(self, signal: Tensor, tones: Tones | None, slope: Tensor | None) -> Tensor:
        """Sums of squared ordinates of what tones and ramp leave, `(item, bin)`."""
        single = min(_SINGLE, self.n_samples - 1)
        parts = []
        for values in _transformed(signal, tones, slope):
            power = values.square_()
            bands = [power[:, a:b].sum(-1, keepdim=True) for a, b in itertools.pairwise(self.edges[single:])]
            parts.append(torch.cat([power[:, 1 : single + 1], *bands], -1))
        return torch.cat(parts)

    def taken_by(self, tones: Tones) -> Tensor:
        """Degrees of freedom that amplitude, phase and frequency of the tones take from each bin, `(item, bin)`."""
        n = self.n_samples
        edges = torch.tensor(self.edges, device=tones.beta.device)
        total = self.count.new_zeros(len(tones.beta), len(self.count))
        reach = torch.arange(-_TONE_HALF_WIDTH, _TONE_HALF_WIDTH + 1, device=tones.beta.device)
        for beta, phase in zip(tones.beta.unbind(-1), tones.phase.unbind(-1), strict=True):
            k = (beta * n / math.pi).round()[:, None] + reach  # (item, bin)
            inside = (k >= 1) & (k <= n - 1)
            even, odd, slopes = _templates(beta[:, None], k, n)
            turn = (phase + beta * (n + 1) / 2)[:, None]  # in the middle of the record
            moved = turn.sin() * slopes[0] + turn.cos() * slopes[1]
            columns = torch.stack([even, odd, moved / n], -1) * inside[..., None]
            leverage = torch.linalg.qr(columns)[0].square().sum(-1)
            place = torch.bucketize(k.clamp(1, n - 1).long(), edges, right=True) - 1
            total.scatter_add_(-1, place, leverage * inside)
        return total


def _edges(n_samples: int) -> list[int]:
    """First ordinate of each bin, and the one after the last."""
    single = min(_SINGLE, n_samples - 1)
    half = n_samples // 2
    rising = math.ceil(_PER_OCTAVE * math.log2(max(half / (single + 1), 1)))
    places = [round((single + 1) * 2 ** (i / _PER_OCTAVE)) for i in range(rising)]
    falling = _PER_OCTAVE_FROM_TOP * _OCTAVES_FROM_TOP
    places += [n_samples - round(half * 2 ** (-i / _PER_OCTAVE_FROM_TOP)) for i in range(falling + 1)]
    return [*range(1, single + 1), *sorted({k for k in places if single < k < n_samples}), n_samples]


def _ordinates(signal: Tensor) -> Tensor:
    """Orthonormal DCT-II `(item, k)` of records `(item, time)`, without the mean: its ordinate 0 is 0.

    One transform of the even samples followed by the odd ones backwards (Makhoul, 1980). Lengths with a large prime
    factor take some ten times as long.
    """
    n = signal.shape[-1]
    if not len(signal):
        return signal
    signal = signal - signal.mean(-1, keepdim=True)
    spectrum = torch.fft.rfft(torch.cat([signal[:, ::2], signal[:, 1::2].flip(-1)], -1))
    k = torch.arange(spectrum.shape[-1], dtype=torch.float64, device=signal.device)
    spectrum *= torch.polar(torch.full_like(k, math.sqrt(2 / n)), -math.pi / (2 * n) * k)
    values = torch.cat([spectrum.real, -spectrum.imag[:, 1 : (n + 1) // 2].flip(-1)], -1)
    values[:, 0] = 0.0
    return values


def _transformed(signal: Tensor, tones: Tones | None, slope: Tensor | None) -> Iterator[Tensor]:
    """Ordinates `(item, k)` of what tones and ramp leave, for some items at a time."""
    n = signal.shape[-1]
    time = torch.arange(n, dtype=torch.float64, device=signal.device)
    size = max(_CHUNK // n, 1)
    for first in range(0, max(len(signal), 1), size):
        part = slice(first, first + size)
        rest = signal[part].to(torch.float64)
        if tones is not None:
            rest = rest - _of(tones, part).waveform(n)
        if slope is not None:
            rest = rest - slope[part, None] * time
        yield _ordinates(rest)


class _Ramp:
    """A ramp `slope * t` by weighted least squares on the first ordinates, where all but 1e-6 of it shows."""

    def __init__(self, bins: _Bins, signal: Tensor, noise: _Noise) -> None:
        time = torch.arange(bins.n_samples, dtype=torch.float64, device=signal.device)
        n_first = min(_SINGLE, bins.n_samples - 1)
        self.shown = _ordinates(time[None])[0, 1 : n_first + 1]
        self._bins, self._noise = bins, noise

    def measured(self, signal: Tensor, tones: Tones | None, p: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Slope without the tones, its standard deviation, and the degrees of freedom that it takes by ordinate."""
        first = torch.cat([rest[:, 1 : len(self.shown) + 1] for rest in _transformed(signal, tones, None)])
        weight = 1 / self._noise.variances(self._bins, p, x)[:, : len(self.shown)]
        information = (weight * self.shown.square()).sum(-1)
        slope = (weight * self.shown * first).sum(-1) / information
        return slope, information.rsqrt(), weight * self.shown.square() / information[:, None]


def _of(tones: Tones, part: slice) -> Tones:
    return Tones(*(getattr(tones, f.name)[part] for f in fields(Tones)))


def _measured_tones(signal: Tensor, slope: Tensor, n_tones: int, noise: _Noise, p: Tensor, x: Tensor) -> Tones:
    """Tones from high to low frequency over the noise as fitted."""
    if not len(signal):
        return Tones(*(p.new_empty(0, n_tones) for _ in fields(Tones)))
    rest = signal.to(torch.float64)
    if bool((slope != 0).any()):
        rest = rest - slope[:, None] * torch.arange(rest.shape[-1], dtype=torch.float64, device=rest.device)
    found = find_tones(rest, n_tones, lambda f: noise.density(f, p, x))
    order = found.beta.argsort(-1, descending=True)
    return Tones(*(getattr(found, f.name).gather(-1, order) for f in fields(Tones)))


def _maximise(
    energy: Tensor, count: Tensor, bins: _Bins, noise: _Noise, p: Tensor, x: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Damped scoring; returns `p`, `x` and whether the top was reached, `(item,)`.

    With the observed information where it is positive definite: near the top of a flat likelihood it ends in a few
    steps, for which the Fisher information takes hundreds.

    A step maximises the quadratic model over `p >= 0`: with `x` eliminated it is a non-negative least-squares problem,
    so that a variance is 0 exactly where raising it does not help, and leaves 0 where it does. The `x` of an AR1
    without variance stays where it is, as does one at the end of its range that would go on.
    """
    unit = energy.sum(-1, keepdim=True) / count.sum(-1, keepdim=True)
    mean = (energy / count / unit).clamp(min=torch.finfo(energy.dtype).tiny)
    p, x = p / unit, x.clone()
    end = math.atanh(math.exp(-1 / (_LONGEST * bins.n_samples)))
    n_linear = p.shape[-1]
    columns, slopes, bends = noise.columns(bins, x)
    deviance = _deviance(mean, count, (columns @ p[..., None])[..., 0])
    damping = torch.full_like(deviance, _DAMPING)
    done = ~deviance.isfinite()
    reached = torch.zeros_like(done)
    for _ in range(_STEPS):
        todo = (~done).nonzero()[:, 0]
        if not len(todo):
            break
        u, own_p, own_x = columns[todo], p[todo], x[todo]
        gradient, information, observed = _score(mean[todo], count[todo], u, slopes[todo], bends[todo], own_p, noise)
        by_x = gradient[:, n_linear:]
        moving = (own_p[:, noise.moving] > 0) & ~((own_x >= end) & (by_x > 0)) & ~((own_x <= -end) & (by_x < 0))
        active = torch.cat([torch.ones_like(own_p, dtype=torch.bool), moving], -1).to(p)
        gradient = gradient * active
        size = information.diagonal(dim1=-2, dim2=-1) * active
        more = torch.diag_embed(damping[todo, None] * size + (1 - active))
        both = active[:, :, None] * active[:, None, :]
        damped = observed * both + more
        hollow = torch.linalg.cholesky_ex(damped)[1] > 0
        damped = torch.where(hollow[:, None, None], information * both + more, damped)
        # x = C^-1 (g_x - B' (p - p_0)) eliminated
        corner, side = damped[:, n_linear:, n_linear:], damped[:, :n_linear, n_linear:]
        solved = torch.linalg.solve_ex(corner, torch.cat([side.mT, gradient[:, n_linear:, None]], -1))[0]
        gram = damped[:, :n_linear, :n_linear] - side @ solved[..., :-1]
        moment = gradient[:, :n_linear] - (side @ solved[..., -1:])[..., 0] + (gram @ own_p[..., None])[..., 0]
        new_p = nonnegative_least_squares(gram, moment)
        step_p = new_p - own_p
        step_x = solved[..., -1] - (solved[..., :-1] @ step_p[..., None])[..., 0]
        new_x = (own_x + step_x.clamp(-_LARGEST_STEP, _LARGEST_STEP)).clamp(-end, end)
        promised = (gradient * torch.cat([step_p, step_x], -1)).sum(-1) * (1 + damping[todo])
        new_columns, new_slopes, new_bends = noise.columns(bins, new_x)
        new = _deviance(mean[todo], count[todo], (new_columns @ new_p[..., None])[..., 0])
        better = new < deviance[todo]
        at = todo[better]
        p[at], x[at], deviance[at] = new_p[better], new_x[better], new[better]
        columns[at], slopes[at], bends[at] = new_columns[better], new_slopes[better], new_bends[better]
        damping[todo] = torch.where(better, damping[todo] / 10, damping[todo] * 10).clamp(min=1e-12)
        reached[todo] = promised < _ENOUGH
        done[todo] = (promised < _ENOUGH) | (damping[todo] > _MOST_DAMPING) | ~promised.isfinite()
    return p * unit, x, reached


def _deviance(mean: Tensor, count: Tensor, variance: Tensor) -> Tensor:
    """Minus twice the log likelihood, less that of variances that fit every bin: small numbers keep their digits."""
    ratio = mean / variance
    return (count * (ratio - 1 - ratio.log())).sum(-1).nan_to_num(nan=torch.inf)


def _score(
    mean: Tensor, count: Tensor, columns: Tensor, slopes: Tensor, bends: Tensor, p: Tensor, noise: _Noise
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradient of the log likelihood by `(p, x)`, `(item, unknown)`, and its expected and its observed curvature.

    The latter two, the Fisher and the observed information, are `(item, unknown, unknown)`.
    """
    variance = (columns @ p[..., None])[..., 0]
    own = p[:, None, noise.moving]
    jacobian = torch.cat([columns, slopes * own], -1) / variance[..., None]  # d ln v
    weighted = jacobian * (count / 2)[..., None]
    misfit = (mean / variance - 1)[..., None]
    gradient = (weighted.mT @ misfit)[..., 0]
    information = jacobian.mT @ weighted
    observed = information + 2 * jacobian.mT @ (weighted * misfit)
    # less d2 v, which an AR1 has by its variance and x, and by x twice
    pull = (count / 2 / variance)[..., None] * misfit
    mixed, twice = (pull * slopes).sum(-2), (pull * bends * own).sum(-2)  # (item, AR1)
    for i, k in enumerate(noise.moving):
        place = p.shape[-1] + i
        observed[:, k, place] -= mixed[:, i]
        observed[:, place, k] -= mixed[:, i]
        observed[:, place, place] -= twice[:, i]
    return gradient, information, observed


def _uncertainty(count: Tensor, bins: _Bins, noise: _Noise, p: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """Covariance of `(ln p, x)`, `(item, unknown, unknown)`, and the `sd` of `p` off its edge, `(item, process)`."""
    columns, slopes, bends = noise.columns(bins, x)
    variance = (columns @ p[..., None])[..., 0]
    information = _score(variance, count, columns, slopes, bends, p, noise)[1]
    there = p > 0
    active = torch.cat([there, there[:, noise.moving]], -1)
    natural = _inverse(information, active)
    scale = torch.cat([torch.where(there, 1 / p, 0.0), torch.ones_like(x)], -1)
    off_edge = _inverse(information, torch.cat([torch.ones_like(there), there[:, noise.moving]], -1))
    edge_sd = off_edge.diagonal(dim1=-2, dim2=-1)[:, : p.shape[-1]].sqrt()
    return natural * scale[:, :, None] * scale[:, None, :], edge_sd


def _inverse(information: Tensor, active: Tensor) -> Tensor:
    """Inverse over the active unknowns, zero elsewhere; NaN where there is none to rounding."""
    size = information.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(information.dtype).tiny).rsqrt()
    keep = (active[:, :, None] & active[:, None, :]).to(information)
    scaled = information * size[:, :, None] * size[:, None, :] * keep + torch.diag_embed((~active).to(information))
    root, failed = torch.linalg.cholesky_ex(scaled)
    inverse = torch.cholesky_inverse(root) * size[:, :, None] * size[:, None, :] * keep
    return torch.where((failed > 0)[:, None, None], torch.where(keep > 0, torch.nan, 0.0), inverse)


def _assembled(
    own: Tensor,
    edge_sd: Tensor,
    made_of: Composition,
    noise: _Noise,
    at_tones: list[int],
    tones: Tones | None,
    slope: Tensor,
    slope_sd: Tensor,
    ramp_at: list[int],
) -> tuple[Tensor, Tensor]:
    """Covariance of all unknowns, those of tones and ramp on the diagonal, and `edge_sd` of all processes."""
    n_unknown = made_of.n_linear + len(made_of.shaped)
    covariance = own.new_zeros(len(slope), n_unknown, n_unknown)
    edge = own.new_zeros(len(slope), made_of.n_linear)
    place = torch.tensor([*noise.which, *(made_of.n_linear + i for i in noise.at_x)], device=own.device)
    covariance[:, place[:, None], place] = own
    edge[:, noise.which] = edge_sd
    if tones is not None:
        for n, i in enumerate(at_tones):
            k, wide = made_of.shaped[i], made_of.n_linear + i
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

    def placed(value: Tensor) -> Tensor:
        missing = False if value.dtype == torch.bool else torch.nan
        whole = value.new_full((len(usable), *value.shape[1:]), missing)
        whole[usable] = value
        return whole

    tones = fit.tones
    if tones is not None:
        tones = Tones(*(placed(getattr(tones, f.name)) for f in fields(Tones)))
    return WhittleFit(
        placed(fit.linear),
        placed(fit.shape),
        placed(fit.covariance),
        placed(fit.edge_sd),
        tones,
        placed(fit.slope),
        placed(fit.slope_sd),
        placed(fit.log_likelihood),
        placed(fit.converged),
    )
