"""A sum of noise processes as a least-squares problem: which parameters enter linearly, and which do not.

The wavelet variance is `nu_j = sum_k p_k u_jk(x)` with the scale parameters `p` (variances, squared amplitudes, squared
slopes) and, for processes with a nonlinear parameter, one `x` each, see `Process`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse.noise.processes import Model, Process


@dataclass(frozen=True, eq=False)
class ModelStructure:
    """Processes of a model and which of their parameters a fit of moments finds.

    Attributes:
        processes: Processes without values; those of one class side by side.
        held: Whether frequencies of sinusoids are known from elsewhere, and no unknowns of the moments.
    """

    processes: tuple[Process, ...]
    held: bool

    @property
    def name(self) -> str:
        """The sum in words, such as `2*AR1 + RW`."""
        times = Counter(p.symbol for p in self.processes)
        return " + ".join(symbol if n == 1 else f"{n}*{symbol}" for symbol, n in times.items())

    @property
    def n_linear(self) -> int:
        """Number of scale parameters, one for each process."""
        return len(self.processes)

    @property
    def free_nonlinear(self) -> list[int]:
        """Processes with a nonlinear parameter that is unknown."""
        return [k for k in self.nonlinear if not (self.held and self.processes[k].has_line)]

    @property
    def nonlinear(self) -> list[int]:
        """Processes with a nonlinear parameter, unknown or held."""
        return [k for k, p in enumerate(self.processes) if p.shape_name is not None]

    @property
    def places(self) -> list[int]:
        """Position of each `p`, then of each `x`, among the parameters of the model."""
        names = [(process, name) for process in self.processes for name in process.parameters]
        linear = [at for at, (process, name) in enumerate(names) if name == process.scale_name]
        return linear + [at for at, (process, name) in enumerate(names) if name == process.shape_name]

    def columns(self, tau: Tensor, shape: Tensor) -> Tensor:
        """Wavelet variances `u` of the processes with `p = 1`.

        Args:
            tau: Filter lengths `(level,)`.
            shape: `x` of the `shaped` processes, `(..., shaped)`.

        Returns:
            `(..., level, process)`.
        """
        values = [process.unit_wavelet_variance(tau, x) for process, x in self.with_shapes(shape[..., None])]
        return torch.stack([value.expand(*shape.shape[:-1], len(tau)) for value in values], -1)

    def with_shapes(self, shape: Tensor) -> Iterator[tuple[Process, Tensor | None]]:
        """Each process with its `x`, None for a process without.

        Args:
            shape: `x` of the `shaped` processes, `(..., shaped, 1)`.
        """
        at = iter(shape.unbind(-2))
        for process in self.processes:
            yield process, None if process.shape_name is None else next(at)

    def wavelet_variance(self, tau: Tensor, linear: Tensor, shape: Tensor) -> Tensor:
        """Wavelet variance of the whole sum, `(..., level)`, from `p` and `x`."""
        return (self.columns(tau, shape) @ linear[..., None])[..., 0]

    def slopes(self, tau: Tensor, shape: Tensor) -> Tensor:
        """Derivatives `du/dx` of the `shaped` processes, `(..., level, shaped)`."""
        pairs = self.with_shapes(shape[..., None])
        found = [process.unit_wavelet_variance_slope(tau, x) for process, x in pairs if x is not None]
        return torch.stack(found, -1) if found else shape.new_empty(*shape.shape[:-1], len(tau), 0)

    def params(self, linear: Tensor, shape: Tensor) -> Tensor:
        """Parameters `(..., parameter)` of the model, in its order, from `p` and `x`."""
        pairs = zip(self.with_shapes(shape[..., None]), linear[..., None].unbind(-2), strict=True)
        found = [value for (process, x), p in pairs for value in process.from_scale_and_shape(p, x).values()]
        return torch.cat(found, -1) + 0.0  # no -0

    def model(self, linear: Tensor, shape: Tensor) -> Model:
        """The model with these parameters."""
        return Model(list(self.processes)).with_params(self.params(linear, shape))

    def ordered(self, linear: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
        """The same with processes of one class from slow to fast, and sinusoids from high to low frequency."""
        linear, shape = linear.clone(), shape.clone()
        for kind in {type(self.processes[k]) for k in self.nonlinear}:
            which = [k for k in self.nonlinear if type(self.processes[k]) is kind]
            if len(which) > 1:
                at = [self.nonlinear.index(k) for k in which]
                order = shape[..., at].argsort(dim=-1, descending=True)
                shape[..., at] = shape[..., at].gather(-1, order)
                linear[..., which] = linear[..., which].gather(-1, order)
        return linear, shape


def new_shape(smaller: ModelStructure, larger: ModelStructure) -> int | None:
    """Where a sum with one process more has a further nonlinear parameter, among its `x`; None where it has not."""
    before, after = ([type(m.processes[k]) for k in m.nonlinear] for m in (smaller, larger))
    return next((i for i, kind in enumerate(after) if before[i : i + 1] != [kind]), None)
