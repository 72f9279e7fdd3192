"""What comes in: a recording and a simulation made comparable, or a clear word why they are not."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive, check_positive_integer, check_signal, same_rate
from gyrofuse._base.results import named, numbered
from gyrofuse.fitting.array.result import ArrayGMWMResult
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.joint import JointFit
from gyrofuse.fitting.ranking.result import RankResult
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.detectors.variance.level_spread import with_spread
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.repair.session_model import SessionModel, records_for
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.fitted_spectra import SpectralUncertainty, as_array
from gyrofuse.mismatch.signals.known_lines import amplitudes
from gyrofuse.mismatch.signals.lines import simulated_lines
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.estimation import EstimatedFrom
from gyrofuse.noise.model import Model
from gyrofuse.noise.parsing import model_from_dict

# Whatever a diagnosis takes for a simulation.
Simulation = (
    Recording
    | Tensor
    | Model
    | ArrayModel
    | RepairedModel
    | SessionModel
    | GMWMResult
    | ArrayGMWMResult
    | JointFit
    | RankResult
)
FEWEST = 4096
# Of a model: records as long as the recording. The information on an effect grows as m/(1 + m), the work as m.
_FEWEST_RECORDS, _MOST_RECORDS, _MOST_VALUES = 4, 16, 2**23
_SINGULAR = 1e-10  # of correlation matrices
_SEARCHES = 4  # for lines


def on_processor(given: Any) -> Any:
    """Samples or a model in the processor's memory, where a diagnosis is made; anything else as it is."""
    if isinstance(given, Tensor):
        return given.cpu()
    parts: list[Any]
    if isinstance(given, Recording):
        parts = [given.signal, given.time, *given.channels.values()]
    elif isinstance(given, Model):
        parts = [value for process in given.processes for value in process.parameters.values()]
    elif isinstance(given, ArrayModel):
        parts = [part for process, matrix in given.components for part in (matrix, *process.parameters.values())]
    else:
        return given
    if not any(isinstance(part, Tensor) and part.device.type != "cpu" for part in parts):
        return given
    if not isinstance(given, Recording):
        return model_from_dict(given.to_dict())
    channels = {name: values.cpu() for name, values in given.channels.items()}
    return replace(given, signal=given.signal.cpu(), time=given.time.cpu(), channels=channels)


def modelled(
    simulation: Simulation, recording: Recording | Tensor, fitted_samples: int | None = None
) -> Recording | Tensor | Model | ArrayModel | RepairedModel:
    """The simulation as samples or a model that knows what it was estimated from; that of a fit is its model.

    Args:
        simulation: Samples, a model, or a fit.
        recording: What it is compared with; of a model that draws sessions, samples for it are taken.
        fitted_samples: Of each sensor, that a model without a record of its own was estimated from.

    Raises:
        ValueError: Not a positive number, samples of a model that says so itself or of what is none, a fit at another
            rate, or a ranking without a fit of every sensor.
    """
    if isinstance(simulation, RankResult):
        best = [fit.model for fit in simulation.best if fit is not None]
        if len(best) < len(simulation.best) or not best:
            raise ValueError(
                "`simulation`: expected a ranking with the fit of every sensor in `best`, got one that lacks some; "
                "rank with `fit=True` and without sensors that cannot be fitted"
            )
        simulation = ArrayModel.from_sensors(best)
    if isinstance(simulation, GMWMResult | ArrayGMWMResult | JointFit):
        fitted = (simulation.joint if isinstance(simulation, JointFit) else simulation).rate
        if isinstance(recording, Recording) and fitted is not None and not same_rate(fitted, recording.rate):
            raise ValueError(
                f"`simulation`: expected a fit of records at {recording.rate:g} Hz as of the recording, got one at "
                f"{fitted:g} Hz; its numbers are per sample: fit a record at this rate"
            )
        simulation = simulation.model
    if isinstance(simulation, SessionModel):
        return _sessions(simulation, recording)
    if fitted_samples is None:
        return simulation
    check_positive_integer("fitted_samples", fitted_samples)
    if not isinstance(simulation, Model | ArrayModel) or simulation.estimated_from is not None:
        what = "one that has its own" if isinstance(simulation, Model | ArrayModel) else type(simulation).__name__
        raise ValueError(
            "`fitted_samples`: expected with a noise model that does not know what it was estimated from, got "
            f"{what}; leave it out"
        )
    source = EstimatedFrom(fitted_samples)
    if isinstance(simulation, Model):
        return Model([simulation], estimated_from=source)
    return ArrayModel(simulation.components, estimated_from=source)


def _sessions(model: SessionModel, recording: Recording | Tensor) -> Recording | Tensor:
    """Samples of a model that draws sessions, of each session as many, for a recording."""
    generator = torch.Generator().manual_seed(0)
    channels = None
    if isinstance(recording, Recording):
        channels = recording.channels
        model.check(recording.rate, recording.unit, channels)
    return records_for(model, recording, _FEWEST_RECORDS, channels, generator)


def prepared(
    recording: Recording | Tensor,
    simulation: Recording | Tensor | Model | ArrayModel | RepairedModel,
    rate: float | None,
    generator: torch.Generator,
) -> Comparison:
    """Recording and simulation as a case, after all that can be said at the door."""
    if isinstance(recording, Recording):
        if rate is not None:
            raise ValueError(
                f"`rate`: expected none, since the recording has one ({recording.rate:g} Hz), got {rate!r}"
            )
        recording = recording.axes_as_sensors()
        signal = recording.signal
        info = RecordingInfo(recording.rate, recording.unit, recording.sensors, dict(recording.channels))
    else:
        signal = check_signal("recording", recording)
        info = RecordingInfo(
            1.0 if rate is None else check_positive("rate", rate), "unknown", numbered(signal.shape[-2])
        )
    signal = _checked("recording", signal, info)
    noise_samples = 0
    if isinstance(simulation, RepairedModel):
        known = replace(simulation.info, channels=info.channels)
        replace(simulation, info=known).check(info.rate, info.unit)
        noise_samples, simulation = simulation.noise_samples, simulation.noise
    gaussian = isinstance(simulation, Model | ArrayModel)
    if isinstance(simulation, Model | ArrayModel):
        drawn = _drawn(simulation, len(signal), signal.shape[-1], generator)
    else:
        drawn = _samples(simulation, info, signal.shape[-1], from_tensor=not isinstance(recording, Recording))
    if drawn.shape[-2] != signal.shape[-2]:
        raise ValueError(
            f"`simulation`: expected {signal.shape[-2]} sensors as in the recording, got {drawn.shape[-2]}; "
            "simulate the same array, or select its sensors"
        )
    _check_own("recording", signal)
    _check_own("simulation", drawn[0])
    comparison = Comparison.of(info, signal, drawn)
    uncertainty = None
    if isinstance(simulation, Model | ArrayModel):
        array = simulation if isinstance(simulation, ArrayModel) else as_array(simulation, len(signal))
        uncertainty = SpectralUncertainty.of(array)
    comparison = replace(
        comparison,
        reference=replace(comparison.reference, gaussian=gaussian, uncertainty=uncertainty),
        seed=generator.initial_seed(),
    )
    return with_spread(comparison.knowing(_lines(simulation, comparison)), noise_samples)


def same_data_words(given: Comparison, judge: Recording | Tensor | None) -> str:
    """A sentence on data that were given twice, sample by sample; empty where none were.

    Args:
        given: Recording and simulation as they came.
        judge: Another recording, in the recording's unit; None for none.
    """
    others = {"simulation": list(given.reference.signal)}
    if judge is not None:
        others["judge"] = [judge.signal if isinstance(judge, Recording) else judge]
    for name, signals in others.items():
        for signal in signals:
            n = min(signal.shape[-1], given.n_samples)
            if torch.equal(signal[:, :n].to(given.recording), given.recording[:, :n]):
                return (
                    f"Recording and {name} are the same data, sample by sample: that they agree says nothing. Give "
                    f"another {name}."
                )
    return ""


def _lines(simulation: Recording | Tensor | Model | ArrayModel, comparison: Comparison) -> tuple[float, ...]:
    """Frequencies of the simulation's tones, cycles per sample: those that its model names, and those to be seen.

    Strongest first; of those that are seen none that wanders: it is noise, of which the recording has other peaks.
    """
    named = simulation.lines if isinstance(simulation, Model) else ()
    lines: list[float] = []
    apart = 1 / comparison.n_samples  # closer, or so near to the ends, lines are one or none

    def added(frequencies: Iterable[float]) -> bool:
        before = len(lines)
        for f in frequencies:
            if apart < f < 0.5 - apart and all(abs(f - other) > apart for other in lines):
                lines.append(f)
        return len(lines) > before

    added(f for line in named for f in line.frequency.flatten().tolist())
    for _ in range(_SEARCHES):  # the side lobes of strong lines hide weak ones
        if not added(simulated_lines(comparison.knowing(tuple(lines)).reference)):
            break
    if not named:
        restless = comparison.wandering(tuple(lines))
        lines = [f for f in lines if f not in restless]
    strength = amplitudes(comparison.reference.signal, tuple(lines)).mean((0, 1)) if lines else torch.zeros(0)
    return tuple(lines[i] for i in strength.argsort(descending=True).tolist())


def _drawn(model: Model | ArrayModel, n_sensors: int, n_samples: int, generator: torch.Generator) -> Tensor:
    """Records of a model, `(record, sensor, time)`."""
    n_records = min(max(_MOST_VALUES // (n_sensors * n_samples), _FEWEST_RECORDS), _MOST_RECORDS)
    if isinstance(model, ArrayModel):
        return model.simulate(n_samples, batch=(n_records,), generator=generator)
    own = model.params.shape[:-1]
    if own == (1,):  # one sensor's, for all
        model, own = model.with_params(model.params[0]), torch.Size()
    if own not in ((), (n_sensors,)):
        raise ValueError(
            f"`simulation`: expected a model of one sensor, or with parameters ({n_sensors},) for each, "
            f"got parameters of shape {tuple(own)}"
        )
    return model.simulate(n_samples, batch=(n_records, *(() if own else (n_sensors,))), generator=generator)


def _samples(simulation: Recording | Tensor, info: RecordingInfo, n_samples: int, *, from_tensor: bool) -> Tensor:
    """Given samples as records `(record, sensor, time)` of the recording's length, or one of their own."""
    if isinstance(simulation, Recording):
        simulation = simulation.axes_as_sensors()
        signal = simulation.signal
        if not from_tensor and not same_rate(simulation.rate, info.rate):
            raise ValueError(
                f"`simulation`: expected samples at {info.rate:g} Hz as in the recording, got {simulation.rate:g} Hz; "
                "simulate at the recording's rate, or resample"
            )
        if not from_tensor and simulation.sensors != info.sensors and set(simulation.sensors) == set(info.sensors):
            raise ValueError(
                f"`simulation`: expected the sensors in the order {', '.join(info.sensors)} of the recording, got "
                f"{', '.join(simulation.sensors)}; reorder them with `select(sensors=...)`"
            )
        both = {info.unit, simulation.unit}
        if len(both) == 2 and "unknown" not in both:
            signal = simulation.to(info.unit).signal
    elif isinstance(simulation, Tensor):
        signal = check_signal("simulation", simulation)
    else:
        raise TypeError(
            "`simulation`: expected a recording, a tensor (sensor, time), a model, an array model, a repaired one or a "
            f"fit, got {type(simulation).__name__}"
        )
    signal = _checked("simulation", signal, info)
    n_records = signal.shape[-1] // n_samples
    if not n_records:
        return signal[None]
    return signal[:, : n_records * n_samples].unflatten(-1, (n_records, n_samples)).movedim(1, 0)


def _checked(name: str, signal: Tensor, info: RecordingInfo) -> Tensor:
    """A whole, moving signal `(sensor, time)` in float64."""
    if signal.ndim != 2:
        raise ValueError(f"`{name}`: expected (sensor, time), got shape {tuple(signal.shape)}; give one axis at a time")
    if signal.shape[-1] < FEWEST:
        raise ValueError(
            f"`{name}`: expected at least {FEWEST} samples for a diagnosis, got {signal.shape[-1]}; give a longer one"
        )
    missing = (~signal.isfinite()).any(-1).nonzero()[:, 0].tolist()
    if missing:
        raise ValueError(
            f"`{name}`: expected whole sensors, got missing samples in {named(_names(info, len(signal)), missing)}; "
            "give a stretch without gaps"
        )
    constant = (signal.amax(-1) == signal.amin(-1)).nonzero()[:, 0].tolist()
    if constant:
        raise ValueError(
            f"`{name}`: expected sensors that move, got constant ones: {named(_names(info, len(signal)), constant)}; "
            "leave them out"
        )
    return signal.to(torch.float64)


def _check_own(name: str, signal: Tensor) -> None:
    """Every sensor has to have something of its own: spectra of what adds up to nothing have no inverse."""
    change = signal.diff()
    change = change / change.norm(dim=-1, keepdim=True)
    if float(torch.linalg.eigvalsh(change @ change.mT)[0]) < _SINGULAR:
        raise ValueError(
            f"`{name}`: expected sensors with noise of their own, got some that are a sum of others (deviations from "
            "a mean add up to nothing); leave one of them out"
        )


def _names(info: RecordingInfo, n: int) -> tuple[str, ...]:
    return info.sensors if len(info.sensors) == n else numbered(n)
