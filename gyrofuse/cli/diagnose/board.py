"""Gyros and accelerometers of a log together: what `diagnose --quantity all` reads and writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from gyrofuse._base.units import quantity_of
from gyrofuse.cli.console import progress, progress_bar, say
from gyrofuse.cli.options import Quantity, Reading, Writing
from gyrofuse.cli.reading import at_rest, json_object, model_grid, naming, on_grid, read_model, titled, without_gaps
from gyrofuse.io.recording import Recording

_GROUPS = (Quantity.rate, Quantity.acceleration)


@dataclass(frozen=True)
class BoardInputs:
    """What is diagnosed, and beside what.

    Attributes:
        logs: Files of the board.
        simulations: Log of both quantities, or models of each.
        judge: Another log of the board.
        reading: Options of reading.
        resting: Start and end of the stretch that is used, s; None for all.
    """

    logs: Sequence[Path]
    simulations: Sequence[Path]
    judge: Path | None
    reading: Reading
    resting: tuple[float, float] | None

    @property
    def files(self) -> list[Path | None]:
        """All files that are read."""
        return [*self.logs, *self.simulations, self.judge, self.reading.mounting]

    def recordings(self, logs: Sequence[Path]) -> dict[str, Recording]:
        """Both quantities of logs."""
        return {kind.value: replace(self.reading, quantity=kind).read(logs) for kind in _GROUPS}

    def simulated(self) -> dict[str, Any]:
        """What is simulated of both quantities.

        Raises:
            ValueError: Models of other quantities, or of one twice, or models that do not say what they are of.
        """
        if not any(path.suffix.lower() == ".json" for path in self.simulations):
            return self.recordings(self.simulations)
        found: dict[str, Any] = {}
        for path in self.simulations:
            for quantity, model in _models(path).items():
                if quantity in found:
                    raise ValueError(
                        f"{path}: expected a model of the other quantity, got a second one of {quantity}; give one of "
                        "the gyros and one of the accelerometers"
                    )
                found[quantity] = model
        missing = [kind.value for kind in _GROUPS if kind.value not in found]
        if missing:
            raise ValueError(
                f"`--simulation`: expected models of rate and acceleration, got none of {' and '.join(missing)}; give "
                "it as well, as fit --model-out writes it"
            )
        return found


def check_of_board(n_recordings: int, *, corrected: Path | None, twins: int) -> None:
    """Refuse what a whole board has not.

    Raises:
        ValueError: An option that is of one recording of one quantity.
    """
    refused = {"--apart": n_recordings > 1, "--corrected": corrected is not None, "--twins": twins > 0}
    for option, given in refused.items():
        if given:
            raise ValueError(
                f"`{option}`: expected with one --quantity, got it with all; diagnose the gyros and the accelerometers "
                "by themselves"
            )


def diagnose_whole_board(
    board: BoardInputs, false_alarm: float, fitted_samples: int | None, model_out: Path | None, writing: Writing
) -> None:
    """Diagnose a board, write what was asked for, and print the summary.

    Args:
        board: What is read.
        false_alarm: Value of `--false-alarm`.
        fitted_samples: Value of `--fitted-samples`.
        model_out: Where the repaired simulations go.
        writing: Files to write.
    """
    from gyrofuse.mismatch import diagnose_board
    from gyrofuse.mismatch.repair.inputs import FEWEST

    with writing.files(board.files, model_out=model_out) as files:
        recordings = board.recordings(board.logs)
        simulations = board.simulated()
        judges = None if board.judge is None else board.recordings([board.judge])
        remarks = list[str]()
        with naming(board.logs):
            for name, recording in recordings.items():
                recordings[name], said = without_gaps(
                    _like(simulations[name], at_rest(recording, board.resting)), f"{name}: diagnosed", FEWEST
                )
                remarks += said
                if judges is not None:
                    judges[name], said = without_gaps(_like(simulations[name], judges[name]), f"{name}: judged", 0)
                    remarks += said
                if isinstance(simulations[name], Recording):
                    simulations[name], said = without_gaps(simulations[name], f"{name}: simulation compared", 0)
                    remarks += said
        with progress_bar("comparing") as show, naming(board.logs):
            found = diagnose_board(
                recordings,
                {name: one.model if isinstance(one, _OfFile) else one for name, one in simulations.items()},
                false_alarm=false_alarm,
                fitted_samples=fitted_samples,
                judges=judges,
                progress=show,
            )
        files.write_json(found.models_to_dict, "model-out")
        if writing.report:
            with progress("drawing"):
                title = f"{titled(board.logs)} against {' and '.join(path.name for path in board.simulations)}"
                found.to_html(files.draft("report"), title=title, remarks=remarks)
        sources: dict[str, object] = {
            "recording": [path.name for path in board.logs],
            "simulation": [path.name for path in board.simulations],
        }
        if board.judge is not None:
            sources["judge"] = board.judge.name
        files.write_json(lambda: {**sources, **found.to_dict()})
    say("\n".join([found.summary(), *remarks, *files.note]))


class _OfFile(NamedTuple):
    """A model with what its file says of it."""

    model: Any
    path: Path
    rate: float | None
    unit: str | None


def _models(path: Path) -> dict[str, _OfFile]:
    """Models of a file by what they are of: those of a repaired board, or a single one that has a unit."""
    content = json_object(path)
    if isinstance(content.get("groups"), dict):
        from gyrofuse.mismatch.repair.serialise import repaired_from_dict

        models = {name: repaired_from_dict(one) for name, one in content["groups"].items()}
        return {name: _OfFile(model, path, model.info.rate, model.info.unit) for name, model in models.items()}
    rate, unit = model_grid(path)
    quantity = None if unit is None else quantity_of(unit)
    if quantity is None:
        raise ValueError(
            f"{path}: expected a model with the unit of a rate or an acceleration, got {unit or 'none'}; fit it to a "
            "log that has one"
        )
    return {quantity: _OfFile(read_model(path), path, rate, unit)}


def _like(simulation: Any, recording: Recording) -> Recording:
    """A recording in the unit of a model, whose rate it has to have."""
    if not isinstance(simulation, _OfFile):
        return recording
    return on_grid(recording, simulation.path, simulation.rate, simulation.unit)
