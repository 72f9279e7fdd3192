"""A fitted noise model, or a batch of them: parameters with intervals, and how well they fit."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gyrofuse._base.results import ConfidenceInterval, cleaned, counted, listed, p_words, place
from gyrofuse._base.units import DATASHEET_UNITS
from gyrofuse.fitting.moments.inference import Inference
from gyrofuse.fitting.moments.records import Records
from gyrofuse.fitting.structure import Composition
from gyrofuse.noise.datasheet import Datasheet, datasheet
from gyrofuse.noise.estimation import EstimatedFrom
from gyrofuse.noise.processes import Model
from gyrofuse.wavelets.equivalent_dof import chi_square_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_TABLES = 12  # items that a summary prints in full
REFUSED = 0.01  # p-values of the J test below


@dataclass(frozen=True, eq=False, repr=False)
class GMWMResult:
    """Noise models fitted to wavelet variances; `...` are the leading dimensions of the signal.

    Attributes:
        model: Fitted, with parameters `(..., sensor)`; it knows the record and the covariance that it has them from.
        param_names: Of the parameters, such as `ar1_1.phi`.
        params: `(..., sensor, parameter)`; NaN where nothing could be fitted.
        param_cov: `(..., sensor, parameter, parameter)`; zero rows for variances that are estimated as zero.
        confidence_interval: Limits `(..., sensor, parameter)`. A variance at zero has an upper limit only.
        confidence_level: Of these.
        determined: `(..., sensor, parameter)`; where False the data say hardly more than the order of magnitude.
        identified: `(..., sensor)`; False where parameters cannot be told apart at this length.
        remarks: What cannot, in words, for each sensor, item after item.
        objective: `r' Omega r` with `r = nu - nu(theta)`, `(..., sensor)`.
        j_statistic: `r' V^-1 r` at these parameters, `(..., sensor)`.
        p_value: Of the J test, that the model is complete, `(..., sensor)`; NaN where the model has as many
            parameters as there are levels, or the weights are not `V^-1`. Where the parameters are refined, by
            a chi-square of the mean and variance that the J statistic has there.
        converged: `(..., sensor)`; of the likelihood where it refined the parameters, else of the moments.
        wavelet_variance: Measured, `(..., level, sensor)`, signal^2.
        fitted_wavelet_variance: Of the model, the same.
        records: Length of the record, or of those that the fit was to jointly, and the wavelet variances' efficiency.
        weighting: Of the moments.
        refined: Whether the parameters are those of the spectral likelihood.
        sensors: Names.
        rate: Hz, where known.
        unit: Of the signal, where known.
        moments: That were matched, `"variance"` or `"log"`.
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
    remarks: tuple[tuple[str, ...], ...]
    objective: Tensor
    j_statistic: Tensor
    p_value: Tensor
    converged: Tensor
    wavelet_variance: Tensor
    fitted_wavelet_variance: Tensor
    records: Records
    weighting: str
    refined: bool
    sensors: tuple[str, ...]
    rate: float | None
    unit: str | None
    moments: str = "variance"
    axes: tuple[str, ...] = ()

    @classmethod
    def build(
        cls,
        *,
        inference: Inference,
        remarks: list[tuple[str, ...]],
        made_of: Composition,
        usable: Tensor,
        wavelet_variance: Tensor,
        batch: tuple[int, ...],
        **rest: Any,
    ) -> GMWMResult:
        """Put the items that could be fitted back into their places among all, `(item,)` -> `(..., sensor)`."""

        def placed(value: Tensor, missing: float | bool) -> Tensor:
            whole = value.new_full((len(usable), *value.shape[1:]), missing)
            whole[usable] = value
            return whole.view(*batch, *value.shape[1:])

        estimates, tested = inference.estimates, rest["weighting"] in ("optimal", "continuous")
        p_value = inference.p_value if tested else torch.full_like(inference.p_value, torch.nan)
        params, param_cov = placed(estimates.params, torch.nan), placed(estimates.covariance, torch.nan)
        said = iter(remarks)
        told = EstimatedFrom(sum(rest["records"].lengths), param_cov)
        return cls(
            model=(model := Model(list(made_of.processes))).with_params(params, estimated_from=told),
            param_names=model.param_names,
            params=params,
            param_cov=param_cov,
            confidence_interval=ConfidenceInterval(placed(estimates.low, torch.nan), placed(estimates.high, torch.nan)),
            determined=placed(estimates.determined, False),
            identified=placed(torch.tensor([not texts for texts in remarks], device=usable.device), False),
            remarks=tuple(next(said) if ok else () for ok in usable.tolist()),
            objective=placed(inference.objective, torch.nan),
            j_statistic=placed(inference.j_statistic, torch.nan),
            p_value=placed(p_value, torch.nan),
            converged=placed(inference.converged, False),
            wavelet_variance=wavelet_variance.view(*batch, -1).mT,
            fitted_wavelet_variance=placed(inference.fitted, torch.nan).mT,
            **rest,
        )

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
        return Composition(self.model.processes, held=True).name

    def summary(self) -> str:
        """Parameters with intervals, sensor by sensor, and in datasheet units where rate and unit of rate are known."""
        batch = self.params.shape[:-2]
        kind = "GMWM fit, refined by spectral likelihood," if self.refined else "GMWM fit"
        robust = f", robust, efficiency {self.efficiency:g}" if self.efficiency < 1 else ""
        matched = f", {self.weighting} weighting" if self.weighting != "optimal" else ""
        matched += ", log moments" if self.moments == "log" else ""
        levels = self.wavelet_variance.shape[-2]
        lines = [f"{kind} of {self.name}: {self.n_samples} samples, {counted(levels, 'level')}{matched}{robust}"]
        n_items = self.params.shape[:-1].numel()
        if batch:
            lines.append(f"{n_items} fits in a batch {tuple(batch)}, {int(self.converged.sum())} converged")
        if n_items > _MOST_TABLES:
            tested = self.p_value.isfinite()
            if bool(tested.any()):
                refused = int((self.p_value[tested] < REFUSED).sum())
                lines.append(f"the J test refuses {refused} of {int(tested.sum())} models (p < {REFUSED:g})")
            return "\n".join(lines)
        for index in itertools.product(*map(range, self.params.shape[:-1])):
            lines += ["", *self._table(index)]
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()

    def _table(self, index: tuple[int, ...]) -> list[str]:
        head = f"sensor {place(self.sensors, index, self.axes)}"
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
        rows += [f"  {text}" for text in self.remarks[item]]
        if self.rate and self.unit in DATASHEET_UNITS:
            rows += ["  " + line for line in self.datasheet(index).summary().splitlines()[1:]]
        return rows

    def datasheet(self, index: tuple[int, ...]) -> Datasheet:
        """One sensor's model in datasheet units, where rate and unit of rate are known.

        Args:
            index: Of the sensor among the leading dimensions.
        """
        own, levels = self.model.with_params(self.params[index]), self.wavelet_variance.shape[-2]
        return datasheet(own, self.rate or 1.0, self.unit or "", n_levels=levels)

    def plot(self, ax: Axes | None = None, *, index: tuple[int, ...] | None = None) -> Axes:
        """Draw one sensor's Allan deviation with intervals, the fitted model and each of its components.

        Args:
            ax: Where to draw; a new figure by default.
            index: Of the sensor among the leading dimensions; the first by default.
        """
        from gyrofuse.fitting.plots import plot_moment_fit

        index = (0,) * (self.params.ndim - 1) if index is None else index
        measured = self.wavelet_variance.mT[index]
        model = self.model.with_params(self.params[index])
        covariance = self.records.covariance(model)
        spread = covariance.diagonal()
        # Degrees of freedom of the model: a variance that came out small by chance would seem to have none.
        degrees = 2 * model.wavelet_variance(len(measured)).square() / spread
        limits = chi_square_interval(measured, degrees, self.confidence_level)
        return plot_moment_fit(
            measured,
            limits,
            model,
            confidence_level=self.confidence_level,
            rate=self.rate,
            unit=self.unit,
            title=f"sensor {place(self.sensors, index, self.axes)}: {self.name}",
            ax=ax,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists; what is not known is None."""
        low, high = self.confidence_interval
        return {
            "model": cleaned(self.model.to_dict()),
            "param_names": list(self.param_names),
            "params": listed(self.params),
            "param_cov": listed(self.param_cov),
            "confidence_interval": {"low": listed(low), "high": listed(high)},
            "confidence_level": self.confidence_level,
            "determined": self.determined.tolist(),
            "identified": self.identified.tolist(),
            "remarks": [list(texts) for texts in self.remarks],
            "objective": listed(self.objective),
            "j_statistic": listed(self.j_statistic),
            "p_value": listed(self.p_value),
            "converged": self.converged.tolist(),
            "wavelet_variance": listed(self.wavelet_variance),
            "fitted_wavelet_variance": listed(self.fitted_wavelet_variance),
            "n_samples": self.n_samples,
            "weighting": self.weighting,
            "moments": self.moments,
            "refined": self.refined,
            "efficiency": self.efficiency,
            "sensors": list(self.sensors),
            "axes": list(self.axes),
            "rate": self.rate,
            "unit": self.unit,
        }


def _digits(value: float, width: float) -> int:
    """Significant digits with which the limits of an interval differ from the value; 6 do but for tones."""
    known = width > 0 and math.isfinite(width) and value != 0
    return min(max(6, math.ceil(math.log10(abs(value) / width)) + 2), 11) if known else 6
