"""A sum of noise processes as a least-squares problem: which parameters enter linearly, and which do not.

The wavelet variance is `nu_j = sum_k p_k u_jk(x)` with the linear parameters `p` (variances, squared amplitudes,
squared slopes) and, for AR1s and sinusoids, one other parameter each, here as `x = atanh phi` and `x = logit(beta/pi)`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse.noise.processes import AR1, Drift, Model, Process, Sinusoid, haar_kernel, haar_kernel_slope


@dataclass(frozen=True, eq=False)
class Composition:
    """What a model is made of.

    Attributes:
        processes: Without values; those of a kind in one row.
        held: Frequencies of sinusoids are known from elsewhere, and no unknowns of the moments.
    """

    processes: tuple[Process, ...]
    held: bool

    @property
    def name(self) -> str:
        """The sum in words, such as `2*AR1 + RW`."""
        symbols = [p.symbol for p in self.processes]
        times = {symbol: symbols.count(symbol) for symbol in symbols}
        return " + ".join(symbol if n == 1 else f"{n}*{symbol}" for symbol, n in times.items())

    @property
    def n_linear(self) -> int:
        """Linear unknowns, one for each process."""
        return len(self.processes)

    @property
    def curved(self) -> list[int]:
        """Processes with an unknown that is not linear."""
        return [
            k for k, p in enumerate(self.processes) if isinstance(p, AR1) or (isinstance(p, Sinusoid) and not self.held)
        ]

    @property
    def shaped(self) -> list[int]:
        """Processes with a parameter that is not linear, unknown or held."""
        return [k for k, p in enumerate(self.processes) if isinstance(p, (AR1, Sinusoid))]

    @property
    def places(self) -> list[int]:
        """Of each `p`, then of each `x`, among the parameters of the model."""
        linear, shape, at = [], [], 0
        for process in self.processes:
            if isinstance(process, AR1):
                shape.append(at)
                at += 1
            linear.append(at)
            at += 1
            if isinstance(process, Sinusoid):
                shape.append(at)
                at += 1
        return linear + shape

    def columns(self, tau: Tensor, shape: Tensor) -> Tensor:
        """Wavelet variances `u` of the processes with linear parameter one.

        Args:
            tau: `(level,)`.
            shape: `x` of the `shaped` processes, `(..., shaped)`.

        Returns:
            `(..., level, process)`.
        """
        values, at, one = [], iter(shape.unbind(-1)), torch.ones_like(tau[:1])
        for process in self.processes:
            if isinstance(process, AR1):
                value = process._wavelet_variance(tau, next(at)[..., None].tanh(), one)
            elif isinstance(process, Sinusoid):
                value = process._wavelet_variance(tau, one, torch.pi * next(at)[..., None].sigmoid())
            else:
                value = process._wavelet_variance(tau, one).expand(*shape.shape[:-1], len(tau))
            values.append(value)
        return torch.stack(values, -1)

    def wavelet_variance(self, tau: Tensor, linear: Tensor, shape: Tensor) -> Tensor:
        """Of the whole sum, `(..., level)`, from `p` and `x`."""
        return (self.columns(tau, shape) @ linear[..., None])[..., 0]

    def slopes(self, tau: Tensor, shape: Tensor) -> Tensor:
        """Derivatives `du/dx` of the `shaped` processes, `(..., level, shaped)`."""
        found = []
        for k, x in zip(self.shaped, shape[..., None].unbind(-2), strict=True):
            found.append(_ar1_slope(x, tau) if isinstance(self.processes[k], AR1) else _sinusoid_slope(x, tau))
        return torch.stack(found, -1) if found else shape.new_empty(*shape.shape[:-1], len(tau), 0)

    def params(self, linear: Tensor, shape: Tensor) -> Tensor:
        """Parameters `(..., parameter)` of the model, in its order, from `p` and `x`."""
        found, at = [], iter(shape.unbind(-1))
        for process, p in zip(self.processes, linear.unbind(-1), strict=True):
            if isinstance(process, AR1):
                found += [next(at).tanh(), p]
            elif isinstance(process, Sinusoid):
                found += [p.sqrt(), torch.pi * next(at).sigmoid()]
            elif isinstance(process, Drift):
                found += [p.sqrt()]
            else:
                found += [p]
        return torch.stack(found, -1) + 0.0  # no -0

    def model(self, linear: Tensor, shape: Tensor) -> Model:
        """The model with these parameters."""
        return Model(list(self.processes)).with_params(self.params(linear, shape))

    def ordered(self, linear: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
        """The same with AR1s from slow to fast and sinusoids from high to low frequency."""
        linear, shape = linear.clone(), shape.clone()
        for kind in (AR1, Sinusoid):
            which = [k for k, p in enumerate(self.processes) if isinstance(p, kind)]
            if len(which) > 1:
                at = [self.shaped.index(k) for k in which]
                order = shape[..., at].argsort(dim=-1, descending=True)
                shape[..., at] = shape[..., at].gather(-1, order)
                linear[..., which] = linear[..., which].gather(-1, order)
        return linear, shape


def shape_of(value: Tensor, kind: type[Process]) -> Tensor:
    """`x` of a `phi` or a `beta`."""
    return value.atanh() if kind is AR1 else (value / torch.pi).logit()


def _ar1_slope(x: Tensor, tau: Tensor) -> Tensor:
    """Derivative of `G(phi) / (1 - phi^2)` by `x = atanh phi`, `(..., level)`: `G' + 2 phi G / (1 - phi^2)`."""
    phi = x.tanh()
    value, slope = haar_kernel(phi, tau), haar_kernel_slope(phi, tau)
    return slope + 2 * phi * value / ((1 - phi) * (1 + phi))


def _sinusoid_slope(x: Tensor, tau: Tensor) -> Tensor:
    """Derivative of `2 r^2`, `r = sin(beta tau / 4)^2 / (tau sin(beta / 2))`, by `x = logit(beta / pi)`."""
    part = x.sigmoid()
    half, angle = torch.pi * part / 2, torch.pi * part * tau / 4
    ratio = angle.sin().square() / (tau * half.sin())
    slope = angle.sin() * angle.cos() / (2 * half.sin()) - ratio * half.cos() / (2 * half.sin())
    return 4 * ratio * slope * torch.pi * part * (1 - part)
