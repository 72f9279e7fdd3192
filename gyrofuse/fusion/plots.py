"""Figures of arrays: Allan deviations, ratios, weights, signals.

Every function draws into the axes it is given, or into new ones of `matplotlib.pyplot` that `plt.show()` displays;
nothing else of matplotlib's state is touched. The colours are those of Okabe and Ito, which colour-blind readers and
grey printers tell apart: the virtual gyro is a thick blue line, the plain mean dashed orange, the sensors grey.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from gyrofuse._base.axes import (
    BLUE,
    DASHED,
    FRAME,
    GREY,
    INK,
    LABEL_SIZE,
    MOST_LABELS,
    ORANGE,
    SHADE,
    SMALL_SIZE,
    TICK_SIZE,
    Array,
    Numbers,
    as_array,
    clean_name,
    finish,
    name_ticks,
    new_axes,
    with_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

Limits = tuple[Numbers, Numbers]

_N_BLOCKS = 600  # of a signal, however long: more than a figure can show


def plot_allan_deviation(
    tau: Numbers,
    wavelet_variance: Numbers,
    *,
    names: Sequence[str],
    virtual: Numbers | None = None,
    band: Limits | None = None,
    equal: Numbers | None = None,
    unit: str | None = None,
    in_seconds: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draw the Allan deviation `sqrt(2 nu)` of every sensor and, if given, of the plain mean and the virtual gyro.

    Args:
        tau: Averaging times `(level,)`, seconds or samples.
        wavelet_variance: `nu` of every sensor, `(level, sensor)`, signal^2; NaN is left out.
        names: Name of each sensor.
        virtual: Wavelet variance of the virtual gyro, `(level,)`.
        band: Lower and upper limits of `virtual`, `(level,)` each.
        equal: Wavelet variance of the plain mean, `(level,)`.
        unit: Unit of the signal.
        in_seconds: Whether `tau` is in seconds, else in samples.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    times, sensors = as_array(tau), allan_deviation(wavelet_variance)
    thin = 0.9 if len(names) <= MOST_LABELS else 0.5
    handles: list[Any] = ax.plot(times, sensors, color=GREY, linewidth=thin, zorder=2)[:1]
    labels = [f"sensor {clean_name(names[0])}" if len(names) == 1 else f"{len(names)} sensors"]
    if equal is not None:
        handles += ax.plot(times, allan_deviation(equal), zorder=4, **DASHED)
        labels += ["plain mean"]
    if virtual is not None:
        handles += ax.plot(times, allan_deviation(virtual), color=BLUE, linewidth=2.4, zorder=5)
        labels += ["virtual gyro"]
    if band is not None:
        low, high = band
        handles += [ax.fill_between(times, allan_deviation(low), allan_deviation(high), zorder=3, **SHADE)]
        labels += ["its confidence interval"]
    if not np.isfinite(ax.dataLim.get_points()).all():
        # Logarithmic axes do not start from nothing.
        ax.set(xlim=(times[0] / 2, 2 * times[-1]), ylim=(0.1, 1.0))
    ax.set_yscale("log")
    ax.set_ylabel(with_unit("Allan deviation", unit), parse_math=False)
    time_axis(ax, in_seconds)
    finish(ax, handles, labels)
    if 1 < len(names) <= MOST_LABELS:
        _label_line_ends(ax, times, sensors, names)
    return ax


def plot_ratio(
    tau: Numbers, ratio: Numbers, *, band: Limits | None = None, in_seconds: bool = True, ax: Axes | None = None
) -> Axes:
    """Draw the Allan deviation of the virtual gyro over that of the plain mean; below 1 the virtual gyro wins.

    Args:
        tau: Averaging times `(level,)`, seconds or samples.
        ratio: `(level,)`.
        band: Lower and upper limits of `ratio`, `(level,)` each.
        in_seconds: Whether `tau` is in seconds, else in samples.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    ax = ax if ax is not None else new_axes()
    times, ratios = as_array(tau), as_array(ratio)
    ax.axhline(1, zorder=3, **DASHED)
    if band is not None:
        low, high = band
        ax.fill_between(times, as_array(low), as_array(high), zorder=2, **SHADE)
    known = np.isfinite(ratios)
    if known.any():
        # Shade along the line as drawn, straight in log tau, so that the shade ends where the line crosses 1.
        log_times = np.log(times[known])
        fine = np.linspace(log_times[0], log_times[-1], 1000)
        drawn = np.interp(fine, log_times, ratios[known])
        ax.fill_between(np.exp(fine), drawn, 1, where=drawn < 1, zorder=1, **SHADE)
    ax.plot(times, ratios, color=BLUE, linewidth=2.0, marker="o", markersize=3.5, zorder=5)
    ax.margins(y=0.12)
    ax.set_ylabel("virtual / plain mean")
    time_axis(ax, in_seconds)
    finish(ax)
    return ax


def plot_weights(
    weights: Numbers,
    low: Numbers,
    high: Numbers,
    *,
    names: Sequence[str],
    equal: bool = True,
    ax: Axes | None = None,
) -> Axes:
    """Draw weights with their intervals: full marks where the interval excludes 0, hollow ones where it does not.

    Args:
        weights: `(sensor,)`.
        low: Lower limits `(sensor,)`, NaN where unknown.
        high: Upper limits `(sensor,)`, NaN where unknown.
        names: Name of each sensor.
        equal: Whether to draw the weight `1 / sensors` of the plain mean.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    from matplotlib.lines import Line2D

    ax = ax if ax is not None else new_axes()
    lows, highs = as_array(low), as_array(high)
    place = np.arange(len(names))
    size = 5.5 if len(names) <= 2 * MOST_LABELS else 3.5
    unsure = (lows <= 0) & (highs >= 0)
    colors = np.where(unsure, "white", BLUE)
    ax.axhline(0, color=FRAME, linewidth=0.8, zorder=1)
    ax.vlines(place, lows, highs, color=BLUE, linewidth=1.6, zorder=3)
    ax.scatter(place, as_array(weights), size**2, colors, edgecolors=BLUE, zorder=4)
    handles: list[Any] = []
    labels = []
    for color, label in ((BLUE, "interval excludes 0"), ("white", "interval holds 0")):
        if (np.isfinite(lows) & (colors == color)).any():
            handles += [Line2D([], [], marker="o", markersize=size, color=BLUE, markerfacecolor=color, linestyle="")]
            labels += [label]
    if equal:
        handles += [ax.axhline(1 / len(names), zorder=2, **DASHED)]
        labels += [f"plain mean (1/{len(names)})"]
    ax.margins(y=0.12)
    ax.set_xlim(-0.6, len(names) - 0.4)
    ax.set_xlabel("sensor")
    ax.set_ylabel("weight")
    name_ticks(ax, names)
    finish(ax, handles, labels, loc="lower right", bbox_to_anchor=(1, 1), ncols=3, borderaxespad=0.2)
    ax.grid(visible=False, axis="x")
    return ax


def plot_band_weights(
    tau: Numbers, weights: Numbers, *, names: Sequence[str], in_seconds: bool = True, ax: Axes | None = None
) -> Axes:
    """Draw the weights of every band as colours over the averaging times that it governs; blue adds, orange subtracts.

    Args:
        tau: Averaging times `(level,)`, seconds or samples; all bands but the last have those of the first levels.
        weights: `(band, sensor)`; the last band holds all that is slower.
        names: Name of each sensor.
        in_seconds: Whether `tau` is in seconds, else in samples.
        ax: Where to draw; new axes by default.

    Returns:
        The axes.
    """
    from matplotlib.colors import LinearSegmentedColormap

    ax = ax if ax is not None else new_axes()
    times, values = as_array(tau), as_array(weights)
    n_bands = len(values)
    # A level reaches half an octave to either side; the last band to the end, or an octave where no level is left.
    starts = np.append(times, 2 * times[-1])[:n_bands] / np.sqrt(2)
    edges = np.append(starts, np.sqrt(2) * max(times[-1], starts[-1] * np.sqrt(2)))
    largest = np.abs(values[np.isfinite(values)]).max(initial=1e-9)
    colors = LinearSegmentedColormap.from_list("signed", [ORANGE, "white", BLUE])
    mesh = ax.pcolormesh(
        edges, np.arange(len(names) + 1) - 0.5, values.T, cmap=colors, vmin=-largest, vmax=largest, edgecolors="face"
    )
    time_axis(ax, in_seconds)
    ax.invert_yaxis()  # the first sensor above, as in a table
    step = -(-len(names) // MOST_LABELS)
    ax.set_yticks(range(0, len(names), step), [clean_name(name) for name in names[::step]], parse_math=False)
    ax.set_ylabel("sensor")
    finish(ax)
    ax.grid(visible=False)
    # Beside the axes rather than out of them: figures above keep the same time axis.
    scale = ax.inset_axes((1.02, 0.0, 0.02, 1.0))
    ax.figure.colorbar(mesh, cax=scale)
    scale.spines["outline"].set(color=FRAME, linewidth=0.8)
    scale.set_ylabel("weight", color=INK, fontsize=LABEL_SIZE)
    scale.tick_params(color=FRAME, labelcolor=INK, labelsize=TICK_SIZE)
    return ax


def plot_signals(
    figure: Figure | SubFigure,
    time: Numbers,
    signals: Mapping[str, Numbers],
    *,
    unit: str | None = None,
    in_seconds: bool = True,
) -> None:
    """Draw a signal and what is left of it when noise is averaged away, beside that of another signal.

    Signals of any length are reduced to 600 blocks: above, the range of the first signal's samples in each; below,
    the averages of all signals.

    Args:
        figure: Where to draw.
        time: Time of each sample `(time,)`.
        signals: One or two signals `(time,)` by name; NaN is left out.
        unit: Unit of the signals.
        in_seconds: Whether `time` is in seconds, else in samples.
    """
    top, bottom = figure.subplots(2, 1, sharex=True)
    styles: tuple[dict[str, Any], ...] = ({"color": BLUE, "linewidth": 1.2, "zorder": 4}, DASHED | {"linewidth": 1.0})
    times, handles = as_array(time), []
    for i, (values, style) in enumerate(zip(signals.values(), styles, strict=False)):
        instants, low, high, average = _in_blocks(times, as_array(values))
        known = average[np.isfinite(average)]
        handles += bottom.plot(instants, average - (known.mean() if known.size else 0.0), **style)
        if i == 0:
            top.fill_between(instants, low, high, color=BLUE, alpha=0.55, linewidth=0.4)
    names = list(signals)
    block = f"{(times[-1] - times[0]) / len(instants):.3g} {'s' if in_seconds else 'samples'}"
    top.set_title(f"{names[0].capitalize()}, range of the samples", loc="left", fontsize=LABEL_SIZE, color=INK)
    bottom.set_title(f"Averages over {block}, less the mean", loc="left", fontsize=LABEL_SIZE, color=INK)
    for ax in (top, bottom):
        ax.set_ylabel(with_unit("signal", unit), parse_math=False)
    bottom.set_xlabel("time (s)" if in_seconds else "sample")
    finish(top)
    finish(bottom, handles, names, loc="lower right", bbox_to_anchor=(1, 1), ncols=2, borderaxespad=0.2)
    figure.align_ylabels()


def plot_fusion(
    figure: Figure | SubFigure,
    tau: Numbers,
    wavelet_variance: Numbers,
    weights: Numbers,
    *,
    names: Sequence[str],
    virtual: Numbers,
    equal: Numbers,
    band: Limits | None = None,
    interval: Limits | None = None,
    unit: str | None = None,
    in_seconds: bool = True,
) -> None:
    """Draw a fused array in one figure: the gain over the plain mean, the Allan deviations, and the weights.

    Args:
        figure: Where to draw.
        tau: Averaging times `(level,)`, seconds or samples.
        wavelet_variance: Of every sensor, `(level, sensor)`, signal^2.
        weights: `(sensor,)`, or `(band, sensor)`.
        names: Name of each sensor.
        virtual: Wavelet variance of the virtual gyro, `(level,)`.
        equal: Wavelet variance of the plain mean, `(level,)`.
        band: Lower and upper limits of `virtual`, `(level,)` each.
        interval: Lower and upper limits of `weights`, `(sensor,)` each.
        unit: Unit of the signal.
        in_seconds: Whether `tau` is in seconds, else in samples.

    References:
        Zhang et al., figures 9 and 10.
    """
    above, middle, below = figure.subplots(3, 1, height_ratios=[1.1, 2.6, 1.3])
    above.sharex(middle)
    plot_ratio(tau, allan_deviation(virtual) / allan_deviation(equal), in_seconds=in_seconds, ax=above)
    above.set_xlabel("")
    above.tick_params(labelbottom=False)
    plot_allan_deviation(
        tau,
        wavelet_variance,
        names=names,
        virtual=virtual,
        band=band,
        equal=equal,
        unit=unit,
        in_seconds=in_seconds,
        ax=middle,
    )
    values = as_array(weights)
    if values.ndim == 2:
        below.sharex(middle)
        middle.set_xlabel("")
        middle.tick_params(labelbottom=False)
        plot_band_weights(tau, values, names=names, in_seconds=in_seconds, ax=below)
    else:
        unknown = np.full(len(names), np.nan)
        low, high = interval if interval is not None else (unknown, unknown)
        plot_weights(values, low, high, names=names, ax=below)
    # Names of sensors beside the bands would push the labels above far out.
    figure.align_ylabels([above, middle] if values.ndim == 2 else [above, middle, below])


def allan_deviation(variance: Numbers) -> Array:
    """`sqrt(2 nu)`, NaN where a logarithmic axis has no place for it."""
    values = as_array(variance)
    return np.sqrt(2 * np.where(values > 0, values, np.nan))


def _in_blocks(times: Array, values: Array) -> tuple[Array, Array, Array, Array]:
    """Instants, minima, maxima and averages of equal stretches of a signal; NaN where a stretch has no sample."""
    n_blocks = min(_N_BLOCKS, len(values))
    starts = np.linspace(0, len(values), n_blocks, endpoint=False).astype(int)
    counts = np.add.reduceat(np.isfinite(values), starts, dtype=float)
    sums = np.add.reduceat(np.where(np.isfinite(values), values, 0.0), starts)
    average = np.divide(sums, counts, out=np.full(n_blocks, np.nan), where=counts > 0)
    return times[starts], np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts), average


def time_axis(ax: Axes, in_seconds: bool) -> None:
    ax.set_xscale("log")
    ax.margins(x=0.02)
    ax.set_xlabel("averaging time (s)" if in_seconds else "averaging time (samples)")


def _label_line_ends(ax: Axes, times: Array, values: Array, names: Sequence[str]) -> None:
    """Write each sensor's name behind the right end of its line, moved apart where they would overlap."""
    known = [column for column in range(values.shape[1]) if np.isfinite(values[:, column]).any()]
    last = {column: np.flatnonzero(np.isfinite(values[:, column]))[-1] for column in known}
    order = sorted(known, key=lambda column: values[last[column], column])
    bottom, top = np.log(ax.get_ylim())
    ends = np.array([np.log(values[last[column], column]) for column in order])
    height = ax.get_window_extent().height * 72 / ax.figure.dpi  # points
    places = _spread((ends - bottom) / (top - bottom) * height, gap=1.25 * SMALL_SIZE)
    for column, place in zip(order, places, strict=True):
        ax.annotate(
            clean_name(names[column]),
            xy=(times[last[column]], values[last[column], column]),
            xytext=(1.015, place / height),
            textcoords="axes fraction",
            color="#6b6b6b",
            fontsize=SMALL_SIZE,
            va="center",
            parse_math=False,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": GREY, "linewidth": 0.4, "shrinkA": 0, "shrinkB": 1}
            | {"relpos": (0, 0.5)},
        )


def _spread(places: Array, gap: float) -> Array:
    """Move ascending places apart by at least `gap`, each as little as possible in least squares."""
    offsets = gap * np.arange(len(places))
    blocks: list[list[float]] = []  # isotonic regression of what remains: [mean, size] of neighbours that touch
    for value in places - offsets:
        blocks.append([value, 1])
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            mean, size = blocks.pop()
            before, n = blocks[-1]
            blocks[-1] = [(before * n + mean * size) / (n + size), n + size]
    return np.concatenate([np.full(int(size), mean) for mean, size in blocks] or [np.empty(0)]) + offsets
