"""One descent for many problems: each ends at its own minimum, whatever the others do."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor

from gyrofuse._base.chunks import CACHE, MEMORY, items_at_once
from gyrofuse._base.optimize import Trial, descend


def rosenbrock(x: Tensor) -> Tensor:
    return (1 - x[:, 0]).square() + 100 * (x[:, 1] - x[:, 0].square()).square()


def attempt(todo: Tensor, state: list[Tensor], old: Tensor, damping: Tensor) -> Trial:
    """A Levenberg-Marquardt step on the two residuals of Rosenbrock's function."""
    (x,) = state
    residual = torch.stack([1 - x[:, 0], 10 * (x[:, 1] - x[:, 0].square())], -1)
    one, zero = torch.ones_like(x[:, 0]), torch.zeros_like(x[:, 0])
    jacobian = torch.stack([torch.stack([-one, zero], -1), torch.stack([-20 * x[:, 0], 10 * one], -1)], -2)
    normal = jacobian.mT @ jacobian + torch.diag_embed(damping[:, None].expand(-1, 2))
    step = -torch.linalg.solve(normal, (jacobian.mT @ residual[..., None])[..., 0])
    new = rosenbrock(x + step)
    return Trial((x + step,), new, new < old, step.abs().amax(-1) < 1e-10)


def run(start: Tensor, n_steps: int = 200) -> tuple[Tensor, Tensor, Tensor]:
    (x,), objective, done = descend((start,), rosenbrock(start), attempt, n_steps=n_steps, ease=5, tighten=4)
    return x, objective, done


def test_every_problem_ends_at_its_minimum_as_it_does_alone():
    start = torch.tensor([[-1.2, 1.0], [0.0, 3.0], [1.0, 1.0]], dtype=torch.float64)
    kept = start.clone()
    x, objective, done = run(start)
    assert bool(done.all())
    torch.testing.assert_close(x, torch.ones_like(x), rtol=0, atol=1e-8)
    torch.testing.assert_close(objective, rosenbrock(x))
    assert torch.equal(start, kept)
    for i in range(len(start)):
        alone, *_ = run(start[i : i + 1])
        torch.testing.assert_close(alone[0], x[i], rtol=0, atol=1e-12)


def test_no_step_goes_uphill_and_too_few_do_not_end_a_search():
    start = torch.tensor([[-1.2, 1.0]], dtype=torch.float64)
    values = [run(start, n)[1].item() for n in range(8)]
    assert values[0] == rosenbrock(start).item()
    assert all(later <= earlier for earlier, later in pairwise(values))
    assert not bool(run(start, 3)[2])


def test_a_problem_that_is_not_finite_stays_where_it_is():
    start = torch.tensor([[math.nan, 1.0], [0.0, 0.0]], dtype=torch.float64)
    x, _, done = run(start)
    assert bool(done.all())
    assert x[0, 0].isnan()
    torch.testing.assert_close(x[1], torch.ones(2, dtype=torch.float64), rtol=0, atol=1e-8)


def test_a_search_whose_steps_all_fail_ends():
    calls = []

    def failing(todo: Tensor, state: list[Tensor], old: Tensor, damping: Tensor) -> Trial:
        calls.append(damping.item())
        return Trial(state, old, torch.zeros_like(old, dtype=torch.bool), torch.zeros_like(old, dtype=torch.bool))

    _, _, done = descend((torch.zeros(1, 2),), torch.ones(1), failing, n_steps=1000, ease=10, tighten=10)
    assert bool(done)
    assert len(calls) < 20
    assert calls[0] < calls[-1] <= 1e10 * (1 + 1e-6)


def test_parts_fit_the_budget_and_are_never_empty():
    assert items_at_once(1) == MEMORY
    assert items_at_once(MEMORY // 2 + 1) == 1
    assert items_at_once(10 * MEMORY) == 1
    assert items_at_once(0) == MEMORY
    assert items_at_once(4, CACHE) == CACHE // 4
