"""Diagnosis of several recordings of one device, taken one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gyrofuse._base.checks import repeatable_generator, same_rate
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.diagnose import diagnose
from gyrofuse.mismatch.repair.inputs import Simulation, modelled, on_processor
from gyrofuse.mismatch.repair.session_model import SessionModel
from gyrofuse.mismatch.reporting.judge import checked_judge, judged
from gyrofuse.mismatch.several.progress import part_of
from gyrofuse.mismatch.several.recurrence import causes_of
from gyrofuse.mismatch.several.sessions_report import SessionsReport
from gyrofuse.mismatch.stats.multiplicity import sidak, sidak_level


def diagnose_sessions(
    recordings: Sequence[Recording | Tensor],
    simulation: Simulation,
    *,
    names: Sequence[str] = (),
    false_alarm: float = 0.01,
    rate: float | None = None,
    fitted_samples: int | None = None,
    judge: Recording | Tensor | None = None,
    generator: torch.Generator | None = None,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> SessionsReport:
    """Find what several recordings of a device have that a simulation left out, and to what each belongs.

    Every recording is diagnosed by itself. A cause that all have with the same numbers is the device's; one whose
    numbers differ, or that some have, is a session's, drawn anew whenever the device is used; the rest happened once.

    Args:
        recordings: Of the same sensors, at one rate and in one unit; as for `diagnose`, two or more.
        simulation: As for `diagnose`.
        names: Of the recordings, for reports; numbers by default.
        false_alarm: Probability of any finding in any of them where nothing is missing.
        rate: Hz, for recordings given as tensors; 1 by default.
        fitted_samples: As for `diagnose`.
        judge: Another recording of the device, of which nothing is estimated.
        generator: Source of random numbers; by default one with a fixed seed.
        progress: As for `diagnose`.

    Returns:
        Causes with their scope, the diagnosis of each recording, and a simulation that draws sessions.

    Raises:
        TypeError: A single recording, recordings of different kinds, or what `diagnose` refuses.
        ValueError: Fewer than two recordings, recordings that do not fit each other, or what `diagnose` refuses.
    """
    if isinstance(recordings, Recording | Tensor):
        raise TypeError(
            f"`recordings`: expected a sequence of two or more, got one {type(recordings).__name__}; use `diagnose`"
        )
    recordings = list(recordings)
    if len(recordings) < 2:
        raise ValueError(
            f"`recordings`: expected two or more of one device, got {len(recordings)}; use `diagnose` for one"
        )
    names = tuple(names) or tuple(map(str, range(1, len(recordings) + 1)))
    if len(names) != len(recordings):
        raise ValueError(f"`names`: expected {len(recordings)}, one of each recording, got {len(names)}")
    generator = repeatable_generator(generator)
    recordings = [on_processor(_fitting(one, recordings[0], name)) for one, name in zip(recordings, names, strict=True)]
    if judge is not None:
        judge = checked_judge(on_processor(judge), recordings[0], rate)
    reports = []
    for k, recording in enumerate(recordings):
        try:
            report = diagnose(
                recording,
                simulation,
                false_alarm=sidak_level(false_alarm, len(recordings)),
                rate=rate,
                fitted_samples=fitted_samples,
                generator=generator,
                progress=part_of(progress, names, k),
            )
        except ValueError as error:
            raise ValueError(str(error).replace("`recording`", f"`recordings`: {names[k]}")) from None
        reports.append(report)
    model = SessionModel(tuple(report.model for report in reports))
    verdict = None
    if judge is not None:
        known = on_processor(modelled(simulation, judge, fitted_samples))
        missing = any(report.mismatch for report in reports)
        verdict = judged(judge, recordings, known, model.models if missing else [], rate)
    return SessionsReport(
        names=names,
        reports=tuple(reports),
        causes=causes_of([report.findings for report in reports]),
        p_value=sidak(min(report.p_value for report in reports), len(reports)),
        model=model,
        judged=verdict,
    )


def _fitting(recording: Recording | Tensor, first: Recording | Tensor, name: str) -> Recording | Tensor:
    """A recording in the unit of the first one, of the same sensors at the same rate."""
    if isinstance(recording, Recording) != isinstance(first, Recording):
        raise TypeError(f"`recordings`: expected all of one kind, got {name} as a {type(recording).__name__}")
    if not isinstance(recording, Recording) or not isinstance(first, Recording):
        return recording
    if not same_rate(recording.rate, first.rate):
        raise ValueError(
            f"`recordings`: expected the {first.rate:g} Hz of the first one in all, got {recording.rate:g} Hz in "
            f"{name}; resample it"
        )
    if recording.signal.shape[:-1] != first.signal.shape[:-1]:
        raise ValueError(
            f"`recordings`: expected the {first.n_sensors} sensors of the first one in all, got "
            f"{recording.n_sensors} in {name}; give the same sensors of one axis"
        )
    return recording if "unknown" in (recording.unit, first.unit) else recording.to(first.unit)
