"""Choosing by held-out data: the folds by hand, the rule by a table, and what it is worth on arrays of known noise."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from reference import haar as naive
from test_model_assisted import N_LEVELS, WALKS, excess, moments, simulated, with_telegraph, with_tone
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fusion.weights import selection
from gyrofuse.fusion.weights.selection import CANDIDATES, ESTIMATORS, Selection, select_estimator
from gyrofuse.fusion.weights.svo import resolve_scale_weights

LONG = resolve_scale_weights("long", N_LEVELS)


def array(n_sensors: int, n_samples: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(naive.array(n_sensors, n_samples, seed))


def best_by_hand(blocks: list[np.ndarray], omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance over levels of several blocks, and the SVO weights for it."""
    products = [naive.products(block, len(omega)) for block in blocks]
    wccv = sum(s for s, _ in products) / sum(n for _, n in products)
    return np.einsum("j,jik->ik", omega, wccv), naive.svo_weights(wccv, omega)


# The folds


@pytest.mark.parametrize(
    ("scale_weights", "down", "n_fitted"),
    [
        ([3, 2, 1, 0, 0, 0, 0, 0], 0, 3),  # levels that blocks hold: fit to all blocks but one
        ([0, 1, 2, 2, 1, 0, 0, 0], 1, 2),
        ([0, 0, 0, 0, 0, 1, 2, 2], 2, 1),  # levels of the whole record: fit to one block, judge by the others
    ],
)
def test_folds_are_those_made_by_hand(scale_weights, down, n_fitted):
    signal = array(3, 4 * 70)
    omega = torch.tensor(scale_weights, dtype=torch.float64) / sum(scale_weights)
    got = select_estimator(signal, omega, ("equal", "svo"), n_blocks=4)
    assert got.levels_down == down
    moved = omega.numpy()[down : down + 6]
    moved = moved / moved.sum()
    blocks = np.split(signal.numpy(), 4, axis=-1)
    ratios = []
    for fold in range(4):
        fitted = [(fold + k) % 4 for k in range(n_fitted)]
        _, weights = best_by_hand([blocks[b] for b in fitted], moved)
        held_out, _ = best_by_hand([blocks[b] for b in range(4) if b not in fitted], moved)
        ratios.append(np.log(weights @ held_out @ weights / held_out.mean()))
    assert got.risk[0] == 1
    assert got.risk[1].item() == pytest.approx(np.exp(np.mean(ratios)), rel=1e-9)
    assert got.standard_error[1].item() == pytest.approx(np.std(ratios, ddof=1) / 2, rel=1e-7)
    assert got.standard_error[0] == 0
    assert got.n_folds == 4


@pytest.mark.parametrize(
    ("name", "n_levels", "n_block_levels", "down"),
    [("short", 19, 16, 0), ("long", 19, 16, 3), ("flat", 19, 16, 3), ("long", 10, 7, 3), ("short", 10, 7, 1)],
)
def test_scale_weights_move_no_further_than_they_must(name, n_levels, n_block_levels, down):
    omega = resolve_scale_weights(name, n_levels)
    assert selection._levels_down(omega, n_block_levels, 3) == down


def test_every_estimator_is_the_function_of_its_name():
    wccv, counts = moments(simulated(2))
    named = {
        "svo": gf.svo_weights(wccv, LONG),
        "inverse_variance": gf.inverse_variance_weights(wccv, LONG),
        "equal": gf.equal_weights(wccv),
    }
    for name, expected in named.items():
        torch.testing.assert_close(ESTIMATORS[name](wccv, counts, LONG), expected)
    # What the scale weights leave out may be unknown.
    wccv[:, :2], omega = torch.nan, torch.where(torch.arange(N_LEVELS) < 2, 0.0, LONG)
    for estimator in ESTIMATORS.values():
        weights = estimator(wccv, counts, omega / omega.sum())
        torch.testing.assert_close(weights.sum(-1), torch.ones(2, dtype=torch.float64))


# The rule


@pytest.mark.parametrize(
    ("means", "errors", "chosen"),
    [
        ([0.0, 0.10, -0.06], [0, 0.1, 0.021], 0),  # better, but not by three standard errors
        ([0.0, 0.10, -0.06], [0, 0.1, 0.019], 2),
        ([0.0, -0.04, -0.06], [0, 0.01, 0.01], 2),  # the better of two
        ([0.0, -0.04, -0.06], [0, 0.01, 0.03], 1),
        ([0.0, 0.0, 0.0], [0, 0, 0], 0),
    ],
)
def test_the_first_candidate_stays_unless_another_is_clearly_better(means, errors, chosen):
    # Four folds whose mean and standard error are these: mean +- sqrt(3) error.
    swing = 3**0.5 * torch.tensor([1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    relative = torch.tensor(means, dtype=torch.float64) + swing[:, None] * torch.tensor(errors, dtype=torch.float64)
    unusable = torch.full((1, 3), 99.0, dtype=torch.float64)
    usable = torch.tensor([True] * 4 + [False])
    got = selection._choose(torch.cat([relative, unusable]), usable, CANDIDATES, 8, 3)
    np.testing.assert_allclose(got.risk, np.exp(means), rtol=1e-12)
    np.testing.assert_allclose(got.standard_error, errors, atol=1e-12)
    assert (got.chosen, got.n_folds) == (chosen, 4)


def test_too_few_folds_leave_the_last_candidate():
    signal = array(6, 40)
    got = select_estimator(signal, resolve_scale_weights("long", 5))
    assert got.chosen == 2
    assert got.risk.isnan().all()
    assert got.sentence == "Chosen: svo, for the record is too short to hold data out."
    assert got.to_dict()["risk"] == [None, None, None]
    tiny = select_estimator(signal[:, :5], resolve_scale_weights("long", 2))
    assert (tiny.chosen, tiny.n_folds) == (2, 0)


def test_blocks_without_a_sensor_are_left_out():
    signal = array(3, 8 * 512).expand(2, 3, -1).clone()
    signal[1, 1, 512:1024] = torch.nan
    got = select_estimator(signal, resolve_scale_weights("long", 12))
    assert got.n_folds.tolist() == [8, 7]
    assert got.risk.isfinite().all()
    alone = select_estimator(signal[0], resolve_scale_weights("long", 12))
    torch.testing.assert_close(got.risk[0], alone.risk)


def test_float32_gives_what_float64_gives():
    signal = array(3, 4096).float()
    omega = resolve_scale_weights("long", 12)
    single, exact = (select_estimator(s, omega.to(s.dtype)) for s in (signal, signal.double()))
    torch.testing.assert_close(single.risk, exact.risk, rtol=1e-4, atol=0)
    assert single.chosen == exact.chosen


# What it is worth


def chosen_excess(signal: Tensor, truth: Tensor, omega: Tensor) -> tuple[Tensor, Selection, dict[str, Tensor]]:
    wccv, counts = moments(signal)
    got = select_estimator(signal, omega)
    A = torch.einsum("j,jik->ik", omega, truth)
    least = 1 / torch.linalg.inv(A).sum()
    each = {}
    for name in got.candidates:
        weights = ESTIMATORS[name](wccv, counts, omega)
        each[name] = torch.einsum("...i,ik,...k->...", weights, A, weights) / least - 1
    table = torch.stack(list(each.values()), -1)
    return table.gather(-1, got.chosen[:, None])[:, 0], got, each


def test_long_scale_weights_come_close_to_the_best_candidate_and_far_below_svo():
    truth = WALKS.wavelet_cross_covariance(N_LEVELS)
    chosen, got, each = chosen_excess(simulated(20, seed=8), truth, LONG)
    assert got.levels_down == 3
    assert (got.chosen == 0).sum() >= 18
    assert chosen.mean() < each["svo"].mean() / 3
    assert chosen.mean() < 1.3 * min(e.mean() for e in each.values())


def test_well_determined_levels_cost_nothing():
    short = resolve_scale_weights("short", N_LEVELS)
    truth = WALKS.wavelet_cross_covariance(N_LEVELS)
    chosen, got, each = chosen_excess(simulated(10, seed=9), truth, short)
    assert got.levels_down == 0
    assert chosen.mean() < 1.1 * each["svo"].mean()


@pytest.mark.parametrize("noise", [with_tone, with_telegraph])
def test_where_the_model_does_not_hold_the_data_decide(noise):
    signal, truth = noise(12)
    middle = torch.exp(-((torch.arange(1, N_LEVELS + 1) - 7) ** 2) / 2).double()
    chosen, _, each = chosen_excess(signal, truth, middle / middle.sum())
    assert chosen.mean() < each["svo"].mean() + 0.01  # one per cent of the risk
    chosen, _, each = chosen_excess(signal, truth, LONG)
    assert chosen.mean() < each["svo"].mean()


def test_a_wrong_model_yields_to_plain_svo(monkeypatch):
    # A model that knows white noise alone.
    def white(wccv: Tensor, counts: Tensor, omega: Tensor) -> Tensor:
        precision = wccv[..., 0, :, :].diagonal(dim1=-2, dim2=-1).reciprocal()
        return precision / precision.sum(-1, keepdim=True)

    monkeypatch.setitem(selection.ESTIMATORS, "model_assisted", white)
    walks = gf.ArrayModel([(gf.RandomWalk(1.0), torch.diag(torch.tensor([1.0, 30.0, 30.0, 30.0])).double())])
    equal = gf.ArrayModel([(gf.WhiteNoise(1.0), 30 * torch.eye(4).double())])
    model = walks + equal
    generator = torch.Generator().manual_seed(0)
    signal = model.simulate(2**13, batch=(20,), generator=generator)
    truth = model.wavelet_cross_covariance(N_LEVELS)
    omega = torch.exp(-((torch.arange(1, N_LEVELS + 1) - 7.0) ** 2)).double()
    omega = omega / omega.sum()
    assert excess(torch.eye(4).double().expand(N_LEVELS, 4, 4), truth, omega) > 1
    chosen, got, each = chosen_excess(signal, truth, omega)
    assert (got.chosen > 0).all()
    assert chosen.mean() < each["model_assisted"].mean() / 10
    assert "lower than that of model_assisted" in got[0].sentence


# What it says


def test_the_reason_is_one_sentence_and_the_rest_a_table():
    got = Selection(
        candidates=CANDIDATES,
        risk=torch.tensor([[1.0, 0.9, 1.2], [1.0, 1.1, 1.3]]).double(),
        standard_error=torch.tensor([[0.0, 0.05, 0.1], [0.0, 0.02, 0.1]]).double(),
        chosen=torch.tensor([1, 0]),
        n_folds=torch.tensor([8, 8]),
        n_blocks=8,
        levels_down=3,
    )
    assert got.sentence == "Chosen by held-out data: model_assisted for 1, shrinkage for 1 of 2 arrays."
    assert str(got) == got.sentence
    assert got[0].sentence == (
        "Chosen: shrinkage, whose risk on held-out data is 10 +- 4.5 % lower than that of model_assisted."
    )
    assert got[1].sentence == (
        "Chosen: model_assisted, for no other has a clearly lower risk on held-out data "
        "(shrinkage +10 +- 2.2 %, svo +30 +- 13 %)."
    )
    lines = str(got[0]).splitlines()
    assert lines[0] == "Held-out risk over 8 folds of 8 blocks, scale weights 3 levels down"
    assert [line.endswith("chosen") for line in lines[1:4]] == [False, True, False]
    plain = json.loads(json.dumps(got.to_dict()))
    assert plain["chosen"] == [1, 0]
    assert got.reshape((1, 2)).risk.shape == (1, 2, 3)


def test_bad_options_are_told():
    signal, omega = array(3, 500), resolve_scale_weights("long", 8)
    with pytest.raises(ValueError, match=r"`candidates`: expected names among model_assisted, .*, got \['best'\]"):
        select_estimator(signal, omega, ["best"])
    with pytest.raises(ValueError, match=r"`candidates`: expected names .* got \[\]"):
        select_estimator(signal, omega, [])
    for n_blocks in (0, 1, 6):
        with pytest.raises(ValueError, match=f"`n_blocks`: expected a power of two, at least 2, got {n_blocks}"):
            select_estimator(signal, omega, n_blocks=n_blocks)
    with pytest.raises(TypeError, match="`signal`: expected float32 or float64"):
        select_estimator(signal.int(), omega)
