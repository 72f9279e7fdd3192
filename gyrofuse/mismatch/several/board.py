"""Diagnosis of a whole board: gyros and accelerometers of all axes and devices together."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch

from gyrofuse._base.checks import repeatable_generator
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.diagnose import diagnose
from gyrofuse.mismatch.repair.inputs import Simulation
from gyrofuse.mismatch.several.board_causes import GroupFindings, board_causes
from gyrofuse.mismatch.several.board_report import BoardReport
from gyrofuse.mismatch.several.progress import part_of
from gyrofuse.mismatch.stats.multiplicity import sidak, sidak_level
from gyrofuse.noise.model import Model


def diagnose_board(
    recordings: Mapping[str, Recording],
    simulations: Mapping[str, Simulation],
    *,
    false_alarm: float = 0.01,
    fitted_samples: int | None = None,
    judges: Mapping[str, Recording] | None = None,
    generator: torch.Generator | None = None,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> BoardReport:
    """Find what simulations of a board's gyros and accelerometers left out; a cause that several share is told once.

    Every group of sensors is diagnosed by itself, at its own rate, with all its axes and devices and its own auxiliary
    channels. Findings are one cause where they are the same line, the same physics at one time or on one channel, or
    where numbers of the same physics agree.

    Args:
        recordings: By the name of the group, such as `"rate"` and `"acceleration"`: all axes and devices of each.
        simulations: What is simulated of each group; as for `diagnose`. A model of several axes has parameters for each
            axis and device.
        false_alarm: Probability of a finding in any group where nothing is missing.
        fitted_samples: As for `diagnose`.
        judges: Another recording of the same groups, of which nothing is estimated.
        generator: Source of random numbers; by default one with a fixed seed.
        progress: As for `diagnose`.

    Returns:
        Causes, and the diagnosis of each group.

    Raises:
        TypeError: No mapping, or what `diagnose` refuses.
        ValueError: No group, other groups among simulations or judges, or what `diagnose` refuses of a group, with its
            name.
    """
    for name, given in (("recordings", recordings), ("simulations", simulations), ("judges", judges)):
        if given is not None and not isinstance(given, Mapping):
            raise TypeError(
                f"`{name}`: expected a mapping from the names of groups, such as 'rate' and 'acceleration', got "
                f"{type(given).__name__}; use `diagnose` for a single group"
            )
    if not recordings:
        raise ValueError("`recordings`: expected one group of sensors or more, got none")
    for name, other in (("simulations", simulations), ("judges", judges)):
        if other is not None and other.keys() != recordings.keys():
            raise ValueError(
                f"`{name}`: expected the groups {', '.join(recordings)} of the recordings, got {', '.join(other)}"
            )
    generator = repeatable_generator(generator)
    reports = {}
    for k, (name, recording) in enumerate(recordings.items()):
        simulation = simulations[name]
        try:
            reports[name] = diagnose(
                recording.flat(),
                _flat(simulation),
                false_alarm=sidak_level(false_alarm, len(recordings)),
                fitted_samples=fitted_samples,
                judge=None if judges is None else judges[name].flat(),
                generator=generator,
                progress=part_of(progress, tuple(recordings), k),
            )
        except (ValueError, TypeError) as error:
            raise type(error)(f"{name}: {error}") from None
    groups = {name: GroupFindings(report.findings, report.comparison) for name, report in reports.items()}
    return BoardReport(
        names=tuple(reports),
        reports=tuple(reports.values()),
        p_value=sidak(min(report.p_value for report in reports.values()), len(reports)),
        causes=board_causes(groups),
    )


def _flat(simulation: Simulation) -> Simulation:
    """A simulation whose axes are sensors, as those of the recording are."""
    if isinstance(simulation, Recording):
        return simulation.flat()
    if isinstance(simulation, GMWMResult):
        simulation = simulation.model
    if not isinstance(simulation, Model) or simulation.params.ndim < 3:
        return simulation
    source = simulation.estimated_from
    if source is not None and source.param_cov is not None:
        source = replace(source, param_cov=source.param_cov.flatten(0, -3))
    return simulation.with_params(simulation.params.flatten(0, -2), estimated_from=source)
