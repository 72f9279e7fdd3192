"""A noise model is a sum of independent processes; a process is a model of one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial, reduce
from operator import add
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.func import jvp

from gyrofuse._base.checks import check_batch, check_positive, check_positive_integer, own_generator
from gyrofuse.noise.estimation import EstimatedFrom

Parameter = float | Tensor | None


class SpectralLine(NamedTuple):
    """Power concentrated at one frequency.

    Attributes:
        frequency: `(...)`, cycles per sample, in `(0, 1/2]`.
        power: `(...)`, signal^2, of the lines at plus and minus `frequency` together.
    """

    frequency: Tensor
    power: Tensor


class Model:
    """Sum of independent noise processes, made with `+`, `sum` or `2 * AR1()`.

    Parameters are numbers, tensors with batch dimensions `(...)`, or `None`: to be estimated. A process whose
    copies cannot be told apart (two white noises are one white noise) may appear once.

    Args:
        models: Processes or models, flattened into `processes`.
        estimated_from: Record that the parameters were estimated from, with their covariance in the order of `params`;
            None for a model whose numbers are known. A sum of models has none.

    Raises:
        ValueError: No process, one that may appear once appears again, or a covariance of other parameters.
        TypeError: Not a process or model.
    """

    estimated_from: EstimatedFrom | None = None

    def __init__(self, models: Iterable[Model], *, estimated_from: EstimatedFrom | None = None):
        models = tuple(models)
        for model in models:
            if not isinstance(model, Model):
                raise TypeError(f"`models`: expected processes such as AR1(), got {model!r}")
        self._processes = tuple(process for model in models for process in model.processes)
        if not self._processes:
            raise ValueError("`models`: expected at least one process, got none")
        for process in self._processes:
            kind = type(process)
            if not kind.repeatable and sum(isinstance(other, kind) for other in self._processes) > 1:
                raise ValueError(
                    f"`models`: {kind.__name__} appears more than once, and its copies cannot be told apart; "
                    f"use one {kind.__name__} with the sum of the {kind.scale_name}s"
                )
        if estimated_from is not None:
            if not estimated_from.fits(self.params.shape):
                raise ValueError(
                    f"`estimated_from`: expected a covariance of parameters {tuple(self.params.shape)}, got shape "
                    f"{tuple(estimated_from.param_cov.shape)}"  # type: ignore[union-attr]
                )
            self.estimated_from = estimated_from

    @property
    def processes(self) -> tuple[Any, ...]:
        """The processes of the sum, each a `Process`, in order."""
        return self._processes

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names such as `white_noise.variance` and, for what may repeat, even once, `ar1_1.phi`."""
        return tuple(name for name, _ in self._named())

    @property
    def params(self) -> Tensor:
        """Parameters `(..., parameter)` in float64, in the order of `param_names`.

        Raises:
            ValueError: A parameter is to be estimated.
        """
        values = [column for _, columns in self._known() for column in columns.values()]
        return torch.cat(torch.broadcast_tensors(*values), dim=-1)

    def with_params(self, params: Tensor, *, estimated_from: EstimatedFrom | None = None) -> Model:
        """Return the same sum with parameters `(..., parameter)` in the order of `param_names`.

        Args:
            params: `(..., parameter)`.
            estimated_from: Record that these were estimated from; by default they count as known.

        Raises:
            ValueError: Wrong number of parameters, or a value outside its domain.
        """
        if params.ndim == 0 or params.shape[-1] != len(self.param_names):
            raise ValueError(
                f"`params`: expected (..., {len(self.param_names)}) for {', '.join(self.param_names)}, "
                f"got shape {tuple(params.shape)}"
            )
        columns = iter(params.unbind(-1))
        kinds: list[type[Any]] = [type(p) for p in self.processes]  # each has a constructor of its own
        given = [{name: next(columns) for name in p.parameters} for p in self.processes]
        processes = [kind(**own) for kind, own in zip(kinds, given, strict=True)]
        return Model(processes, estimated_from=estimated_from)

    def scaled(self, factor: float) -> Model:
        """Return the model of the signal times a factor: in another unit, say.

        Raises:
            ValueError: A parameter is to be estimated, or the factor is not positive.
        """
        factor = check_positive("factor", factor)
        scales = [
            (factor if process.squared else factor**2) if name == process.scale_name else 1.0
            for process in self.processes
            for name in process.parameters
        ]
        scale = self.params.new_tensor(scales)
        record = None if self.estimated_from is None else self.estimated_from.scaled(scale)
        return self.with_params(self.params * scale, estimated_from=record)

    def wavelet_variance(self, n_levels: int) -> Tensor:
        """Theoretical Haar wavelet variance `(..., level)` of levels 1 to `n_levels`, signal^2, float64.

        Differentiable in the parameters; a sum over the processes.

        Raises:
            ValueError: A parameter is to be estimated, or `n_levels` is below 1.
        """
        n_levels = check_positive_integer("n_levels", n_levels)
        tau = 2.0 ** torch.arange(1, n_levels + 1, dtype=torch.float64, device=self._device())
        return _sum([process._wavelet_variance(tau, **columns) for process, columns in self._known()])

    def spectrum(self, f: Tensor | Sequence[float] | float) -> Tensor:
        """Continuous part of the two-sided power spectral density per sample, float64.

        Its integral over `(-1/2, 1/2)` is the variance where that is finite. A random walk has a
        pseudo-spectrum, infinite at 0; a sinusoid has none and appears in `lines`; a drift is a mean, not
        noise, and has none.

        Args:
            f: Frequencies `(frequency,)` or of any other shape, cycles per sample.

        Returns:
            `(..., frequency)`, signal^2 per (cycle per sample).

        Raises:
            ValueError: A parameter is to be estimated.
        """
        device = f.device if isinstance(f, Tensor) else self._device()
        f = torch.as_tensor(f, dtype=torch.float64, device=device)
        density = _sum([process._spectrum(f.flatten(), **columns) for process, columns in self._known(device)])
        return density.reshape(density.shape[:-1] + f.shape)

    def spectrum_jacobian(self, f: Tensor) -> Tensor:
        """Derivatives of the spectrum with respect to the parameters, `(..., frequency, parameter)`, float64.

        Args:
            f: Frequencies `(frequency,)`, cycles per sample.

        Raises:
            ValueError: A parameter is to be estimated.
        """
        slopes = [_slope(p, f, columns, name) for p, columns in self._known(f.device) for name in columns]
        return torch.stack(torch.broadcast_tensors(*slopes), dim=-1)

    @property
    def lines(self) -> tuple[SpectralLine, ...]:
        """Spectral lines, one per sinusoid.

        Raises:
            ValueError: A parameter is to be estimated.
        """
        return tuple(line for process, columns in self._known() for line in process._lines(**columns))

    def simulate(
        self,
        n_samples: int,
        *,
        batch: Sequence[int] = (),
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> Tensor:
        """Draw independent sample paths, differentiable in the parameters.

        AR(1) and Matern 3/2 processes are stationary from the first sample on, as is quantisation noise, the
        differences of white noise that begins one sample earlier. A random walk starts with its first increment.
        Flicker noise, which has no stationary level, has differences of their exact law and mean 0 over a path of at
        least twice the length, of which the first `n_samples` are returned. A drift is `slope * t` with
        `t = 1..n_samples`, a sinusoid has a uniform random phase per path.

        Args:
            n_samples: Samples of each path.
            batch: Shape of the independent paths, ahead of the parameters' own batch dimensions.
            generator: Source of randomness; by default a fresh one. The global one is never touched.
            dtype: Of the result; the computation is in float64.
            device: Of the result; by default that of `generator`, else that of the parameters.

        Returns:
            `(*batch, ..., time)`, signal.

        Raises:
            ValueError: A parameter is to be estimated, or `generator` lives on another device.
        """
        n_samples = check_positive_integer("n_samples", n_samples)
        if device is None and generator is None:
            device = self._device()
        generator = own_generator(generator, device)
        known = self._known(generator.device)
        own = torch.broadcast_shapes(*(v.shape[:-1] for _, columns in known for v in columns.values()))
        shape = torch.Size([*check_batch(batch), *own])
        return _sum([p._path(n_samples, shape, generator, **columns) for p, columns in known]).to(dtype)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists that `model_from_dict` reads back."""
        description: dict[str, Any] = {
            "processes": [
                {"process": type(p).__name__, **{k: plain(v) for k, v in p.parameters.items()}} for p in self.processes
            ]
        }
        if self.estimated_from is not None:
            description["estimated_from"] = self.estimated_from.to_dict()
        return description

    def __add__(self, other: Model) -> Model:
        return Model([self, other]) if isinstance(other, Model) else NotImplemented

    def __radd__(self, other: int) -> Model:
        # sum([...]) starts with 0
        return self if isinstance(other, int) and other == 0 else NotImplemented

    def __mul__(self, times: int) -> Model:
        return Model([self] * check_positive_integer("times", times)) if isinstance(times, int) else NotImplemented

    __rmul__ = __mul__

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.processes))

    def _named(self) -> list[tuple[str, Parameter]]:
        """Every parameter with its full name."""
        named, seen = [], dict.fromkeys(map(type, self.processes), 0)
        for process in self.processes:
            seen[type(process)] += 1
            prefix = f"{process.key}_{seen[type(process)]}" if process.repeatable else process.key
            named += [(f"{prefix}.{name}", value) for name, value in process.parameters.items()]
        return named

    def _known(self, device: torch.device | None = None) -> list[tuple[Any, dict[str, Tensor]]]:
        """Processes with their parameters as float64 columns `(..., 1)`."""
        missing = [f"`{name}`" for name, value in self._named() if value is None]
        if missing:
            raise ValueError(
                f"{', '.join(missing)}: expected a number, got a parameter to be estimated; "
                "give its value or fit the model to data first"
            )
        device = device or self._device()
        return [
            (
                process,
                {
                    name: torch.as_tensor(value, dtype=torch.float64, device=device)[..., None]
                    for name, value in process.parameters.items()
                },
            )
            for process in self.processes
        ]

    def _device(self) -> torch.device:
        """Device of the parameters."""
        devices = (v.device for p in self.processes for v in p.parameters.values() if isinstance(v, Tensor))
        return next(devices, torch.device("cpu"))


def check_scalar(name: str, model: Model) -> None:
    """Raise when the argument `name` is no model, or a batch of models."""
    if not isinstance(model, Model):
        raise TypeError(
            f"`{name}`: expected a model, got {type(model).__name__} {model!r}; a formula has no values: fit it"
        )
    if model.params.ndim > 1:
        raise ValueError(
            f"`{name}`: expected scalar parameters, got a batch of shape {tuple(model.params.shape[:-1])}; "
            "pick one item with model.with_params(model.params[i])"
        )


def _slope(process: Any, f: Tensor, columns: dict[str, Tensor], name: str) -> Tensor:
    """Derivative of a process's spectrum with respect to one parameter, `(..., frequency)`."""
    value = columns[name]
    spectrum = partial(process._spectrum, f.to(torch.float64))
    slope: Tensor = jvp(lambda v: spectrum(**{**columns, name: v}), (value,), (torch.ones_like(value),))[1]
    return slope


def plain(value: Parameter) -> Any:
    """A parameter as a number or nested lists."""
    return value.tolist() if isinstance(value, Tensor) else value


def _sum(terms: list[Tensor]) -> Tensor:
    return reduce(add, terms)
