"""Tasks of a fleet: the rows of a table that each makes of a log."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from gyrofuse._base.checks import check_confidence_level
from gyrofuse._base.units import DATASHEET_UNITS
from gyrofuse.fitting.gmwm import fit_gmwm
from gyrofuse.fleet.store.table import Column
from gyrofuse.fusion.result import SVOResult
from gyrofuse.fusion.svo import fit_svo
from gyrofuse.fusion.weights.methods import METHODS
from gyrofuse.fusion.weights.svo import normalised, resolve_scale_weights
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch import diagnose
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.model import Model
from gyrofuse.noise.parsing import parse_model

Row = dict[str, Any]

# Longest recordings, samples, that are fitted as one batch; above it a batch is not faster than one after the other.
_MAX_STACKED = 32_768
_AXIS = Column("text", "axis of the row; none where the log has one signal for each sensor")


@dataclass(frozen=True)
class Fuse:
    """One virtual gyro for each log.

    Attributes:
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number for each level.
        method: Method of `fit_svo`.
        confidence_level: Confidence level of the limits of the weights.
        virtual: Whether the virtual signal is kept, in the column `virtual`.

    Raises:
        TypeError: Scale weights that are neither a name nor numbers.
        ValueError: An option that `fit_svo` refuses.
    """

    scale_weights: str | tuple[float, ...] = "flat"
    method: str = "svo"
    confidence_level: float = 0.95
    virtual: bool = False

    name: ClassVar[str] = "fuse"

    def __post_init__(self) -> None:
        # Raised here once, and not in every row.
        if isinstance(self.scale_weights, str):
            resolve_scale_weights(self.scale_weights, 1)
        else:
            normalised(self.scale_weights)
            object.__setattr__(self, "scale_weights", tuple(map(float, self.scale_weights)))
        if self.method not in METHODS:
            raise ValueError(f"`method`: expected one of {', '.join(map(repr, METHODS))}, got {self.method!r}")
        check_confidence_level(self.confidence_level)

    @property
    def columns(self) -> dict[str, Column]:
        """Columns of this task, in addition to those of every task."""
        own = {
            "axis": _AXIS,
            "weights": Column("numbers", "weight of each sensor in the virtual gyro, sum 1"),
            "low": Column("numbers", "lower limits of the weights"),
            "high": Column("numbers", "upper limits of the weights"),
            "relative_noise": Column(
                "numbers",
                "Allan deviation of each sensor over that of the median sensor of its array, geometric mean over "
                "averaging times",
            ),
            "tau": Column("numbers", "averaging time of each level, s"),
            "scale_weights": Column("numbers", "how much each averaging time counted in the choice of weights, sum 1"),
            "virtual_deviation": Column(
                "numbers", "Allan deviation of the virtual gyro at each averaging time, in the unit of the signal"
            ),
            "equal_deviation": Column(
                "numbers", "Allan deviation of the plain mean at each averaging time, in the unit of the signal"
            ),
            "gain": Column(
                "numbers",
                "Allan deviation of the plain mean over that of the virtual gyro at each averaging time, to be "
                "expected in other recordings: corrected for the weights having been chosen on this one; below 1 is "
                "worse than the plain mean",
            ),
            "motion": Column("text", "a warning that the array seems to have moved"),
            "enough": Column(
                "truth", "whether the recording is long enough for the weights; none for methods other than svo"
            ),
        }
        return (
            {**own, "virtual": Column("numbers", "the virtual gyro, in the unit of the signal")}
            if self.virtual
            else own
        )

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the rows depend on, ready for JSON."""
        return {"task": self.name, **asdict(self)}

    def rows(self, recordings: Sequence[Recording]) -> list[list[Row]]:
        """Rows of each recording, one for each of its axes; short ones of the same shape are fitted together."""
        first = recordings[0].signal
        alike = len(recordings) > 1 and all(r.signal.shape == first.shape for r in recordings)
        if not alike or first.shape[-1] > _MAX_STACKED:
            return [self._rows(self._fitted(r), r) for r in recordings]
        together = self._fitted(torch.stack([r.signal for r in recordings]))
        return [
            self._rows(replace(together[i], sensors=r.sensors, rate=r.rate, unit=r.unit), r)
            for i, r in enumerate(recordings)
        ]

    def _fitted(self, signal: Recording | Tensor) -> SVOResult:
        return fit_svo(signal, self.scale_weights, method=self.method, confidence_level=self.confidence_level)

    def _rows(self, result: SVOResult, recording: Recording) -> list[Row]:
        axes: tuple[str | None, ...] = recording.axes or (None,)
        virtual = result.virtual(recording) if self.virtual else None
        rows = []
        for i, axis in enumerate(axes):
            one, at = (result, ()) if axis is None else (result[i], (i,))
            low, high = one.confidence_interval
            row: Row = {
                "axis": axis,
                "weights": one.weights.tolist(),
                "low": low.tolist(),
                "high": high.tolist(),
                "relative_noise": relative_noise(one.wavelet_variance).tolist(),
                "tau": one.tau.tolist(),
                "scale_weights": one.scale_weights.tolist(),
                "virtual_deviation": (2 * one.virtual_wavelet_variance).sqrt().tolist(),
                "equal_deviation": (2 * one.equal_wavelet_variance).sqrt().tolist(),
                "gain": _gain(one).sqrt().tolist(),
                "motion": one.motion or None,
                "enough": None,
            }
            if one.method == "svo":
                data = one.enough_data()
                row["enough"] = bool(data.enough)
                row["warnings"] = [] if data.enough else [str(data)]
            if virtual is not None:
                row["virtual"] = virtual[at].tolist()
            rows.append(row)
        return rows


@dataclass(frozen=True)
class Fit:
    """A noise model for each sensor of each log.

    Attributes:
        model: Formula of the model, such as `"WN + AR1 + RW"`.
        refine: Whether the fit is refined by spectral maximum likelihood.
        confidence_level: Confidence level of the limits of the parameters.
    """

    model: str = "WN + AR1 + RW"
    refine: bool = False
    confidence_level: float = 0.95

    name: ClassVar[str] = "fit"
    columns: ClassVar[dict[str, Column]] = {
        "axis": _AXIS,
        "sensor": Column("text", "sensor of the row"),
        "model": Column("text", "fitted model as JSON, which model_from_dict reads back"),
        "parameters": Column("texts", "names of the parameters"),
        "values": Column(
            "numbers", "of the parameters: variances per sample in the unit of the signal squared, beta in rad/sample"
        ),
        "low": Column("numbers", "lower limits of the values"),
        "high": Column("numbers", "upper limits of the values"),
        "p_value": Column("number", "of the J test that the model is complete"),
        "converged": Column("truth", "whether the fit came to an end"),
        "identified": Column("truth", "whether the parameters can be told apart at this length"),
        "remarks": Column("texts", "what cannot be told apart, in words"),
        "quantities": Column("texts", "names of the quantities of a datasheet"),
        "figures": Column("numbers", "their values, in the units of figure_units"),
        "figure_units": Column("texts", "their units"),
    }

    def __post_init__(self) -> None:
        parse_model(self.model)
        check_confidence_level(self.confidence_level)

    @property
    def settings(self) -> dict[str, Any]:
        """What the rows depend on, ready for JSON."""
        return {"task": self.name, **asdict(self)}

    def rows(self, recordings: Sequence[Recording]) -> list[list[Row]]:
        """Rows of each recording, one for each sensor and axis."""
        return [self._rows(recording) for recording in recordings]

    def _rows(self, recording: Recording) -> list[Row]:
        fit = fit_gmwm(recording, self.model, refine=self.refine, confidence_level=self.confidence_level)
        low, high = fit.confidence_interval
        rows = []
        for number, index in enumerate(torch.cartesian_prod(*map(torch.arange, fit.params.shape[:-1])).tolist()):
            at = tuple(index) if isinstance(index, list) else (index,)
            fitted = bool(fit.params[at].isfinite().all())
            entries = fit.datasheet(at).entries if fitted and recording.unit in DATASHEET_UNITS else ()
            rows.append(
                {
                    "axis": recording.axes[at[0]] if recording.axes else None,
                    "sensor": recording.sensors[at[-1]],
                    "model": json.dumps(fit.model.with_params(fit.params[at]).to_dict()) if fitted else None,
                    "parameters": list(fit.param_names),
                    "values": fit.params[at].tolist(),
                    "low": low[at].tolist(),
                    "high": high[at].tolist(),
                    "p_value": float(fit.p_value[at]),
                    "converged": bool(fit.converged[at]),
                    "identified": bool(fit.identified[at]),
                    "remarks": list(fit.notes[number]),
                    "quantities": [entry.name for entry in entries],
                    "figures": [entry.value for entry in entries],
                    "figure_units": [entry.unit for entry in entries],
                }
            )
        return rows


@dataclass(frozen=True)
class Diagnose:
    """Effects in each log that a simulation leaves out.

    Attributes:
        simulation: Samples of the same array, or a noise model.
        false_alarm: Probability of a finding where the simulation leaves nothing out.
        source: Name of the simulation.

    Raises:
        TypeError: The simulation is neither samples nor a model.
        ValueError: `false_alarm` is not between 0 and 1.
    """

    simulation: Recording | Model | ArrayModel
    false_alarm: float = 0.01
    source: str = "simulation"

    name: ClassVar[str] = "diagnose"
    columns: ClassVar[dict[str, Column]] = {
        "axis": _AXIS,
        "mismatch": Column("truth", "whether the log differs from the simulation"),
        "p_value": Column("number", "of agreement between log and simulation"),
        "mechanisms": Column("texts", "what the simulation leaves out, by name"),
        "sentences": Column("texts", "the same in words, with numbers"),
        "unexplained": Column("texts", "differences that no mechanism accounts for"),
        "discrepancy_before": Column(
            "number", "of wavelet cross-covariances per degree of freedom on data held out; 1 is what noise alone gives"
        ),
        "discrepancy_after": Column("number", "the same with the repaired simulation"),
        "gain": Column("number", "log score of the repaired simulation over the given one on data held out, nats"),
        "findings": Column("text", "the findings as JSON"),
    }

    def __post_init__(self) -> None:
        if not isinstance(self.simulation, Recording | Model | ArrayModel):
            raise TypeError(
                f"`simulation`: expected a Recording or a noise model, got {type(self.simulation).__name__}; read a "
                "recording with read_recording(path), or a model in JSON with model_from_dict"
            )
        if not 0 < self.false_alarm < 1:
            raise ValueError(f"`false_alarm`: expected a number between 0 and 1 such as 0.01, got {self.false_alarm!r}")

    @property
    def settings(self) -> dict[str, Any]:
        """What the rows depend on, ready for JSON."""
        named = {"task": self.name, "simulation": self.source, "false_alarm": self.false_alarm}
        return {**named, "simulation_sha256": self._digest}

    @cached_property
    def _digest(self) -> str:
        """SHA-256 of the numbers of the simulation, which may change while its name does not."""
        if not isinstance(self.simulation, Recording):
            return hashlib.sha256(json.dumps(self.simulation.to_dict()).encode()).hexdigest()
        r = self.simulation
        arrays = {"signal": r.signal, "time": r.time, **r.channels}
        facts = [r.rate, r.unit, r.sensors, r.axes, {name: list(values.shape) for name, values in arrays.items()}]
        digest = hashlib.sha256(json.dumps(facts).encode())
        for values in arrays.values():
            digest.update(values.numpy(force=True).tobytes())
        return digest.hexdigest()

    def rows(self, recordings: Sequence[Recording]) -> list[list[Row]]:
        """Rows of each recording, one for each of its axes; one in all for a single device."""
        return [self._rows(recording.axes_as_sensors()) for recording in recordings]

    def _rows(self, recording: Recording) -> list[Row]:
        rows = []
        for axis in recording.axes or (None,):
            whole = (recording if axis is None else recording.select(axis=axis)).longest_whole()
            found = diagnose(whole, self.simulation, false_alarm=self.false_alarm)
            rows.append(
                {
                    "axis": axis,
                    "mismatch": found.mismatch,
                    "p_value": found.p_value,
                    "mechanisms": [f.mechanism for f in found.findings],
                    "sentences": [f.sentence for f in found.findings],
                    "unexplained": [e.words for e in found.unexplained],
                    "discrepancy_before": found.held_out.before,
                    "discrepancy_after": found.held_out.after,
                    "gain": found.held_out.gain,
                    "findings": json.dumps([f.to_dict() for f in found.findings]),
                }
            )
        return rows


Task = Fuse | Fit | Diagnose


def _gain(result: SVOResult) -> Tensor:
    """Wavelet variance of the plain mean over that of the virtual gyro in any other recording, `(level,)`."""
    if result.method == "equal":
        return torch.ones_like(result.virtual_wavelet_variance)
    return result.gain_over_equal().estimate


def relative_noise(wavelet_variance: Tensor) -> Tensor:
    """Allan deviation of each sensor over that of the median sensor of its array, `(sensor,)`.

    Geometric mean over the levels with known values.

    Args:
        wavelet_variance: Wavelet variances, `(level, sensor)`.
    """
    # torch.median takes the lower of two middle values; this takes their mean.
    ratio = (wavelet_variance / wavelet_variance.nanquantile(0.5, -1, keepdim=True)).sqrt()
    known = ratio.isfinite() & (ratio > 0)
    log = torch.where(known, ratio, torch.ones_like(ratio)).log().sum(0)
    return torch.where(known.any(0), log / known.sum(0).clamp(min=1), torch.full_like(log, math.nan)).exp()
