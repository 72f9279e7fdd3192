"""A fitted noise model of an array, or a batch of them: matrices with intervals, and how well they fit."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse._base.results import ConfidenceInterval, Result, counted, plain, scattered
from gyrofuse.fitting.array.inference import (
    RELIABLE_TIME_CONSTANTS,
    ArrayFit,
    covariance_of_numbers,
    identified_matrices,
    is_long,
    matrices,
    shared,
)
from gyrofuse.fitting.array.moments import vech
from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.fusion.weights.subsets import subset_weights
from gyrofuse.fusion.weights.svo import ScaleWeights
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.estimation import EstimatedFrom
from gyrofuse.noise.processes import Model, Process
from gyrofuse.wavelets.intervals import chi_square_tail

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False, repr=False)
class ArrayGMWMResult(Result):
    """Noise models fitted to wavelet cross-covariances; `...` are the leading dimensions of the signal.

    Attributes:
        processes: Processes of the sum, without values.
        theta: Covariance matrices between the sensors `(..., process, sensor, sensor)`: of white noise, of the
            innovations of an AR1, of the steps of a random walk, of in-phase amplitudes of a sinusoid (their squares,
            twice its variances, on the diagonal; of rank 2 at most, as a sinusoid has two phases). Positive
            semi-definite. NaN for a sensor without samples and a pair that is never seen together.
        theta_std_err: Standard errors of the entries, as if no matrix lacked rank.
        confidence_interval: Limits of the entries. A variance that hardly differs from zero, or belongs to a matrix
            that lacks rank or to a long memory, has an upper limit only; covariances of such a matrix have none (NaN).
        correlation: Correlations between the sensors in each process.
        correlation_interval: Limits of the correlations, NaN where the matrix lacks rank or belongs to a long memory.
        param_names: Names of the parameters that all sensors share, such as `ar1_1.phi`.
        params: Shared parameters, `(..., parameter)`.
        params_std_err: Standard errors of the shared parameters, `(..., parameter)`.
        params_interval: Limits `(..., parameter)`, NaN for `phi` where `notes` say so.
        param_cov: Covariance of all numbers of the model, as if no matrix lacked rank: entries of the matrices on and
            above the diagonal, row after row, and `phi` or `beta`, process by process, `(..., number, number)`. NaN
            for pairs that are never seen together.
        confidence_level: Probability that an interval holds the true value.
        objective: `r' Omega r` with `r` the entries of measured less fitted wavelet cross-covariance, `(...)`.
        dof: Degrees of freedom, moments less parameters, `(...)`.
        p_value: P value of the J test, that the model is complete, `(...)`.
        converged: Whether the search came to rest, `(...)`.
        rank: Rank of every matrix, `(..., process)`, 0 for an array that could not be fitted.
        wavelet_cross_covariance: Measured wavelet cross-covariance, `(..., level, sensor, sensor)`, signal^2.
        fitted_wavelet_cross_covariance: Wavelet cross-covariance of the model, the same.
        n_samples: Length of the records.
        weighting: Weighting of the moments, always `"optimal"`.
        sensors: Names of the sensors.
        rate: Sampling rate in Hz, where known.
        unit: Unit of the signal, where known.
    """

    processes: tuple[Process, ...]
    theta: Tensor
    theta_std_err: Tensor
    confidence_interval: ConfidenceInterval
    correlation: Tensor
    correlation_interval: ConfidenceInterval
    param_names: tuple[str, ...]
    params: Tensor
    params_std_err: Tensor
    params_interval: ConfidenceInterval
    param_cov: Tensor
    confidence_level: float
    objective: Tensor
    dof: Tensor
    p_value: Tensor
    converged: Tensor
    rank: Tensor
    wavelet_cross_covariance: Tensor
    fitted_wavelet_cross_covariance: Tensor
    n_samples: int
    weighting: str
    sensors: tuple[str, ...]
    rate: float | None
    unit: str | None

    theta_sd = RenamedAttribute("theta_std_err")
    params_sd = RenamedAttribute("params_std_err")
    degrees_of_freedom = RenamedAttribute("dof")
    remarks = RenamedAttribute("notes")
    _batched = (
        "theta",
        "theta_std_err",
        "confidence_interval",
        "correlation",
        "correlation_interval",
        "params",
        "params_std_err",
        "params_interval",
        "param_cov",
        "objective",
        "dof",
        "p_value",
        "converged",
        "rank",
        "wavelet_cross_covariance",
        "fitted_wavelet_cross_covariance",
    )

    @classmethod
    def build(
        cls,
        *,
        fit: ArrayFit,
        squared: Tensor,
        held_sd: Tensor,
        structure: ModelStructure,
        usable: Tensor,
        records: SampleDesign,
        wavelet_cross_covariance: Tensor,
        **rest: Any,
    ) -> ArrayGMWMResult:
        """Put the arrays that could be fitted back into their places among all, `(item,)` -> `(...)`.

        Args:
            fit: Fit of the arrays in units of their sensors.
            squared: Units of the entries of their matrices, `(item, 1, sensor, sensor)`.
            held_sd: Standard errors of frequencies that the moments did not fit, `(item, sinusoid)`.
            structure: Structure of the model.
            usable: Which arrays of all they are, `(item,)`, bool.
            records: Length and levels of the records.
            wavelet_cross_covariance: Measured, of all arrays, `(..., level, sensor, sensor)`.
            **rest: Fields that are no results of the fit.
        """
        batch = wavelet_cross_covariance.shape[:-3]

        def placed(value: Tensor, missing: float | bool = torch.nan) -> Tensor:
            return scattered(value, usable, batch, missing)

        identified = identified_matrices(fit, structure, records.longest)
        entries, correlation = matrices(fit, identified, rest["confidence_level"])
        params = shared(fit, identified, held_sd, structure, rest["confidence_level"])
        theta = entries.value * squared
        columns = structure.columns(records.tau.to(squared), fit.shape)
        # A scaled chi-square of the same mean and variance.
        p_value = chi_square_tail(fit.objective / fit.dispersion, fit.dof / fit.dispersion)
        names = Model(list(structure.processes)).param_names
        return cls(
            processes=structure.processes,
            theta=placed(theta),
            theta_std_err=placed(entries.std_err * squared),
            confidence_interval=ConfidenceInterval(placed(entries.low * squared), placed(entries.high * squared)),
            correlation=placed(correlation.value),
            correlation_interval=ConfidenceInterval(placed(correlation.low), placed(correlation.high)),
            param_names=tuple(name for name in names if name.endswith((".phi", ".beta"))),
            params=placed(params.value),
            params_std_err=placed(params.std_err),
            params_interval=ConfidenceInterval(placed(params.low), placed(params.high)),
            param_cov=placed(covariance_of_numbers(fit, vech(squared), params.std_err, structure)),
            objective=placed(fit.objective),
            dof=placed(fit.dof.to(theta)),
            p_value=placed(p_value),
            converged=placed(fit.converged, False),
            rank=placed(fit.rank, 0),
            wavelet_cross_covariance=wavelet_cross_covariance,
            fitted_wavelet_cross_covariance=placed(torch.einsum("njk,nkab->njab", columns, theta)),
            n_samples=records.longest,
            weighting="optimal",
            **rest,
        )

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions of the arrays; `()` for a single one."""
        return tuple(self.theta.shape[:-3])

    @property
    def notes(self) -> tuple[tuple[str, ...], ...]:
        """What the record does not determine, in words, for each array, item after item."""
        return tuple(self._notes(index) for index in itertools.product(*map(range, self.converged.shape)))

    @property
    def model(self) -> ArrayModel:
        """The fitted model, which simulates; of the sensors that have samples.

        Raises:
            ValueError: The result holds a batch, the array could not be fitted, or a pair of sensors is never seen
                together.
        """
        self._check_single("model")
        present = self._present()
        known = self.theta[:, present][:, :, present]
        if not bool(present.any()) or not bool(known.isfinite().all()):
            raise ValueError(
                "`model`: expected a fitted array whose sensors are recorded together, got unknown covariances; "
                "leave sensors out"
            )
        shapes = iter(self.params.tolist())
        components: list[tuple[Process, Tensor]] = []
        for process, matrix in zip(self.processes, known, strict=True):
            kind: type[Any] = type(process)
            of_unit_size = dict.fromkeys(process.parameters, 1.0)
            of_unit_size |= {name: next(shapes) for name in ("phi", "beta") if name in of_unit_size}
            components.append((kind(**of_unit_size), matrix))
        source = EstimatedFrom(self.n_samples, self.param_cov[self._of_present()][:, self._of_present()])
        return ArrayModel(components, estimated_from=source)

    def svo_weights(self, scale_weights: ScaleWeights = "flat") -> Tensor:
        """Optimal weights of the array from the fitted wavelet cross-covariance; 0 for sensors without samples.

        Args:
            scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.

        Returns:
            `(..., sensor)`, sum 1, may be negative; NaN for an array that could not be fitted.

        Raises:
            SingularCovarianceError: The combined covariance is not positive definite, or a pair is never seen together.

        References:
            [Z] equations (4) and (7).
        """
        present = self._present()
        both = (present[..., :, None] & present[..., None, :])[..., None, :, :]
        return subset_weights(torch.where(both, self.fitted_wavelet_cross_covariance, 0.0), scale_weights, present)

    def summary(self) -> str:
        """Deviations of the sensors by process with intervals, largest correlations, and the fit."""
        name = ModelStructure(self.processes, held=True).name
        levels, n_sensors = self.wavelet_cross_covariance.shape[-3:-1]
        head = f"GMWM fit of an array, {name}: {counted(n_sensors, 'sensor')}, {self.n_samples} samples, "
        head += counted(levels, "level")
        batch = self.theta.shape[:-3]
        if batch:
            return f"{head}\n{batch.numel()} arrays in a batch {tuple(batch)}, {int(self.converged.sum())} converged"
        if not bool(self._present().any()):
            return f"{head}\nnot fitted"
        fits = "" if bool(self.converged) else "not converged, "
        fits += f"J = {self.objective.item():.4g} with {int(self.dof)} degrees of freedom"
        if bool(self.p_value.isfinite()):
            fits += f", p = {self.p_value.item():.2g}"
        lines = [head, fits]
        level = f"{100 * self.confidence_level:g} % interval"
        shared = zip(self.param_names, self.params, *self.params_interval, strict=True)
        for label, value, low, high in shared:
            limits = f"{level} [{low:.6g}, {high:.6g}]" if low.isfinite() else "no interval, see below"
            lines.append(f"{label:<16}{value:>13.6g}  {limits}")
        for k, process in enumerate(self.processes):
            what = "squared amplitudes, twice the variances," if process.squared else "variances"
            lines += ["", f"{process.symbol}: {what} with {level}s, correlations"]
            for i, sensor in enumerate(self.sensors):
                low, high = (limit[k, i, i].item() for limit in self.confidence_interval)
                value = self.theta[k, i, i].item()
                others = " ".join(f"{rho:6.2f}" for rho in self.correlation[k, i].tolist())
                lines.append(f"  {sensor:<12}{value:>12.5g} [{low:>11.5g}, {high:>11.5g}]  {others}")
        return "\n".join([*lines, *("", *self.notes[0]) * bool(self.notes[0])])

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the sensors' Allan deviations, measured and of the fitted model (dashed).

        Args:
            ax: Axes to draw on; a new figure by default.

        Raises:
            ValueError: The result holds a batch.
        """
        from gyrofuse._base.axes import BLUE, finish
        from gyrofuse.fusion.plots import allan_deviation, plot_allan_deviation

        self._check_single("plot")
        measured, fitted = (
            value.diagonal(dim1=-2, dim2=-1)
            for value in (self.wavelet_cross_covariance, self.fitted_wavelet_cross_covariance)
        )
        times = torch.exp2(torch.arange(len(measured), dtype=torch.float64)) / (self.rate or 1.0)
        in_seconds = self.rate is not None
        ax = plot_allan_deviation(times, measured, names=self.sensors, unit=self.unit, in_seconds=in_seconds, ax=ax)
        lines = ax.plot(times, allan_deviation(fitted), color=BLUE, linewidth=1.2, linestyle="--", zorder=3)
        finish(ax, [ax.lines[0], lines[0]], [f"{len(self.sensors)} sensors", "fitted model"])
        return ax

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain lists and numbers, ready for JSON (NaN and infinities as None)."""
        old = {"theta_std_err": "theta_sd", "params_std_err": "params_sd", "dof": "degrees_of_freedom"}
        known = {old.get(e.name, e.name): plain(getattr(self, e.name)) for e in fields(self) if e.name != "processes"}
        return {"processes": [process.symbol for process in self.processes]} | known | {"remarks": plain(self.notes)}

    def _of_present(self) -> Tensor:
        """Which numbers of the model are those of sensors that have samples, `(number,)`."""
        both = vech(self._present()[:, None] & self._present())
        nonlinear = [any(name in process.parameters for name in ("phi", "beta")) for process in self.processes]
        return torch.cat([torch.cat([both, both.new_ones(int(is_shaped))]) for is_shaped in nonlinear])

    def _notes(self, index: tuple[int, ...]) -> tuple[str, ...]:
        n_sensors = self.theta.shape[-1]
        if not bool(self._present()[index].any()):
            return ()
        shapes = dict(zip(self.param_names, self.params[index].unbind(-1), strict=True))
        names = dict.fromkeys(name.split(".")[0] for name in Model(list(self.processes)).param_names)
        found = []
        for name, rank in zip(names, self.rank[index].tolist(), strict=True):
            phi = shapes.get(f"{name}.phi")
            is_vague = phi is not None and bool(is_long(phi, self.n_samples))
            reasons = [f"matrix of rank {rank} of {n_sensors}"] * (rank < n_sensors)
            if is_vague:
                reasons.append(
                    "hardly told from a random walk at this length, its memory is longer than "
                    f"1/{RELIABLE_TIME_CONSTANTS} of the record"
                )
            if reasons:
                limits = "upper limits only of its variances, no intervals of its covariances and correlations"
                nor = "" if phi is None else ", nor of any phi"
                found.append(f"{name}: {' and '.join(reasons)}; {limits}{nor}")
            if is_vague:
                found.append(
                    f"{name}: weights for long times may be no better than those of the measured wavelet "
                    "cross-covariance"
                )
        for name, low, high in zip(self.param_names, *(limit[index] for limit in self.params_interval), strict=True):
            if name.endswith(".phi") and low <= 0 <= high:
                found.append(f"{name.split('.')[0]}: indistinguishable from white noise at this length")
        return tuple(found)

    def _present(self) -> Tensor:
        """Sensors with samples, `(..., sensor)`."""
        return self.theta.diagonal(dim1=-2, dim2=-1).isfinite().all(-2)

    def _check_single(self, what: str) -> None:
        if self.theta.ndim > 3:
            raise ValueError(
                f"`{what}`: expected one array, got a batch {tuple(self.theta.shape[:-3])}; index it, result[0]"
            )
