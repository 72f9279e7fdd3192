"""One damped descent for many problems at once: Levenberg-Marquardt, Newton or scoring, as the steps have it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Trial(NamedTuple):
    """A step of the problems that still go on.

    Attributes:
        state: Where it leads, in the order of the state, `(problem, ...)` each.
        objective: Objective there, `(problem,)`.
        better: Whether the step is taken, `(problem,)`.
        last: Whether no further step is worth it, taken or not, `(problem,)`.
    """

    state: Sequence[Tensor]
    objective: Tensor
    better: Tensor
    last: Tensor


# Trial of the problems `todo` `(problem,)` with their state, objective and damping.
Attempt = Callable[[Tensor, list[Tensor], Tensor, Tensor], Trial]


def descend(
    state: Sequence[Tensor],
    objective: Tensor,
    attempt: Attempt,
    *,
    n_steps: int,
    ease: float,
    tighten: float,
    damping: float = 1e-3,
    most_damping: float = 1e10,
) -> tuple[list[Tensor], Tensor, Tensor]:
    """Go downhill with steps whose damping falls where they succeed and rises where they fail.

    Args:
        state: Where to start, `(problem, ...)` each; left as it is.
        objective: Objective there, `(problem,)`; a problem that starts at one that is not finite does not move.
        attempt: Makes a step of some of the problems.
        n_steps: Largest number of steps.
        ease: Factor by which damping falls after a step that was taken.
        tighten: Factor by which it rises after one that was not.
        damping: First damping, relative to the curvatures: little, as most searches start near a minimum.
        most_damping: Damping, relative to the curvatures, beyond which a step fails for rounding alone and the search
            ends.

    Returns:
        State, objective, and whether the search ended before its last step, `(problem,)`.
    """
    state = [value.clone() for value in state]
    objective = objective.clone()
    dampings = torch.full_like(objective, damping)
    least_damping = 1e-12  # far below the rounding of any curvature, yet above zero, so that it can rise again
    done = ~objective.isfinite()
    for _ in range(n_steps):
        todo = (~done).nonzero()[:, 0]
        if not len(todo):
            break
        trial = attempt(todo, [value[todo] for value in state], objective[todo], dampings[todo])
        taken = todo[trial.better]
        for value, tried in zip(state, trial.state, strict=True):
            value[taken] = tried[trial.better]
        objective[taken] = trial.objective[trial.better]
        own = torch.where(trial.better, dampings[todo] / ease, dampings[todo] * tighten).clamp(min=least_damping)
        dampings[todo] = own
        done[todo] = trial.last | (own > most_damping)
    return state, objective, done
