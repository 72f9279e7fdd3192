"""Hidden Markov chains against sums over all paths."""

from __future__ import annotations

import itertools
import math

import torch

from gyrofuse.mismatch.stats.hmm import forward_backward, most_likely_path

STEPS, STATES = 5, 3


def test_all_paths_together_are_their_sum_and_the_most_likely_one_is_the_largest():
    g = torch.Generator().manual_seed(1)
    log_likelihood = 2 * torch.randn(2, STEPS, STATES, generator=g, dtype=torch.float64)
    start, transition = torch.tensor([0.5, 0.3, 0.2]).double(), torch.rand(STATES, STATES, generator=g).double()
    transition[2, 0] = 0.0
    transition = transition / transition.sum(-1, keepdim=True)
    total, states = forward_backward(log_likelihood, start, transition)
    for item, own in enumerate(log_likelihood):
        weights = {}
        for path in itertools.product(range(STATES), repeat=STEPS):
            chance = float(start[path[0]]) * math.prod(float(transition[a, b]) for a, b in itertools.pairwise(path))
            weights[path] = chance * math.exp(sum(float(own[step, state]) for step, state in enumerate(path)))
        whole = sum(weights.values())
        assert math.isclose(float(total[item]), math.log(whole), rel_tol=1e-10)
        for step, state in itertools.product(range(STEPS), range(STATES)):
            share = sum(weight for path, weight in weights.items() if path[step] == state) / whole
            assert math.isclose(float(states[item, step, state]), share, abs_tol=1e-12)
        assert tuple(most_likely_path(own, start, transition).tolist()) == max(weights, key=weights.__getitem__)
