"""Variances of the cosine ordinates of a record, in bins: what noise processes give there, and what was measured."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import torch
from torch import Tensor

from gyrofuse._base.transforms import tone_in_cosines
from gyrofuse.fitting.structure import Composition
from gyrofuse.noise.processes import AR1, Drift, Process, QuantizationNoise, RandomWalk, Sinusoid

# Single ordinates up to here, then means over so many bands an octave; towards the highest frequency again so many
# bands each time the distance from it halves, which alternating AR1s need.
SINGLE, _PER_OCTAVE, _PER_OCTAVE_FROM_TOP, _OCTAVES_FROM_TOP = 48, 16, 8, 4
_TONE_HALF_WIDTH = 32  # bins on either side of a tone over which it takes degrees of freedom


class Noise:
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

    def columns(self, bins: Bins, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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

    def variances(self, bins: Bins, p: Tensor, x: Tensor) -> Tensor:
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


class Bins:
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

    def energy(self, ordinates: Iterable[Tensor]) -> Tensor:
        """Sums of squared ordinates, given for some items `(item, k)` at a time, `(item, bin)`."""
        single = min(SINGLE, self.n_samples - 1)
        parts = []
        for values in ordinates:
            power = values.square()
            bands = [power[:, a:b].sum(-1, keepdim=True) for a, b in itertools.pairwise(self.edges[single:])]
            parts.append(torch.cat([power[:, 1 : single + 1], *bands], -1))
        return torch.cat(parts)

    def taken_by(self, betas: Tensor, phases: Tensor) -> Tensor:
        """Degrees of freedom that amplitude, phase and frequency of tones take from each bin, `(item, bin)`.

        Args:
            betas: `(item, tone)`, rad per sample.
            phases: `(item, tone)`, rad, of sines at `t = 1, 2, ..`.
        """
        n = self.n_samples
        edges = torch.tensor(self.edges, device=betas.device)
        total = self.count.new_zeros(len(betas), len(self.count))
        reach = torch.arange(-_TONE_HALF_WIDTH, _TONE_HALF_WIDTH + 1, device=betas.device)
        for beta, phase in zip(betas.unbind(-1), phases.unbind(-1), strict=True):
            k = (beta * n / math.pi).round()[:, None] + reach  # (item, bin)
            inside = (k >= 1) & (k <= n - 1)
            even, odd, slopes = tone_in_cosines(beta[:, None], k, n)
            turn = (phase + beta * (n + 1) / 2)[:, None]  # in the middle of the record
            moved = turn.sin() * slopes[0] + turn.cos() * slopes[1]
            columns = torch.stack([even, odd, moved / n], -1) * inside[..., None]
            leverage = torch.linalg.qr(columns)[0].square().sum(-1)
            place = torch.bucketize(k.clamp(1, n - 1).long(), edges, right=True) - 1
            total.scatter_add_(-1, place, leverage * inside)
        return total


def _edges(n_samples: int) -> list[int]:
    """First ordinate of each bin, and the one after the last."""
    single = min(SINGLE, n_samples - 1)
    half = n_samples // 2
    rising = math.ceil(_PER_OCTAVE * math.log2(max(half / (single + 1), 1)))
    places = [round((single + 1) * 2 ** (i / _PER_OCTAVE)) for i in range(rising)]
    falling = _PER_OCTAVE_FROM_TOP * _OCTAVES_FROM_TOP
    places += [n_samples - round(half * 2 ** (-i / _PER_OCTAVE_FROM_TOP)) for i in range(falling + 1)]
    return [*range(1, single + 1), *sorted({k for k in places if single < k < n_samples}), n_samples]
