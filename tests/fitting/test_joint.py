"""Joint fits of several recordings: pooling against loops, size and power of the test, coverage, real replicates."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
from matplotlib import pyplot as plt
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import JointFit
from gyrofuse.fitting.moments.covariance import moment_covariance
from gyrofuse.fitting.moments.records import SampleDesign

TRUTH = gf.WhiteNoise(1.0) + gf.RandomWalk(1e-3)
LENGTHS = (4096, 1500, 4096)
N_RUNS = 300


@functools.cache
def recordings() -> tuple[Tensor, ...]:
    """Each with `N_RUNS` sensors."""
    generator = torch.Generator().manual_seed(11)
    return tuple(TRUTH.simulate(n, batch=(N_RUNS,), generator=generator) for n in LENGTHS)


@functools.cache
def joint() -> JointFit:
    return gf.fit_gmwm_joint(recordings(), "WN + RW")


def test_pooled_variances_and_their_covariance_are_those_of_loops():
    records = SampleDesign((900, 300), (7, 5))
    parts = [torch.rand(7, generator=torch.Generator().manual_seed(1)).double() + 1, torch.ones(5).double()]
    counts = np.zeros((2, 7))
    for r, (length, levels) in enumerate([(900, 7), (300, 5)]):
        for j in range(levels):
            counts[r, j] = length - 2 ** (j + 1) + 1
    pooled, covariance = np.zeros(7), np.zeros((7, 7))
    own = [moment_covariance(TRUTH, 900, 7).numpy(), moment_covariance(TRUTH, 300, 5).numpy()]
    for r, levels in enumerate((7, 5)):
        share = counts[r] / counts.sum(0)
        for j in range(levels):
            pooled[j] += share[j] * parts[r][j].item()
            for k in range(levels):
                covariance[j, k] += share[j] * share[k] * own[r][j, k]
    np.testing.assert_allclose(records.pooled(parts), pooled, rtol=1e-12)
    np.testing.assert_allclose(records.covariance(TRUTH), covariance, rtol=1e-12)
    np.testing.assert_allclose(SampleDesign((900, 900), (7, 7)).covariance(TRUTH), own[0] / 2, rtol=1e-12)
    np.testing.assert_allclose(records.observations, np.maximum(3 * counts.sum(0) / 2 ** np.arange(1, 8), 1))


def test_recordings_of_the_same_noise_agree_as_often_as_they_should():
    result = joint()
    assert bool(result.joint.converged.all())
    assert (result.dof[result.joint.params[:, 1] > 0] == 4).all()
    for level in (0.05, 0.2):
        rejected = int((result.p_value < level).sum())
        assert stats.binomtest(rejected, N_RUNS, level).pvalue > 1e-3, (level, rejected)


def test_joint_intervals_hold_the_truth_and_are_narrower():
    result = joint().joint
    low, high = result.confidence_interval
    held = ((low <= TRUTH.params) & (TRUTH.params <= high)).sum(0)
    for n in held.tolist():
        assert stats.binomtest(n, N_RUNS, 0.95).pvalue > 1e-3, held
    longest = joint().separate[0].param_cov.diagonal(dim1=-2, dim2=-1)
    ratio = (longest / result.param_cov.diagonal(dim1=-2, dim2=-1)).median(0).values.sqrt()
    # white noise: by the samples, 9692 of them against 4096
    assert ratio[0].item() == pytest.approx((sum(LENGTHS) / LENGTHS[0]) ** 0.5, rel=0.05)
    assert ratio[1] > 1.3


def test_a_recording_with_other_noise_is_told():
    first, second, third = recordings()
    changed = [first, second, 1.1 * third]
    result = gf.fit_gmwm_joint([x[:50] for x in changed], "WN + RW")
    assert (result.p_value < 0.01).sum() >= 48
    white = result.shift[..., 0]
    assert (white[2] > 0).all()
    assert (white[0] < 0).all()
    assert "not stationary between the recordings" in result.summary()


def test_sensors_and_axes_keep_their_places():
    first, second, _ = recordings()
    alone = gf.fit_gmwm_joint([first[3:4], second[3:4]], "WN + RW")
    axes = gf.fit_gmwm_joint([first[:6].view(2, 3, -1), second[:6].view(2, 3, -1)], "WN + RW")
    torch.testing.assert_close(axes.joint.params[1, 0], alone.joint.params[0], rtol=1e-6, atol=0)
    torch.testing.assert_close(axes.statistic[1, 0], alone.statistic[0], rtol=1e-5, atol=1e-8)
    assert axes.shift.shape == (2, 2, 3, 2)
    assert "sensor 1 of item 1: the recordings agree" in axes.summary()


def test_copies_of_one_recording_give_its_own_fit():
    signal = recordings()[0][:4]
    alone, twice = gf.fit_gmwm(signal, "WN + RW"), gf.fit_gmwm_joint([signal, signal], "WN + RW")
    torch.testing.assert_close(twice.joint.params, alone.params, rtol=1e-5, atol=0)
    torch.testing.assert_close(twice.joint.param_cov, alone.param_cov / 2, rtol=1e-3, atol=0)
    assert (twice.statistic < 1e-6).all()


def test_frequencies_are_averaged_and_compared():
    generator = torch.Generator().manual_seed(2)
    still, faster = (
        [
            (gf.WhiteNoise(1.0) + gf.Sinusoid(0.5, beta)).simulate(n, batch=(40,), generator=generator)
            for n, beta in ((4096, 0.3), (2048, second))
        ]
        for second in (0.3, 0.302)
    )
    same = gf.fit_gmwm_joint(still, "WN + SIN")
    beta = same.joint.param_names.index("sinusoid_1.beta")
    assert (same.dof == 3).all()
    assert stats.binomtest(int((same.p_value < 0.05).sum()), 40, 0.05).pvalue > 1e-3
    low, high = (limit[:, beta] for limit in same.joint.confidence_interval)
    assert stats.binomtest(int(((low <= 0.3) & (high >= 0.3)).sum()), 40, 0.95).pvalue > 1e-3
    assert (gf.fit_gmwm_joint(faster, "WN + SIN").p_value < 1e-3).all()


@pytest.mark.filterwarnings("ignore:`signal`")
def test_a_sensor_that_is_dead_in_one_recording_fails_alone():
    first, second = recordings()[0][:3].clone(), recordings()[1][:3].clone()
    second[1] = 0.5
    result = gf.fit_gmwm_joint([first, second], "WN + RW")
    assert result.p_value.isfinite().tolist() == [True, False, True]
    assert "sensor 2: not fitted" in result.summary()
    assert result.to_dict()["p_value"][1] is None


def test_plot_and_dictionary():
    result = gf.fit_gmwm_joint([gf.Recording(x[:2], rate=10.0, unit="deg/s") for x in recordings()], "WN + RW")
    figure, ax = plt.subplots()
    assert result.plot(ax, index=(1,)) is ax
    assert len(ax.lines) >= 3 + 2
    plt.close(figure)
    plain = result.to_dict()
    assert len(plain["separate"]) == 3
    assert plain["joint"]["rate"] == 10.0
    assert plain["joint"]["n_samples"] == sum(LENGTHS)
    assert str(result) == result.summary()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda xs: xs[0], "`recordings`: expected a list of at least two, got one"),
        (lambda xs: xs[:1], "`recordings`: expected a list of at least two, got 1"),
        (lambda xs: [xs[0], xs[1][:2]], "expected the same sensors in all, got shape .* in number 1"),
        (lambda xs: [gf.Recording(xs[0], rate=1.0), gf.Recording(xs[1], rate=2.0)], "expected one rate, got 1.0, 2.0"),
    ],
)
def test_recordings_that_do_not_go_together(change, message):
    with pytest.raises(ValueError, match=message):
        gf.fit_gmwm_joint(change([x[:3] for x in recordings()]), "WN + RW")


def test_real_replicates(data):
    """Three records of one unit at rest: the model of the paper, and whether its parameters stay."""
    records = [gf.read_recording(data / f"adis16405_rec{i}.npz") for i in (1, 2, 3)]
    result = gf.fit_gmwm_joint([record.signal[:1, :200_000] for record in records], "WN + AR1 + RW")
    assert bool(result.joint.converged.all())
    # It changes from record to record by many standard deviations, and the joint one lies between.
    phi = torch.stack([one.params[..., 1] for one in result.separate])
    assert (result.p_value < 1e-6).all()
    assert (result.joint.params[..., 1] > phi.amin(0)).all()
    assert (result.joint.params[..., 1] < phi.amax(0)).all()
