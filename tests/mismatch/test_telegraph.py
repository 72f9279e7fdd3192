"""Two levels in coloured noise: the likelihood sums over paths, its rival is Kalman's, names and numbers hold."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from mismatch_draws import LEVEL, nominated
from scipy import linalg, stats
from torch import Tensor

from gyrofuse import AR1, RandomWalk, WhiteNoise
from gyrofuse.mismatch.likelihoods.telegraph import (
    _LARGEST,
    CLOSE,
    Background,
    Spacing,
    _filter,
    _thinned,
    backgrounds,
    gaussian_values,
    switching_values,
)
from gyrofuse.mismatch.likelihoods.telegraph_fit import (
    Numbers,
    _fitted,
    _in_fit_blocks,
    excess,
    scores,
    two_levels,
    vertex,
)
from gyrofuse.mismatch.mechanisms.regimes import telegraph as random_telegraph
from gyrofuse.mismatch.mechanisms.regimes.telegraph import RandomTelegraph, _path
from gyrofuse.mismatch.mechanisms.spectra.joint_fit import chosen_shape
from gyrofuse.mismatch.selection.held_out import score_held_out
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.folds import N_JUDGED, sd_of_sum

N, SCENE = 16384, RecordingInfo(100.0, "deg/s", ("x", "y"))
NOISE = WhiteNoise(1.0) + AR1(0.995, 2e-4) + RandomWalk(1e-7)
LEVELS = Numbers(0.35, 160.0, 110.0)
PHI, STEPS, WHITE = np.array([0.8, 0.97, 1.0]), np.array([0.05, 0.02, 0.01]), 0.4
START = np.append(STEPS[:2] / (1 - PHI[:2] ** 2), _LARGEST)
BACKGROUND = Background(WHITE, PHI, STEPS, START)


def drawn(seed: int, extra: Tensor | None = None) -> Comparison:
    g = torch.Generator().manual_seed(seed)
    recording = NOISE.simulate(N, batch=(2,), generator=g)
    simulation = NOISE.simulate(N, batch=(4, 2), generator=g)
    if extra is not None:
        recording[1] += extra
    return Comparison.of(SCENE, recording, simulation)


def telegraph(seed: int) -> Comparison:
    g = torch.Generator().manual_seed(1000 + seed)
    return drawn(seed, LEVELS.half * _path(N, LEVELS.up, LEVELS.down, g))


def places(n: int, spacing: Spacing = CLOSE) -> np.ndarray:
    """Where blocks lie, blocks after the first."""
    return np.cumsum([spacing.before(k) for k in range(n)]) - 1


def covariance(n: int, spacing: Spacing = CLOSE) -> np.ndarray:
    """Of block means in `BACKGROUND`, part by part."""
    k = places(n, spacing)
    lag, earlier = np.abs(k[:, None] - k), np.minimum(k[:, None], k)
    ar1s = sum(v * p**lag for v, p in zip(START, PHI[:2], strict=False))
    return np.asarray(ar1s + _LARGEST + STEPS[2] * (earlier + 1) + WHITE * np.eye(n))


def log_density(y: np.ndarray, mean: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Normal log densities but for a constant."""
    law = stats.multivariate_normal(mean, matrix)
    return np.asarray(law.logpdf(y) + y.shape[-1] / 2 * math.log(2 * math.pi))


def test_the_rival_has_the_likelihood_of_the_normal_law() -> None:
    y = np.random.default_rng(1).normal(size=30)
    lag = np.abs(np.arange(30)[:, None] - np.arange(30))
    for sd, tau in ((0.0, 1.0), (0.9, 4.0)):
        matrix = covariance(30) + sd**2 * np.exp(-lag / tau)
        mine = gaussian_values(y, BACKGROUND, np.array([sd, 2.0]), np.array([tau, 7.0]))[0].sum()
        assert mine == pytest.approx(log_density(y, np.full(30, y.mean()), matrix), abs=1e-6)


def test_runs_of_blocks_that_lie_apart_have_the_likelihood_of_the_normal_law() -> None:
    y, spacing = np.random.default_rng(1).normal(size=30), Spacing(10, 7.5)
    lag = np.abs(places(30, spacing)[:, None] - places(30, spacing))
    assert places(30, spacing)[10] - places(30, spacing)[9] == 7.5
    for sd, tau in ((0.0, 1.0), (0.9, 4.0)):
        matrix = covariance(30, spacing) + sd**2 * np.exp(-lag / tau)
        mine = gaussian_values(y, BACKGROUND, np.array([sd, 2.0]), np.array([tau, 7.0]), spacing)[0].sum()
        assert mine == pytest.approx(log_density(y, np.full(30, y.mean()), matrix), abs=1e-6)


def every_path(
    y: np.ndarray, half: float, up: float, down: float, noise: np.ndarray, spacing: Spacing = CLOSE
) -> float:
    """Summed over all paths; of blocks in which the level moves it may be anywhere between.

    Of two runs that lie apart the second starts at a level of its own.
    """
    n, apart = len(y), spacing.gap > 1
    rates = np.array([[-1 / up, 1 / up], [1 / down, -1 / down]])
    move = linalg.expm(rates)  # from upper and lower, after a block
    unseen = linalg.expm(rates * (spacing.gap - 1))
    paths = np.array(list(itertools.product((0, 1), repeat=n + 1 + apart)))  # one block ahead of the first
    ends = np.delete(np.arange(n + 1 + apart), [0, spacing.run + 1] if apart else [0])
    prior = np.where(paths[:, 0] == 0, up, down) / (up + down)
    total = 0.0
    for path, p in zip(paths, prior, strict=True):
        level, moves = half * (1 - 2 * path), path[ends - 1] != path[ends]
        matrix = noise + np.diag(moves * half**2 / 3)
        density = log_density(y - (level[ends - 1] + level[ends]) / 2, np.full(n, y.mean()), matrix)
        between = unseen[path[spacing.run], path[spacing.run + 1]] if apart else 1.0
        total += p * between * move[path[ends - 1], path[ends]].prod() * math.exp(float(density))
    return math.log(total)


def test_the_likelihood_of_two_levels_sums_over_all_paths() -> None:
    y = np.random.default_rng(2).normal(size=8) * 0.7 + np.repeat([1, -1], 4)
    numbers = (np.array([1.0, 0.3]), np.array([4.0, 2.0]), np.array([6.0, 9.0]))
    white = Background(WHITE, PHI, 0 * STEPS, 0 * START)
    # Gains in coloured noise are those of blocks in which no level moves.
    for background, noise, tolerance in ((white, WHITE * np.eye(8), 1e-9), (BACKGROUND, covariance(8), 0.1)):
        all_paths = switching_values(y, background, *numbers, 1024).sum(-1)
        truth = every_path(y, 1.0, 4.0, 6.0, noise)
        assert all_paths[0] == pytest.approx(truth, abs=tolerance)
        assert all_paths[1] == pytest.approx(every_path(y, 0.3, 2.0, 9.0, noise), abs=tolerance)
        assert switching_values(y, background, *numbers, 64).sum(-1)[0] == pytest.approx(truth, abs=0.1)


def test_paths_of_runs_that_lie_apart_are_summed_over_what_lies_between() -> None:
    y = np.random.default_rng(2).normal(size=8) * 0.7 + np.repeat([1, -1], 4)
    white = Background(WHITE, PHI, 0 * STEPS, 0 * START)
    for gap in (1.0, 3.5, 1e3):
        spacing = Spacing(5, gap)
        numbers = (np.array([1.0]), np.array([4.0]), np.array([6.0]))
        mine = switching_values(y, white, *numbers, 1024, spacing)[0].sum()
        truth = every_path(y, 1.0, 4.0, 6.0, WHITE * np.eye(8), spacing)
        assert mine == pytest.approx(truth, abs=1e-9)


def test_thinning_keeps_the_heavy_and_is_unbiased() -> None:
    weight = np.random.default_rng(3).dirichlet(np.full(40, 0.3), size=5)
    mean, uniforms = np.zeros_like(weight), (np.arange(2000) + 0.5) / 2000
    for uniform in uniforms:
        kept, new = _thinned(weight, 16, float(uniform))
        assert kept.shape == new.shape == (5, 16)
        assert all(len(set(row)) == 16 for row in kept.tolist())
        np.add.at(mean.ravel(), kept.ravel(), new.ravel() / len(uniforms))
    assert np.abs(mean - weight).max() < 2e-3 * weight.max()


def test_thinning_makes_up_for_paths_without_weight() -> None:
    kept, new = _thinned(np.eye(40)[:3], 16, 0.5)
    assert kept.shape == (3, 16)
    assert new.sum(1) == pytest.approx(np.ones(3))


def test_thinning_ends_where_as_many_as_are_kept_weigh_the_same() -> None:
    """The sum of ten equal weights is often a little less than ten of them."""
    values = np.linspace(0.01, 0.1, 400)
    weight = np.concatenate([np.repeat(values[:, None], 10, 1), np.zeros((400, 12))], 1)
    kept, new = _thinned(weight, 10, 0.3)
    assert (kept == np.arange(10) + 22 * np.arange(400)[:, None]).all()
    assert np.allclose(new, values[:, None])


def test_gains_settle_and_one_is_left_for_the_level_at_the_start() -> None:
    gains, variances = _filter(BACKGROUND, 2000)
    assert gains[0].sum() == pytest.approx(1.0, abs=1e-3)
    assert np.abs(np.diff(gains[-2:], axis=0)).max() < 1e-9
    assert variances[-1] > WHITE + STEPS.sum()


def test_backgrounds_have_the_variances_of_block_means() -> None:
    comparison, block = drawn(4), 32
    background = backgrounds(comparison.base, block)[0]
    lags = np.arange(0, 60, 6)

    def variogram(matrix: np.ndarray) -> np.ndarray:
        return np.array([matrix[0, 0] + matrix[lag, lag] - 2 * matrix[0, lag] for lag in lags[1:]])

    exact = comparison.base.block_covariance(block, 60)[0].numpy()
    k = np.arange(60)
    lag, earlier = np.abs(k[:, None] - k), np.minimum(k[:, None], k)
    variances = background.start[:-1]
    ar1s = sum(v * p**lag for v, p in zip(variances, background.phi, strict=False))
    mine = ar1s + background.steps[-1] * earlier + background.white * np.eye(60)
    assert variogram(mine) == pytest.approx(variogram(exact), rel=0.1)


def test_a_parabola_gives_back_its_vertex() -> None:
    rng = np.random.default_rng(5)
    trials = rng.normal(size=(40, 3)) * 0.3
    curvature, centre = np.diag([100.0, 20.0, 10.0]) + 4.0, np.array([0.1, -0.2, 0.15])
    off = trials - centre
    theta, matrix = vertex(trials, 7 - (off @ curvature * off).sum(-1) / 2)
    assert theta == pytest.approx(centre, abs=1e-6)
    assert matrix == pytest.approx(np.linalg.inv(curvature), rel=1e-6)


def test_a_lorentzian_is_told_by_its_spectrum() -> None:
    found = excess(telegraph(6))
    tau = 1 / (1 / LEVELS.up + 1 / LEVELS.down)
    sd = 2 * LEVELS.half * math.sqrt(LEVELS.up * LEVELS.down) / (LEVELS.up + LEVELS.down)
    assert float(found.gain[1]) > 40 > 6 > float(found.gain[0])
    assert float(found.sd[1]) == pytest.approx(sd, rel=0.2)
    assert float(found.tau[1]) == pytest.approx(tau, rel=0.6)


@pytest.mark.statistical
def test_blocks_get_shorter_where_levels_change_faster_than_the_spectrum_had_it() -> None:
    comparison, sd = telegraph(10), float(excess(telegraph(10)).sd[1])
    tau = 1 / (1 / LEVELS.up + 1 / LEVELS.down)
    first = _fitted(comparison, 1, sd, 3 * tau)
    assert first is not None
    assert not first.resolved
    found = _in_fit_blocks(comparison, 1, sd, 3 * tau)
    assert found is not None
    assert found.resolved
    assert found.means.block < first.means.block


@pytest.mark.statistical
def test_beside_a_sensor_that_jumps_another_one_needs_less() -> None:
    """Of weaker levels, a nat over the Gaussian rival, that would not do alone."""
    comparison, g = telegraph(33), torch.Generator().manual_seed(2033)
    recording = comparison.recording.clone()
    recording[0] += 0.55 * LEVELS.half * _path(N, LEVELS.up, LEVELS.down, g)
    both = Comparison.of(SCENE, recording, comparison.reference.signal)
    assert 0 < two_levels(both)[0].over < 1.5
    assert nominated(both, RandomTelegraph).sensors == (0, 1)
    beside_noise = torch.stack([recording[0], drawn(34).recording[1]])
    alone = Comparison.of(SCENE, beside_noise, comparison.reference.signal)
    assert RandomTelegraph.detect_and_fit(alone, LEVEL) is None


def test_one_event_beside_a_sensor_that_jumps_is_no_telegraph(monkeypatch: pytest.MonkeyPatch) -> None:
    comparison = telegraph(10)
    fit = two_levels(comparison)[1]
    values = fit.rival - 0.5
    values[:2] += 12.0
    event = fit._replace(values=np.tile(values, (len(fit.values), 1)))
    assert event.over > 5
    assert event.momentary
    monkeypatch.setattr(random_telegraph, "two_levels", lambda _case: {0: event, 1: fit})
    assert nominated(comparison, RandomTelegraph).sensors == (1,)


@pytest.mark.statistical
def test_two_levels_are_named_where_noise_is_coloured() -> None:
    within, named, seeds = 0, 0, range(10, 14)
    for seed in seeds:
        comparison = telegraph(seed)
        found = RandomTelegraph.detect_and_fit(comparison, LEVEL)
        if found is None:
            continue
        named += 1
        assert found.sensors == (1,)
        gain = score_held_out(comparison, found.effect)
        assert gain.blocks.shape == (N_JUDGED,)
        assert gain.total > sd_of_sum(gain.blocks)
        truth = {"half_step[1]": LEVELS.half, "dwell_up[1]": LEVELS.up / 100, "dwell_down[1]": LEVELS.down / 100}
        within += sum(found.parameters[k].low <= v <= found.parameters[k].high for k, v in truth.items())
    assert named >= 3
    assert within >= 3 * named - 3


@pytest.mark.statistical
@pytest.mark.parametrize("half", [3.0, 30.0])
def test_loud_jumps_are_measured_though_their_likelihood_is_a_narrow_peak(half: float) -> None:
    g = torch.Generator().manual_seed(60)
    comparison = drawn(60, half * _path(N, 160.0, 30.0, g))
    found = nominated(comparison, RandomTelegraph)
    assert found.sensors == (1,)
    for name, value in (("half_step", half), ("dwell_up", 1.6), ("dwell_down", 0.3)):
        entry = found.parameters[f"{name}[1]"]
        assert entry.high < 2.5 * entry.low
        assert abs(math.log(entry.value / value)) < math.log(entry.high / entry.low)
    # How many jumps a record has is chance, and with it all power above their rate: no other numbers of the noise.
    explained = found.effect.repair(comparison, g)
    assert chosen_shape(explained, "parameter_shift", LEVEL) is None


def test_an_ar1_of_the_same_spectrum_is_not() -> None:
    tau = 1 / (1 / LEVELS.up + 1 / LEVELS.down)
    for seed in range(20, 24):
        g = torch.Generator().manual_seed(seed)
        phi = math.exp(-1 / tau)
        extra = AR1(phi, LEVELS.half**2 * (1 - phi**2)).simulate(N, generator=g)
        assert RandomTelegraph.detect_and_fit(drawn(seed, extra), LEVEL) is None


def test_scores_are_those_of_the_fit_or_computed() -> None:
    comparison = telegraph(10)
    fit = two_levels(comparison)[1]
    assert scores(comparison, 1, fit.best) is not None
    assert scores(comparison, 1, fit.best) == pytest.approx(fit.values[0])
    near = scores(comparison, 1, fit.best._replace(half=fit.best.half * 1.001))
    assert near.sum() == pytest.approx(fit.values[0].sum(), abs=1.0)
    # A sensor that was not tried.
    assert scores(comparison, 0, LEVELS).sum() < -10
    assert scores(comparison, 0, Numbers(0.1, 2.0, 2.0)) == pytest.approx(np.zeros(N_JUDGED))


def test_the_repair_builds_levels_into_every_record() -> None:
    found = nominated(telegraph(10), RandomTelegraph)
    zero = torch.zeros(3, 2, 5000, dtype=torch.float64)
    made = found.effect.apply(zero, SCENE, torch.Generator().manual_seed(1))
    half = found.parameters["half_step[1]"].value
    assert bool((made[:, 0] == 0).all())
    assert made[:, 1].abs().unique().tolist() == pytest.approx([half])
    assert not torch.equal(made[0, 1], made[1, 1])


def test_sensors_that_jump_at_the_same_times_share_what_is_drawn():
    g = torch.Generator().manual_seed(80)
    together, alone = (_path(N, 120.0, 120.0, g) for _ in range(2))
    noise = NOISE.simulate(N, batch=(4,), generator=g)
    jumps = torch.stack([together, -together, torch.zeros(N, dtype=torch.float64), alone])
    scene = RecordingInfo(100.0, "deg/s", ("a", "b", "c", "d"))
    simulation = NOISE.simulate(N, batch=(4, 4), generator=g)
    found = RandomTelegraph.detect_and_fit(Comparison.of(scene, noise + 0.8 * jumps, simulation), 1e-3)
    assert found is not None
    assert found.sensors == (0, 1, 3)
    assert isinstance(found.effect, RandomTelegraph)
    assert found.effect.signs in ((1, -1, 0, 0), (-1, 1, 0, 0))
    assert "at the same times in sensors a, b" in found.sentence
    made = found.effect.apply(torch.zeros(4, N, dtype=torch.float64), scene, g).sign()
    assert torch.equal(made[0], -made[1])
    assert not made[2].any()
    assert not torch.equal(made[0], made[3])


def test_sensors_that_jump_by_themselves_share_nothing():
    g = torch.Generator().manual_seed(81)
    jumps = torch.stack([_path(N, 120.0, 120.0, g) for _ in range(3)])
    common = 0.7 * torch.randn(2, N, generator=g, dtype=torch.float64)  # what both sides share beside that
    sides = [NOISE.simulate(N, batch=(3,), generator=g) + one for one in common]
    scene = RecordingInfo(100.0, "deg/s", ("a", "b", "c"))
    found = RandomTelegraph.detect_and_fit(Comparison.of(scene, sides[0] + 0.8 * jumps, sides[1][None]), 1e-3)
    assert found is not None
    assert isinstance(found.effect, RandomTelegraph)
    assert found.effect.signs == ()


def test_fast_jumps_in_a_long_record_are_seen_in_the_beginnings_of_its_parts() -> None:
    """Blocks over all of the record would be longer than the levels last."""
    n, levels = 40_000, Numbers(2.0, 40.0, 30.0)
    g = torch.Generator().manual_seed(7)
    recording = NOISE.simulate(n, batch=(2,), generator=g)
    recording[1] += levels.half * _path(n, levels.up, levels.down, g)
    comparison = Comparison.of(SCENE, recording, NOISE.simulate(n, batch=(2, 2), generator=g))
    fit = two_levels(comparison)[1]
    assert fit.means.spacing.gap > 1
    assert len(fit.means.y) == 2048
    assert fit.resolved
    assert fit.over > 100
    reach = np.exp(3 * np.array(fit.log_sd))
    assert (np.abs(np.log(np.array(fit.best) / np.array(levels))) < np.log(reach)).all()
