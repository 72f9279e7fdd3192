"""A fitted noise model, or a batch of them: parameters with intervals, and how well they fit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor

from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse._base.results import ConfidenceInterval, Result, counted, p_words, plain, scattered, sensor_label
from gyrofuse._base.units import DATASHEET_UNITS
from gyrofuse.fitting.j_test import REJECTED
from gyrofuse.fitting.moments.inference import Inference
from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.datasheet import Datasheet, datasheet
from gyrofuse.noise.estimation import EstimatedFrom
from gyrofuse.noise.processes import Model
from gyrofuse.wavelets.intervals import chi_square_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

T = TypeVar("T")

# Largest number of items whose tables a summary prints in full: what a few pages of a terminal hold.
MOST_TABLES = 12


@dataclass(frozen=True, eq=False, repr=False)
class GMWMResult(Result):
    """Noise models fitted to wavelet variances; `...` are the leading dimensions of the signal.

    Attributes:
        model: Fitted model with parameters `(..., sensor)`; it carries the length of the record and the covariance of
            its parameters.
        param_names: Names of the parameters, such as `ar1_1.phi`.
        params: Parameters, `(..., sensor, parameter)`; NaN where nothing could be fitted.
        param_cov: Their covariance, `(..., sensor, parameter, parameter)`; zero rows for variances estimated as zero.
        confidence_interval: Limits `(..., sensor, parameter)`. A variance at zero has an upper limit only.
        confidence_level: Probability that an interval holds the true value.
        determined: `(..., sensor, parameter)`; False where hardly the order of magnitude is known.
        identified: `(..., sensor)`; False where the record does not identify some parameters.
        notes: Parameters that are not identified, in words, for each sensor, item after item.
        objective: `r' Omega r` with `r = nu - nu(theta)`, `(..., sensor)`.
        j_statistic: `r' V^-1 r` at these parameters, `(..., sensor)`.
        p_value: P value of the J test, that the model is complete, `(..., sensor)`; NaN where the model has as many
            parameters as there are levels, or the weights are not `V^-1`. Of refined parameters by a chi-square of the
            mean and variance that the J statistic has there.
        converged: `(..., sensor)`; of the likelihood where it refined the parameters, else of the moments.
        wavelet_variance: Measured wavelet variance, `(..., level, sensor)`, signal^2.
        fitted_wavelet_variance: Wavelet variance of the model, the same.
        records: Lengths of the records, their levels, and the efficiency of the wavelet variance.
        weighting: Weighting of the moments.
        refined: Whether the parameters are those of the spectral likelihood.
        sensors: Names of the sensors.
        rate: Sampling rate in Hz, where known.
        unit: Unit of the signal, where known.
        axes: Names along the leading dimension, `("x", "y", "z")`, empty when it has none.
    """

    model: Model
    param_names: tuple[str, ...]
    params: Tensor
    param_cov: Tensor
    confidence_interval: ConfidenceInterval
    confidence_level: float
    determined: Tensor
    identified: Tensor
    notes: tuple[tuple[str, ...], ...]
    objective: Tensor
    j_statistic: Tensor
    p_value: Tensor
    converged: Tensor
    wavelet_variance: Tensor
    fitted_wavelet_variance: Tensor
    records: SampleDesign
    weighting: str
    refined: bool
    sensors: tuple[str, ...]
    rate: float | None
    unit: str | None
    axes: tuple[str, ...] = ()

    remarks = RenamedAttribute("notes")
    _batched = (
        "params",
        "param_cov",
        "confidence_interval",
        "determined",
        "identified",
        "objective",
        "j_statistic",
        "p_value",
        "converged",
        "wavelet_variance",
        "fitted_wavelet_variance",
    )

    @classmethod
    def build(
        cls,
        *,
        inference: Inference,
        notes: list[tuple[str, ...]],
        structure: ModelStructure,
        usable: Tensor,
        wavelet_variance: Tensor,
        batch: tuple[int, ...],
        **rest: Any,
    ) -> GMWMResult:
        """Put the items that could be fitted back into their places among all, `(item,)` -> `(..., sensor)`."""
        estimates = inference.estimates
        tested = rest["weighting"] == "optimal"
        p_value = inference.p_value if tested else torch.full_like(inference.p_value, torch.nan)
        params = scattered(estimates.params, usable, batch)
        param_cov = scattered(estimates.covariance, usable, batch)
        own_notes = iter(notes)
        source = EstimatedFrom(sum(rest["records"].lengths), param_cov)
        return cls(
            model=(model := Model(list(structure.processes))).with_params(params, estimated_from=source),
            param_names=model.param_names,
            params=params,
            param_cov=param_cov,
            confidence_interval=ConfidenceInterval(
                scattered(estimates.low, usable, batch), scattered(estimates.high, usable, batch)
            ),
            determined=scattered(estimates.determined, usable, batch, False),
            identified=scattered(torch.tensor([not texts for texts in notes]).to(usable), usable, batch, False),
            notes=tuple(next(own_notes) if ok else () for ok in usable.tolist()),
            objective=scattered(inference.objective, usable, batch),
            j_statistic=scattered(inference.j_statistic, usable, batch),
            p_value=scattered(p_value, usable, batch),
            converged=scattered(inference.converged, usable, batch, False),
            wavelet_variance=wavelet_variance.view(*batch, -1).mT,
            fitted_wavelet_variance=scattered(inference.fitted, usable, batch).mT,
            **rest,
        )

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions before the sensors; `()` for a single array."""
        return tuple(self.params.shape[:-2])

    def __getitem__(self, index: Any) -> GMWMResult:
        """One item, or some, of the leading batch dimensions."""
        some = super().__getitem__(index)
        source = EstimatedFrom(self.n_samples, some.param_cov)
        return replace(
            some,
            model=self.model.with_params(some.params, estimated_from=source),
            notes=items_of(self.notes, self.converged.shape, index),
            axes=axes_of(self.axes, index),
        )

    @property
    def std_err(self) -> Tensor:
        """Standard errors of the parameters, `(..., sensor, parameter)`; zero for variances estimated as zero."""
        return self.param_cov.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()

    @property
    def n_samples(self) -> int:
        """Length of the records, all together."""
        return sum(self.records.lengths)

    @property
    def efficiency(self) -> float:
        """Of the wavelet variances, 1 for the classic ones, less for robust ones."""
        return self.records.efficiency

    @property
    def name(self) -> str:
        """Of the model, such as `AR1 + RW + 3*SIN`."""
        return ModelStructure(self.model.processes, held=True).name

    def summary(self) -> str:
        """Parameters with intervals, sensor by sensor, and in datasheet units where rate and unit of rate are known."""
        batch = self.params.shape[:-2]
        kind = "GMWM fit, refined by spectral likelihood," if self.refined else "GMWM fit"
        robust = f", robust, efficiency {self.efficiency:g}" if self.efficiency < 1 else ""
        matched = f", {self.weighting} weighting" if self.weighting != "optimal" else ""
        levels = self.wavelet_variance.shape[-2]
        lines = [f"{kind} of {self.name}: {self.n_samples} samples, {counted(levels, 'level')}{matched}{robust}"]
        n_items = self.params.shape[:-1].numel()
        if batch:
            lines.append(f"{n_items} fits in a batch {tuple(batch)}, {int(self.converged.sum())} converged")
        if n_items > MOST_TABLES:
            tested = self.p_value.isfinite()
            if bool(tested.any()):
                refused = int((self.p_value[tested] < REJECTED).sum())
                lines.append(f"the J test refuses {refused} of {int(tested.sum())} models (p < {REJECTED:g})")
            return "\n".join(lines)
        for index in itertools.product(*map(range, self.params.shape[:-1])):
            lines += ["", *self._table(index)]
        return "\n".join(lines)

    def _table(self, index: tuple[int, ...]) -> list[str]:
        head = f"sensor {sensor_label(self.sensors, index, self.axes)}"
        if not bool(self.params[index].isfinite().all()):
            return [f"{head}: not fitted"]
        fits = ""
        if bool(self.p_value[index].isfinite()):
            fits = f", J = {self.j_statistic[index].item():.4g}, {p_words(self.p_value[index].item())}"
        if not bool(self.converged[index]):
            fits += ", not converged"
        low, high = self.confidence_interval
        level = f"{100 * self.confidence_level:g} % interval"
        rows = [f"{head}{fits}", f"  {'parameter':<24}{'estimate':>13}  {level:^29}"]
        for k, name in enumerate(self.param_names):
            value, first, last = (t[index][k].item() for t in (self.params, low, high))
            note = "" if bool(self.determined[index][k]) else "  weakly determined"
            if value == 0:
                note = "  at its limit"
            digits = _digits(value, last - first)
            numbers = [f"{number:>13.{digits}g}" for number in (value, first, last)]
            rows.append(f"  {name:<24}{numbers[0]}  [{numbers[1]}, {numbers[2]}]{note}")
        item = sum(i * step for i, step in zip(index, self.identified.stride(), strict=True))
        rows += [f"  {text}" for text in self.notes[item]]
        if self.rate and self.unit in DATASHEET_UNITS:
            rows += ["  " + line for line in self.datasheet(index).summary().splitlines()[1:]]
        return rows

    def datasheet(self, index: tuple[int, ...]) -> Datasheet:
        """One sensor's model in datasheet units, where rate and unit of rate are known.

        Args:
            index: Index of the sensor among the leading dimensions.
        """
        own, levels = self.model.with_params(self.params[index]), self.wavelet_variance.shape[-2]
        return datasheet(own, self.rate or 1.0, self.unit or "", n_levels=levels)

    def plot(self, ax: Axes | None = None, *, index: tuple[int, ...] | None = None) -> Axes:
        """Draw one sensor's Allan deviation with intervals, the fitted model and each of its components.

        Args:
            ax: Axes to draw on; a new figure by default.
            index: Index of the sensor among the leading dimensions; the first by default.
        """
        from gyrofuse.fitting.plots import plot_moment_fit

        index = (0,) * (self.params.ndim - 1) if index is None else index
        measured = self.wavelet_variance.mT[index]
        model = self.model.with_params(self.params[index])
        covariance = self.records.covariance(model)
        # Degrees of freedom of the model: a variance that came out small by chance would seem to have none.
        dof = 2 * model.wavelet_variance(len(measured)).square() / covariance.diagonal()
        limits = chi_square_interval(measured, dof, self.confidence_level)
        return plot_moment_fit(
            measured,
            limits,
            model,
            confidence_level=self.confidence_level,
            rate=self.rate,
            unit=self.unit,
            title=f"sensor {sensor_label(self.sensors, index, self.axes)}: {self.name}",
            ax=ax,
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain lists and numbers, ready for JSON (NaN and infinities as None)."""
        named = [entry.name for entry in fields(self) if entry.name not in ("notes", "records")]
        known = {name: plain(getattr(self, name)) for name in named}
        others = {"remarks": self.notes, "n_samples": self.n_samples, "efficiency": self.efficiency}
        return known | {name: plain(value) for name, value in others.items()} | {"moments": "variance"}


def items_of(values: Sequence[T], shape: Sequence[int], index: Any) -> tuple[T, ...]:
    """What items of a batch have, where it is listed item after item.

    Args:
        values: One for each item of all dimensions.
        shape: Dimensions of the batch.
        index: Index into the first dimensions.
    """
    places = torch.arange(len(values)).view(*shape)[index]
    return tuple(values[i] for i in places.flatten().tolist())


def axes_of(axes: tuple[str, ...], index: Any) -> tuple[str, ...]:
    """Names along the leading dimension after indexing; none where one of them was taken.

    Args:
        axes: Names, as many as the leading dimension is long, or none.
        index: Index into the first dimensions.
    """
    places = torch.arange(len(axes))[index[0] if isinstance(index, tuple) else index] if axes else torch.tensor(0)
    return tuple(axes[i] for i in places.tolist()) if places.ndim else ()


def _digits(value: float, width: float) -> int:
    """Significant digits with which the limits of an interval differ from the value; 6 do but for tones."""
    known = width > 0 and math.isfinite(width) and value != 0
    return min(max(6, math.ceil(math.log10(abs(value) / width)) + 2), 11) if known else 6
