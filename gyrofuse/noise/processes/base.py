"""What every noise process declares: one class, one equation, all its formulas."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from gyrofuse._base import units
from gyrofuse.noise.datasheet_units import DatasheetEntry
from gyrofuse.noise.dct_bands import BandVariance, DCTBands
from gyrofuse.noise.model import Model, Parameter, SpectralLine, plain


class States(NamedTuple):
    """A process as a linear system, one step per sample; see `StateSpace`.

    Attributes:
        names: What each state is; empty for the state that is the process itself.
        F: Transition `(..., state, state)`.
        Q: Covariance of the state's noise `(..., state, state)`.
        P0: Covariance of the state one step before the first sample `(..., state, state)`.
        output: Coefficients `(state,)` with which the states add up to the process.
        x0: Mean of the state one step before the first sample, `(..., state)`; None for 0.
    """

    names: tuple[str, ...]
    F: Tensor
    Q: Tensor
    P0: Tensor
    output: tuple[float, ...]
    x0: Tensor | None = None


class WhiteAndWalk(NamedTuple):
    """Approximation of a process by white noise and a random walk.

    Attributes:
        white: Variance of the white noise, signal^2.
        walk: Variance of the random walk's increments, signal^2.
        fate: What becomes of the process, in words.
    """

    white: float
    walk: float
    fate: str


@dataclass(frozen=True, eq=False, repr=False)
class Process(Model):
    """Base class of noise processes.

    A subclass is a frozen dataclass whose fields are the parameters; a field's metadata is a `domain`. One of them, its
    `scale_name`, is the size: wavelet variance and spectrum are proportional to the scale parameter `p`, which is that
    parameter or its square. Another one, its `shape_name`, may be nonlinear. Fits move it as an unconstrained `x`.

    Formulas with a leading underscore take the parameters by name as float64 columns `(..., 1)`, with
    `tau = 2, 4, .. 2**n_levels` as `(level,)` and frequencies `f` as `(frequency,)` in cycles per sample. Those of fits
    are of `p = 1` and take `x` `(..., 1)`, None for a process without.

    Attributes:
        key: First part of the parameter names.
        symbol: Short name in model formulas.
        spellings: Further names in model formulas.
        noun: Name in sentences, without an article.
        repeatable: Whether a model may hold several, as their shapes tell them apart.
        scale_name: Parameter that is the size.
        squared: Whether `p` is the square of that parameter.
        shape_name: Nonlinear parameter; None without.
        gaussian: Whether the process is Gaussian noise with a continuous spectrum.
        white: Whether it is white.
        white_integral: Whether its cumulative sum is white.
        has_line: Whether its spectrum is a line.
        deterministic: Whether it is a function of time without randomness.
        alternates: Whether `x < 0` is a process that alternates in sign.
        stand_ins: Processes of one parameter that it resembles at some shape.
        short_limit: Process that it becomes as its memory gets short.
        long_limit: Process that it becomes as its memory gets long.
        memoryless: Nonlinear parameter at which it is `short_limit`.
        starts_per_octave: Time scales in an octave at which a search starts.
    """

    key: ClassVar[str]
    symbol: ClassVar[str]
    noun: ClassVar[str]
    spellings: ClassVar[tuple[str, ...]] = ()
    repeatable: ClassVar[bool] = False
    scale_name: ClassVar[str] = "variance"
    squared: ClassVar[bool] = False
    shape_name: ClassVar[str | None] = None
    gaussian: ClassVar[bool] = True
    white: ClassVar[bool] = False
    white_integral: ClassVar[bool] = False
    has_line: ClassVar[bool] = False
    deterministic: ClassVar[bool] = False
    alternates: ClassVar[bool] = False
    stand_ins: ClassVar[tuple[type[Process], ...]] = ()
    short_limit: ClassVar[type[Process] | None] = None
    long_limit: ClassVar[type[Process] | None] = None
    memoryless: ClassVar[float] = 0.0
    starts_per_octave: ClassVar[int] = 1

    # Haar wavelet variance (..., level); density (..., frequency); sample path (*shape, time).
    _wavelet_variance: ClassVar[Callable[..., Tensor]]
    _spectrum: ClassVar[Callable[..., Tensor]]
    _path: ClassVar[Callable[..., Tensor]]
    # States from parameters (...); entries from units and parameters as numbers; the same from rate and time scale.
    _states: ClassVar[Callable[..., States]]
    _datasheet: ClassVar[Callable[..., Iterator[DatasheetEntry]]]
    _white_and_walk: ClassVar[Callable[..., WhiteAndWalk]]
    # Spectral lines from parameters (..., 1).
    _lines: ClassVar[Callable[..., tuple[SpectralLine, ...]]] = staticmethod(lambda **_: ())

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = _checked(type(self), entry.name, getattr(self, entry.name), **entry.metadata)
            object.__setattr__(self, entry.name, value)

    @property
    def processes(self) -> tuple[Process, ...]:
        return (self,)

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Parameters by name, as given."""
        return {entry.name: getattr(self, entry.name) for entry in fields(self)}

    @property
    def values(self) -> dict[str, float]:
        """Scalar parameters by name, as numbers."""
        return dict(zip(self.parameters, self.params.tolist(), strict=True))

    def time_constant(self, rate: float) -> float:
        """Correlation time of a process with a memory and scalar parameters, s; 0 where it alternates."""
        decay = self.values[str(self.shape_name)]
        return units.correlation_time(decay, rate) if decay > 0 else 0.0

    def __repr__(self) -> str:
        known = [f"{name}={text(value)}" for name, value in self.parameters.items() if value is not None]
        return f"{type(self).__name__}({', '.join(known)})"

    @classmethod
    def with_article(cls, article: str) -> str:
        """Name in sentences, such as `the AR1`; noises take no article."""
        return cls.noun if cls.noun.endswith("noise") else f"{article} {cls.noun}"

    @classmethod
    def has_memory(cls) -> bool:
        """Whether the nonlinear parameter says how fast correlation is lost."""
        return cls.shape_name is not None and not cls.has_line

    @classmethod
    def from_scale_and_shape(cls, p: Tensor, x: Tensor | None) -> dict[str, Tensor]:
        """Parameters by name in the order of the class.

        Args:
            p: Scale parameter `(...)`.
            x: Unconstrained nonlinear parameter `(...)`; None without.
        """
        given = {cls.scale_name: p.sqrt() if cls.squared else p}
        if x is not None and cls.shape_name is not None:
            given[cls.shape_name] = cls.from_unconstrained(x)
        return {entry.name: given[entry.name] for entry in fields(cls)}

    @staticmethod
    def to_unconstrained(value: Tensor) -> Tensor:
        """Unconstrained `x` of a nonlinear parameter.

        Args:
            value: Nonlinear parameter, `(...)`.
        """
        raise NotImplementedError

    @staticmethod
    def from_unconstrained(x: Tensor) -> Tensor:
        """Nonlinear parameter of an unconstrained `x`.

        Args:
            x: Unconstrained nonlinear parameter, `(...)`.
        """
        raise NotImplementedError

    @staticmethod
    def unconstrained_slope(x: Tensor) -> Tensor:
        """Derivative of the nonlinear parameter with respect to `x`.

        Args:
            x: Unconstrained nonlinear parameter, `(...)`.
        """
        raise NotImplementedError

    @classmethod
    def from_time_scale(cls, time: Tensor) -> Tensor:
        """`x` of a time constant; of a sinusoid that of a period.

        Args:
            time: Time constants or periods, `(...)`, samples.
        """
        return cls.to_unconstrained(torch.exp(-1 / time))

    @staticmethod
    def time_scales(longest: float) -> tuple[float, float]:
        """Longest and shortest time scale, in samples, that wavelet variances up to a filter length show.

        Args:
            longest: Longest filter length, samples.
        """
        return longest, 1 / 3

    @staticmethod
    def unconstrained_limits(longest: float) -> tuple[float, float]:
        """Least and largest `x` of a search over wavelet variances up to a filter length.

        Args:
            longest: Longest filter length, samples.
        """
        raise NotImplementedError

    @classmethod
    def unit_wavelet_variance(cls, tau: Tensor, x: Tensor | None) -> Tensor:
        """Haar wavelet variance `(..., level)` of `p = 1`.

        Args:
            tau: Filter lengths, `(level,)`, samples.
            x: Unconstrained nonlinear parameter, `(..., 1)`; None for a process without.
        """
        return cls._wavelet_variance(tau, **cls.from_scale_and_shape(torch.ones_like(tau[:1]), x))

    @staticmethod
    def unit_wavelet_variance_slope(tau: Tensor, x: Tensor) -> Tensor:
        """Derivative of `unit_wavelet_variance` with respect to `x`, `(..., level)`.

        Args:
            tau: Filter lengths, `(level,)`, samples.
            x: Unconstrained nonlinear parameter, `(..., 1)`.
        """
        raise NotImplementedError

    @classmethod
    def unit_band_variance(cls, bands: DCTBands, x: Tensor | None) -> BandVariance:
        """Mean variance of the DCT ordinates of `p = 1` in bands: the spectrum, unless better known.

        Exact for processes whose ordinates have the variance of the spectrum at their frequency, as white noise.

        Args:
            bands: Bands of the ordinates.
            x: Unconstrained nonlinear parameter, `(item,)`; None for a process without.
        """
        return BandVariance(bands.mean_of(cls._spectrum(bands.frequency, torch.ones_like(bands.frequency[..., :1]))))


def domain(expected: str, holds: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Domain of a parameter.

    Args:
        expected: The domain in words.
        holds: Elementwise test.
    """
    return {"expected": expected, "holds": holds}


NON_NEGATIVE = domain("a finite number >= 0", lambda v: v >= 0)


def _checked(kind: type, name: str, value: Parameter, *, expected: str, holds: Callable[[Tensor], Tensor]) -> Parameter:
    if value is None:
        return None
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        value = float(value)
    elif not isinstance(value, Tensor) or not value.is_floating_point():
        raise TypeError(f"`{name}` of {kind.__name__}: expected a number or a floating point tensor, got {value!r}")
    given = torch.as_tensor(value, dtype=torch.float64).detach()
    # In a batch NaN marks an item that could not be estimated, and it stays NaN.
    fine = (holds(given) & given.isfinite()) | (given.isnan() & (given.ndim > 0))
    if not bool(fine.all()):
        raise ValueError(f"`{name}` of {kind.__name__}: expected {expected}, got {given[~fine][0].item():.9g}")
    return value


def text(value: Parameter) -> str:
    """A parameter as `repr` prints it."""
    return f"<batch {tuple(value.shape)}>" if isinstance(value, Tensor) and value.ndim else str(plain(value))


def matrix(rows: list[list[Tensor]]) -> Tensor:
    """Matrix `(..., row, column)` of elements `(...)`."""
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def normal(n_samples: int, shape: torch.Size, generator: torch.Generator) -> Tensor:
    """Standard normal `(*shape, time)`."""
    return torch.randn(*shape, n_samples, generator=generator, dtype=torch.float64, device=generator.device)


def sample_numbers(n_samples: int, like: Tensor) -> Tensor:
    """1, 2, .. `n_samples`, float64 on the device of `like`."""
    return torch.arange(1, n_samples + 1, dtype=torch.float64, device=like.device)
