"""Hidden Markov chains: the likelihood of all paths, posteriors of the states, and the most likely path.

References: Rabiner, A tutorial on hidden Markov models and selected applications in speech recognition, Proc. IEEE 77
(1989), 257.
"""

from __future__ import annotations

import torch
from torch import Tensor


def forward_backward(log_likelihood: Tensor, start: Tensor, transition: Tensor) -> tuple[Tensor, Tensor]:
    """Log likelihood of all paths together `(item,)`, and posterior probabilities of states `(item, step, state)`.

    Args:
        log_likelihood: Log likelihood of each step in each state, `(item, step, state)`.
        start: Probabilities of the first state, `(state,)`.
        transition: Probabilities of steps from state (row) to state (column), `(state, state)`.
    """
    peak = log_likelihood.amax(-1, keepdim=True)
    likelihood = (log_likelihood - peak).clamp(min=-500.0).exp()  # no state is impossible to rounding
    total, before = peak.sum((-1, -2)), start.expand(len(peak), -1)
    forward = []
    for here in likelihood.unbind(1):
        both = before * here
        size = both.sum(-1, keepdim=True)
        total = total + size[:, 0].log()
        forward.append(both / size)
        before = forward[-1] @ transition
    after, states = torch.ones_like(before), [forward[-1]]
    for earlier, here in zip(forward[-2::-1], likelihood.flip(1).unbind(1), strict=False):
        after = (after * here) @ transition.mT
        after = after / after.sum(-1, keepdim=True)
        both = earlier * after
        both = torch.where(both.sum(-1, keepdim=True) > 0, both, earlier)  # where both underflow
        states.append(both / both.sum(-1, keepdim=True))
    return total, torch.stack(states[::-1], 1)


def most_likely_path(log_likelihood: Tensor, start: Tensor, transition: Tensor) -> Tensor:
    """States `(step,)` of the most likely path (Viterbi's algorithm).

    Args:
        log_likelihood: Log likelihood of each step in each state, `(step, state)`.
        start: Probabilities of the first state, `(state,)`.
        transition: Probabilities of steps from state (row) to state (column), `(state, state)`.
    """
    log_transition, best = transition.log(), start.log() + log_likelihood[0]
    came_from = []
    for here in log_likelihood[1:]:
        best, source = (best[:, None] + log_transition).max(0)
        came_from.append(source)
        best = best + here
    path = [int(best.argmax())]
    for source in came_from[::-1]:
        path.append(int(source[path[-1]]))
    return torch.tensor(path[::-1])
