"""Diagnosis of the longest stretches without gaps, whose errors name files and options."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gyrofuse.cli.console import progress_bar
from gyrofuse.cli.reading import without_gaps
from gyrofuse.io.recording import Recording
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.processes import Model

if TYPE_CHECKING:
    from gyrofuse.mismatch import MismatchReport, SessionsReport
    from gyrofuse.mismatch.repair.repaired_model import RepairedModel
    from gyrofuse.mismatch.repair.session_model import SessionModel


@dataclass(frozen=True)
class Search:
    """A diagnosis of the longest stretches without gaps; its errors name the file and the option at fault.

    Attributes:
        simulation: What recordings are compared with.
        judge: Another recording of the device.
        simulation_name: Name of its file.
        judge_name: Name of its file.
        false_alarm: Value of `--false-alarm`.
        fitted_samples: Value of `--fitted-samples`.
    """

    simulation: Recording | Model | ArrayModel | RepairedModel | SessionModel
    judge: Recording | None
    simulation_name: str
    judge_name: str
    false_alarm: float
    fitted_samples: int | None

    def one(self, name: str, recording: Recording, twins: int) -> tuple[MismatchReport, list[str]]:
        """Report on a recording, and remarks on it."""
        from gyrofuse.mismatch import diagnose as find_mismatch
        from gyrofuse.mismatch.repair.inputs import FEWEST

        with progress_bar("comparing") as show, self._named({"`recording`": name, "`LOG`": name}):
            options, lacking = self._options()
            part, remarks = without_gaps(recording, "Diagnosed", FEWEST)
            found = find_mismatch(part, **options, twins=twins, progress=show)
        start = float(part.time[0])
        if start and found.mismatch:
            remarks.append(f"Times count from the first sample that was diagnosed, at {start:.6g} s of the log.")
        return found, remarks + lacking

    def several(self, recordings: Mapping[str, Recording]) -> tuple[SessionsReport, list[str]]:
        """Report on several recordings of one device by name, and remarks on them."""
        from gyrofuse.mismatch import diagnose_sessions
        from gyrofuse.mismatch.repair.inputs import FEWEST

        with progress_bar("comparing") as show, self._named({"`recordings`": ", ".join(recordings)}):
            options, remarks = self._options()
            parts = []
            for name, recording in recordings.items():
                with self._named({"`LOG`": name}):
                    part, gaps = without_gaps(recording, f"{name}: diagnosed", FEWEST)
                parts.append(part)
                remarks += gaps
            return diagnose_sessions(parts, **options, names=list(recordings), progress=show), remarks

    def _options(self) -> tuple[dict[str, Any], list[str]]:
        """What a diagnosis is given beside its recordings, and remarks on gaps of it."""
        simulation, judge, remarks = self.simulation, self.judge, list[str]()
        if isinstance(simulation, Recording):
            simulation, gaps = without_gaps(simulation, "Simulation: compared", 0)
            remarks += gaps
        if judge is not None:
            judge, gaps = without_gaps(judge, f"{self.judge_name}: judged", 0)
            remarks += gaps
        given = {"simulation": simulation, "judge": judge}
        return {**given, "false_alarm": self.false_alarm, "fitted_samples": self.fitted_samples}, remarks

    @contextmanager
    def _named(self, names: Mapping[str, str]) -> Iterator[None]:
        """Errors with files and options in the place of parameters."""
        options = {"false_alarm": "--false-alarm", "twins": "--twins", "fitted_samples": "--fitted-samples"}
        files = {"`simulation`": self.simulation_name, "`judge`": self.judge_name, **names}
        try:
            yield
        except (ValueError, TypeError) as error:
            message = str(error)
            for parameter, name in {**files, **{f"`{p}`": f"`{option}`" for p, option in options.items()}}.items():
                message = message.replace(parameter, name)
            raise type(error)(message) from None
