"""What the figures show, read back from what matplotlib was asked to draw."""

from itertools import pairwise
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from gyrofuse._base.axes import finish
from gyrofuse.fusion import plots as plotting

TAU = 0.1 * 2.0 ** np.arange(8)


@pytest.fixture(autouse=True)
def _leaves_matplotlib_alone():
    settings, open_figures = dict(matplotlib.rcParams), plt.get_fignums()
    yield
    assert dict(matplotlib.rcParams) == settings
    assert plt.get_fignums() == open_figures


def new_axes() -> Axes:
    return Figure(figsize=(7, 5), layout="constrained").subplots()


def variances(n_sensors: int, seed: int = 0) -> np.ndarray:
    """`(level, sensor)`: white noise of different sizes that levels off."""
    size = np.random.default_rng(seed).uniform(0.5, 2.0, n_sensors)
    return size / (TAU[:, None] / 0.1) + 0.05


def drawn(ax: Axes) -> list[np.ndarray]:
    return [np.asarray(line.get_ydata()) for line in ax.lines]


def legend_of(ax: Axes) -> list[str]:
    legend = ax.get_legend()
    assert legend is not None
    return [text.get_text() for text in legend.get_texts()]


def test_allan_deviation_is_the_root_of_twice_the_wavelet_variance():
    ax = new_axes()
    nu, virtual, equal = variances(3), variances(1, 1)[:, 0], variances(1, 2)[:, 0]
    returned = plotting.plot_allan_deviation(
        TAU,
        nu,
        names=["a", "b", "c"],
        virtual=virtual,
        band=(virtual / 2, virtual * 2),
        equal=equal,
        unit="deg/s",
        ax=ax,
    )
    assert returned is ax
    *sensors, mean, fused = drawn(ax)
    np.testing.assert_allclose(np.stack(sensors, -1), np.sqrt(2 * nu))
    np.testing.assert_allclose(mean, np.sqrt(2 * equal))
    np.testing.assert_allclose(fused, np.sqrt(2 * virtual))
    band = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert band.min() == pytest.approx(np.sqrt(virtual).min())
    assert band.max() == pytest.approx(np.sqrt(4 * virtual).max())
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert ax.get_xlabel() == "averaging time (s)"
    assert ax.get_ylabel() == "Allan deviation (deg/s)"
    assert legend_of(ax) == ["3 sensors", "plain mean", "virtual gyro", "its confidence interval"]


def test_allan_deviation_takes_tensors_and_needs_sensors_only():
    ax = new_axes()
    nu = torch.tensor(variances(2), requires_grad=True)
    plotting.plot_allan_deviation(torch.tensor(TAU), nu, names=["a", "b"], in_seconds=False, ax=ax)
    np.testing.assert_allclose(np.stack(drawn(ax), -1), np.sqrt(2 * variances(2)))
    assert ax.get_xlabel() == "averaging time (samples)"
    assert ax.get_ylabel() == "Allan deviation"
    assert legend_of(ax) == ["2 sensors"]


def test_missing_levels_and_dead_sensors_are_gaps():
    ax = new_axes()
    nu = variances(3)
    nu[-1, 0], nu[:, 1] = np.nan, 0.0
    plotting.plot_allan_deviation(TAU, nu, names=["a", "b", "c"], ax=ax)
    first, dead, third = drawn(ax)
    assert np.isnan(first).tolist() == [False] * 7 + [True]
    assert np.isnan(dead).all()
    assert np.isfinite(third).all()
    assert {text.get_text() for text in ax.texts} == {"a", "c"}


def test_nothing_to_draw_is_an_empty_figure(tmp_path: Path):
    ax = new_axes()
    plotting.plot_allan_deviation(TAU, np.full((8, 2), np.nan), names=["a", "b"], ax=ax)
    plotting.plot_ratio(TAU, np.full(8, np.nan), ax=new_axes())
    ax.figure.savefig(tmp_path / "figure.png")
    assert list(ax.texts) == []


@pytest.mark.parametrize(("n_sensors", "n_labels"), [(1, 0), (2, 2), (12, 12), (16, 16), (64, 0)])
def test_sensors_are_labelled_as_long_as_there_is_room(n_sensors: int, n_labels: int):
    ax = new_axes()
    names = [f"imu{i}" for i in range(n_sensors)]
    plotting.plot_allan_deviation(TAU, variances(n_sensors), names=names, ax=ax)
    assert len(ax.texts) == n_labels
    assert legend_of(ax) == ["sensor imu0" if n_sensors == 1 else f"{n_sensors} sensors"]


def test_labels_of_line_ends_do_not_overlap(tmp_path: Path):
    ax = new_axes()
    nu = np.repeat(variances(1), 12, axis=1) * (1 + 1e-3 * np.arange(12))  # all but the same
    plotting.plot_allan_deviation(TAU, nu, names=[f"imu{i}" for i in range(12)], ax=ax)
    ax.figure.savefig(tmp_path / "figure.png")
    boxes = sorted((Text.get_window_extent(text) for text in ax.texts), key=lambda box: box.y0)  # without leaders
    assert all(below.y1 < above.y0 + 1 for below, above in pairwise(boxes))
    order = [text.get_text() for text in sorted(ax.texts, key=lambda text: text.get_position()[1])]
    assert order == [f"imu{i}" for i in range(12)]


@pytest.mark.parametrize("name", ["$x^{$", "a_b", "<b>x</b>", "x" * 60, "\x1b[31mred", "Гироскоп"])
def test_names_are_text_whatever_they_hold(name: str, tmp_path: Path):
    figure = Figure(figsize=(7, 8), layout="constrained")
    nu = variances(2)
    plotting.plot_fusion(figure, TAU, nu, [0.4, 0.6], names=[name, "b"], virtual=nu[:, 0], equal=nu[:, 1], unit="$")
    figure.savefig(tmp_path / "figure.svg")
    (label,) = {text.get_text() for text in figure.axes[1].texts} - {"b"}
    assert len(label) <= 18
    assert label.isprintable()
    assert label == name or len(name) > 18 or not name.isprintable()


def test_ratio_is_shaded_where_it_is_below_one():
    ax = new_axes()
    ratio = np.array([1.2, 1.2, 1.1, 1.0, 0.9, np.nan, 0.7, 0.8])
    plotting.plot_ratio(TAU, ratio, ax=ax)
    one, line = drawn(ax)
    assert list(one) == [1, 1]
    np.testing.assert_array_equal(line, ratio)
    shade = np.concatenate([path.vertices for path in ax.collections[0].get_paths()])
    assert shade[:, 1].max() == pytest.approx(1)
    assert shade[:, 1].min() == pytest.approx(0.7, abs=1e-3)
    assert shade[:, 0].min() == pytest.approx(TAU[3], rel=0.02)
    assert ax.get_ylabel() == "virtual / plain mean"


def test_ratio_with_a_band():
    ax = new_axes()
    plotting.plot_ratio(TAU, np.full(8, 1.1), band=(np.full(8, 0.9), np.full(8, 1.3)), in_seconds=False, ax=ax)
    band = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == (0.9, 1.3)
    assert ax.get_xlabel() == "averaging time (samples)"


def test_weights_are_hollow_where_the_interval_holds_zero():
    ax = new_axes()
    plotting.plot_weights([0.9, 0.2, -0.1], [0.8, -0.1, -0.3], [1.0, 0.5, -0.05], names=["a", "b", "c"], ax=ax)
    intervals, marks = ax.collections
    np.testing.assert_allclose(marks.get_offsets(), [[0, 0.9], [1, 0.2], [2, -0.1]])
    np.testing.assert_allclose(
        [segment[:, 1] for segment in intervals.get_segments()], [[0.8, 1], [-0.1, 0.5], [-0.3, -0.05]]
    )
    white = (marks.get_facecolors() == 1).all(-1)
    assert white.tolist() == [False, True, False]
    assert [tick.get_text() for tick in ax.get_xticklabels()] == ["a", "b", "c"]
    assert legend_of(ax) == ["interval excludes 0", "interval holds 0", "plain mean (1/3)"]
    assert any(np.allclose(line, 1 / 3) for line in drawn(ax))


def test_weights_without_intervals_are_full():
    ax = new_axes()
    unknown = [np.nan, np.nan]
    plotting.plot_weights(torch.tensor([0.9, 0.1]), unknown, unknown, names=["a", "b"], equal=False, ax=ax)
    marks = ax.collections[-1]
    assert not (marks.get_facecolors() == 1).all(-1).any()
    assert ax.get_legend() is None


def test_tick_names_turn_when_they_are_long_and_thin_out_when_they_are_many():
    def ticks(names: list[str]) -> tuple[int, float]:
        ax = new_axes()
        zero = np.zeros(len(names))
        plotting.plot_weights(zero, zero, zero, names=names, ax=ax)
        labels = ax.get_xticklabels()
        return len(labels), labels[0].get_rotation()

    assert ticks(["1", "2", "3"]) == (3, 0)
    assert ticks([f"long_name_{i}" for i in range(12)]) == (12, 90)
    assert ticks([str(i) for i in range(64)])[0] == 32


def test_fusion_draws_ratio_deviation_and_weights_over_one_time_axis():
    figure = Figure(figsize=(7, 8), layout="constrained")
    nu = variances(2)
    virtual, equal = 0.4 * nu[:, 0], 0.6 * nu[:, 0]
    plotting.plot_fusion(figure, TAU, nu, [0.4, 0.6], names=["a", "b"], virtual=virtual, equal=equal, unit="deg/s")
    ratio, deviation, weights = figure.axes
    np.testing.assert_allclose(drawn(ratio)[1], np.sqrt(2 / 3))
    assert ratio.get_xlim() == deviation.get_xlim()
    assert deviation.get_ylabel() == "Allan deviation (deg/s)"
    assert weights.get_ylabel() == "weight"


def test_band_weights_are_colours_over_the_times_that_they_govern():
    ax = new_axes()
    weights = np.array([[0.2, 0.8], [0.5, 0.5], [1.4, -0.4]])
    assert plotting.plot_band_weights(TAU, torch.tensor(weights), names=["a", "b"], ax=ax) is ax
    (mesh,) = ax.collections
    np.testing.assert_array_equal(mesh.get_array(), weights.T)
    assert mesh.get_clim() == (-1.4, 1.4)  # white is 0
    edges = mesh.get_coordinates()[0, :, 0]
    np.testing.assert_allclose(edges, [TAU[0] / 2**0.5, TAU[1] / 2**0.5, TAU[2] / 2**0.5, TAU[-1] * 2**0.5])
    assert [tick.get_text() for tick in ax.get_yticklabels()] == ["a", "b"]
    assert ax.yaxis_inverted()
    assert ax.get_xlabel() == "averaging time (s)"


@pytest.mark.parametrize(("n_bands", "end"), [(1, 2**0.5), (8, 2**0.5), (9, 2**1.5)])
def test_the_last_band_reaches_to_the_end(n_bands: int, end: float):
    ax = new_axes()
    plotting.plot_band_weights(TAU, np.full((n_bands, 3), 1 / 3), names=["a", "b", "c"], in_seconds=False, ax=ax)
    edges = ax.collections[0].get_coordinates()[0, :, 0]
    assert len(edges) == n_bands + 1
    assert edges[-1] == pytest.approx(end * TAU[-1])
    assert ax.get_xlabel() == "averaging time (samples)"


def test_names_beside_bands_thin_out_when_they_are_many():
    ax = new_axes()
    plotting.plot_band_weights(TAU, np.zeros((4, 64)), names=[f"imu{i}" for i in range(64)], ax=ax)
    assert [tick.get_text() for tick in ax.get_yticklabels()] == [f"imu{i}" for i in range(0, 64, 4)]


def test_fusion_draws_bands_over_the_same_time_axis(tmp_path: Path):
    figure = Figure(figsize=(7, 8), layout="constrained")
    nu = variances(2)
    bands = np.array([[0.4, 0.6], [1.2, -0.2]])
    plotting.plot_fusion(figure, TAU, nu, bands, names=["a$", "b"], virtual=nu[:, 0], equal=nu[:, 1], unit="deg/s")
    ratio, deviation, weights = figure.axes
    figure.savefig(tmp_path / "figure.svg")
    assert ratio.get_xlim() == deviation.get_xlim() == weights.get_xlim()
    np.testing.assert_array_equal(weights.collections[0].get_array(), bands.T)
    assert (deviation.get_xlabel(), weights.get_xlabel()) == ("", "averaging time (s)")


def test_long_signals_are_reduced_to_ranges_and_averages():
    figure = Figure(figsize=(7, 4), layout="constrained")
    n = 600_000
    rng = np.random.default_rng(0)
    signal, other = rng.normal(size=n) + 3.0, rng.normal(size=n)
    signal[123_456], signal[300_000:310_000] = 50.0, np.nan
    plotting.plot_signals(figure, np.arange(n) / 10, {"virtual gyro": signal, "plain mean": other}, unit="deg/s")
    above, below = figure.axes
    outline = np.concatenate([path.vertices for path in above.collections[0].get_paths()])
    assert len(outline) < 2000
    assert outline[:, 1].max() == 50.0  # no extreme is lost
    for line, values in zip(drawn(below), (signal, other), strict=True):
        averages = values.reshape(600, 1000).mean(1)  # NaN in the ten blocks without a sample
        np.testing.assert_allclose(line, averages - np.nanmean(averages), atol=1e-12)
    assert legend_of(below) == ["virtual gyro", "plain mean"]
    assert below.get_xlabel() == "time (s)"


def test_blocks_of_short_signals_are_their_samples():
    times, values = np.arange(5.0), np.array([1.0, -2.0, np.nan, 4.0, 0.0])
    instants, low, high, average = plotting._in_blocks(times, values)
    np.testing.assert_array_equal(instants, times)
    for reduced in (low, high, average):
        np.testing.assert_array_equal(reduced, values)


@pytest.mark.parametrize("seed", range(5))
def test_spread_is_the_closest_arrangement(seed: int):
    from scipy.optimize import minimize

    places = np.sort(np.random.default_rng(seed).uniform(0, 30, 8))
    spread = plotting._spread(places, gap=5.0)
    closest = minimize(
        lambda x: ((x - places) ** 2).sum(),
        places,
        constraints={"type": "ineq", "fun": lambda x: np.diff(x) - 5.0},
        options={"ftol": 1e-12},
    )
    np.testing.assert_allclose(spread, closest.x, atol=1e-4)
    np.testing.assert_array_equal(plotting._spread(10 * np.arange(3.0), gap=5.0), 10 * np.arange(3.0))


def test_new_axes_belong_to_pyplot_so_that_they_can_be_shown():
    before = plt.get_fignums()
    ax = plotting.plot_ratio(TAU, np.ones(8))
    assert plt.fignum_exists(ax.figure.number)
    plt.close(ax.figure)
    assert plt.get_fignums() == before


@pytest.mark.parametrize(
    ("low", "high", "told"),
    [
        (1e-6, 1e-2, ["1e-6", "1e-5", "1e-4", "0.001", "0.01"]),
        (4e-6, 8e-5, ["5e-6", "1e-5", "2e-5", "5e-5"]),
        (0.4, 60.0, ["0.5", "1", "2", "5", "10", "20", "50"]),
        (0.92, 1.38, ["1", "1.1", "1.2", "1.3"]),
    ],
)
def test_logarithmic_axes_have_plain_numbers(low: float, high: float, told: list[str]):
    ax = Figure().subplots()
    ax.plot([low, high], [low, high])
    ax.set_yscale("log")
    ax.set_ylim(low, high)
    finish(ax)
    shown = [tick for tick in ax.get_yticks() if low <= tick <= high]
    assert [ax.yaxis.get_major_formatter()(tick) for tick in shown] == told
    assert not any(label.get_text() for label in ax.yaxis.get_ticklabels(minor=True))
