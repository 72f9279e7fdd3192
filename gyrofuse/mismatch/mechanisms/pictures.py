"""Pictures of the evidence for a mechanism: what a person would look at, in one sensor, recording beside simulation.

Every function draws into the axes that it is given; the recording is dark, the simulation blue, what was fitted orange.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from gyrofuse._base.axes import BLUE, DASHED, INK, SHADE, clean_name, finish, with_unit
from gyrofuse.mismatch.signals.comparison import N_BLOCKS, Comparison, block_means
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.signals.prediction_errors import left_out
from gyrofuse.mismatch.signals.psd import hann_transform
from gyrofuse.mismatch.stats.hmm import most_likely_path
from gyrofuse.mismatch.stats.limits import Z

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_DOT: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 3, "color": INK}
_LINE: dict[str, Any] = {"color": BLUE, "linewidth": 1.2}
_RECORDED: dict[str, Any] = {**_LINE, "color": INK}


def spectrum_near(ax: Axes, comparison: Comparison, sensor: int, frequency_hz: float, half_width_hz: float) -> None:
    """Periodograms under a Hann taper around a frequency, over the smooth spectrum that describes the simulation.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        frequency_hz: Middle of the picture.
        half_width_hz: Half width of the line; twelve of them are shown, or forty bins where that is more.
    """
    rate = comparison.info.rate
    reach = max(12 * half_width_hz, 40 * rate / comparison.n_samples)
    handles: list[Any] = []
    for side, style in ((comparison.reference, _LINE), (comparison.observed, _RECORDED)):
        transform, length = hann_transform(side.signal[0, sensor])
        f = torch.arange(len(transform), dtype=torch.float64) / length
        shown = ((f * rate - frequency_hz).abs() <= reach) & (f > 1 / length)
        power = transform.abs().square()[shown] / comparison.base.spectrum(f[shown])[sensor]
        handles += _plot(ax, f[shown] * rate, power, **style)
    ax.set_yscale("log")
    _finish(ax, handles[::-1], ["recording", "simulation"], "frequency (Hz)", "power over the noise")


def means_over_time(ax: Axes, comparison: Comparison, sensor: int, path: Tensor | None) -> None:
    """Means over 256 blocks of the recording, and the path that was fitted.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        path: Fitted path `(sensor, time)`; None for none.
    """
    _means(ax, comparison, sensor, _block_times(comparison), "time (s)", path)


def means_against(ax: Axes, comparison: Comparison, sensor: int, x: Tensor, label: str, path: Tensor | None) -> None:
    """Means over 256 blocks of the recording against those of a channel.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        x: The channel `(time,)`.
        label: Name of the channel.
        path: Fitted path `(sensor, time)`; None for none.
    """
    _means(ax, comparison, sensor, block_means(x), label, path)


def _means(ax: Axes, comparison: Comparison, sensor: int, x: Tensor, label: str, path: Tensor | None) -> None:
    """Means over 256 blocks of the recording, and of the path `(sensor, time)`, against `x` `(block,)`."""
    means = block_means(comparison.recording[sensor])
    handles = _plot(ax, x, means - means.mean(), **_DOT)
    if path is not None:
        fitted = block_means(path[sensor])  # in the order of time: where the way counts it is a loop
        handles += _plot(ax, x, fitted - fitted.mean(), **DASHED)
    _finish(ax, handles, ["recording", "fitted"], label, with_unit("mean of a block", comparison.info.measure))


def gain_on_channel(ax: Axes, comparison: Comparison, sensor: int, x: Tensor, label: str) -> None:
    """Samples of the recording against a channel that they follow at once: means and standard errors in 24 bins.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        x: The channel, or the path of size one that was made of it, `(time,)`.
        label: Name of the channel.
    """
    edges = torch.quantile(x[:: max(len(x) // 100_000, 1)], torch.linspace(0, 1, 25, dtype=x.dtype)).unique()
    which = torch.bucketize(x, edges[1:-1])
    count = torch.bincount(which, minlength=len(edges) - 1).clamp(min=1)
    y = comparison.recording[sensor] - comparison.recording[sensor].mean()
    mean, middle = (torch.zeros(len(count), dtype=x.dtype).index_add(0, which, v) / count for v in (y, x))
    sd = float(y.std()) / count.sqrt()
    handles = [
        ax.errorbar(
            middle.numpy(), mean.numpy(), yerr=(Z * sd).numpy(), color=INK, linestyle="none", marker="o", markersize=3
        )
    ]
    _finish(
        ax, handles, ["recording, with 95 % intervals"], label, with_unit("mean of samples", comparison.info.measure)
    )


def ratio_of_spectra(ax: Axes, comparison: Comparison, sensor: int, factor: Callable[[Tensor], Tensor] | None) -> None:
    """Ratio of the powers of recording and simulation by band of frequency, with the range of chance.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        factor: Fitted factor on power `(sensor, frequency)` at `f` cycles per sample; None for none.
    """
    observed, reference, f = comparison.observed, comparison.reference, comparison.bands.frequency
    known = reference.dof > 0
    ratio = (observed.power / reference.power)[sensor, known]
    sd = (1 / observed.dof[known] + 1 / reference.dof[known]).sqrt()
    hertz = f[known] * comparison.info.rate
    handles = _plot(ax, hertz, ratio, **_DOT)
    handles.append(ax.fill_between(hertz.numpy(), (-Z * sd).exp().numpy(), (Z * sd).exp().numpy(), **SHADE))
    if factor is not None:
        handles += _plot(ax, hertz, factor(f[known])[sensor], **DASHED)
    ax.set_xscale("log")
    ax.set_yscale("log")
    labels = ["recording", "95 % of recordings that agree", "fitted"]
    _finish(ax, handles, labels, "frequency (Hz)", "recording over simulation, power")


def coherence(ax: Axes, comparison: Comparison, sensor: int, shared: Tensor, *, in_phase: bool = False) -> None:
    """Coherence, or its part in phase, of a sensor with the one it shares most with, by band, and the reach of chance.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        shared: How much each sensor shares with it, `(sensor,)`, of any scale.
    """
    others = [i for i in range(comparison.n_sensors) if i != sensor]
    other = max(others, key=lambda i: float(shared[i].abs()))
    pair = " and ".join(clean_name(comparison.info.sensors[i]) for i in (sensor, other))
    hertz, dof = comparison.bands.frequency * comparison.info.rate, comparison.observed.coherence_dof
    handles: list[Any] = []
    for side, style in ((comparison.observed, _DOT), (comparison.reference, _LINE)):
        value = side.coherence[:, sensor, other]
        handles += _plot(ax, hertz, value.real if in_phase else value.abs(), **style)
    # The square of a coherence of `d` ordinates of independent sensors exceeds x with probability (1 - x)^(d - 1).
    known, chance = dof > 1, 0.05 / len(dof)
    limit = (1 - chance ** (1 / (dof[known] - 1))).sqrt()
    handles += _plot(ax, hertz[known], limit, **DASHED)
    ax.set_xscale("log")
    ax.set_ylim(-1.02 if in_phase else 0, 1.02)
    labels = [f"recording, {pair}", "simulation", "independent sensors: 1 picture in 20 has a dot above"]
    _finish(ax, handles, labels, "frequency (Hz)", f"coherence of {pair}{', in phase' if in_phase else ''}")


def values(ax: Axes, comparison: Comparison, sensor: int, centre: float, width: float) -> None:
    """Histograms of the values around one of them, 200 bins.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        centre, width: Middle and half width of the picture, unit of the signal.
    """
    handles = []
    own, other = comparison.recording[sensor], comparison.reference.signal[0, sensor]
    for signal, style in ((own, _RECORDED), (other - other.mean() + own.mean(), _LINE)):
        share, edges = np.histogram(signal.numpy(), np.linspace(centre - width, centre + width, 201))
        handles.append(ax.stairs(share / signal.numel(), edges, **style))
    label = with_unit("value", comparison.info.measure)
    _finish(ax, handles, ["recording", "simulation"], label, "share of the samples in a bin")


def distance_from_grid(ax: Axes, comparison: Comparison, sensor: int, step: float, offset: float) -> None:
    """Histograms of the distances of values from a quantisation grid, in steps.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        step, offset: Of the grid, unit of the signal.
    """
    handles = []
    own, other = comparison.recording[sensor], comparison.reference.signal[0, sensor]  # no mean is taken off a grid
    for signal, style in ((own, _RECORDED), (other, _LINE)):
        steps = (signal - offset) / step
        density, edges = np.histogram((steps - steps.round()).numpy(), np.linspace(-0.505, 0.505, 102), density=True)
        handles.append(ax.stairs(density, edges, **style))
    _finish(ax, handles, ["recording", "simulation"], "distance from the grid (steps)", "density")


def samples(ax: Axes, comparison: Comparison, sensor: int, first: int, count: int) -> None:
    """A few samples of both sides, one by one.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        first, count: First sample that is shown, and number of them.
    """
    first = max(min(first, comparison.n_samples - count), 0)
    seconds = torch.arange(first, first + count) / comparison.info.rate
    own = comparison.recording[sensor, first : first + count]
    other = comparison.reference.signal[0, sensor, :count]
    handles = _plot(ax, seconds, own - own.mean(), color=INK, linewidth=0.8, marker="o", markersize=2.5)
    handles += _plot(ax, seconds[: len(other)], other - other.mean(), color=BLUE, linewidth=0.8, alpha=0.7)
    _finish(ax, handles, ["recording", "simulation"], "time (s)", with_unit("sample", comparison.info.measure))


def transient(ax: Axes, comparison: Comparison, sensor: int, first: int, count: int, path: Tensor | None) -> None:
    """Samples of both sides around a transient, and the path that was fitted.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        first, count: First sample that is shown, and number of them.
        path: Fitted path `(sensor, time)`; None for none.
    """
    first = max(min(first, comparison.n_samples - count), 0)
    shown = slice(first, first + count)
    own, other = comparison.recording[sensor], comparison.reference.signal[0, sensor]
    seconds = comparison.info.seconds(comparison.n_samples)[shown]
    handles = _plot(ax, seconds, own[shown] - own.mean(), **_DOT)
    handles += _plot(ax, seconds[: len(other[:count])], other[: len(seconds)] - other.mean(), **_LINE)
    if path is not None:
        handles += _plot(ax, seconds, path[sensor, shown], **DASHED)
    label = with_unit("signal less its mean", comparison.info.measure)
    _finish(ax, handles, ["recording", "simulation", "fitted"][: len(handles)], "time (s)", label)


def tone_over_time(ax: Axes, comparison: Comparison, sensor: int, frequency_hz: float, path: Tensor | None) -> None:
    """Amplitude at a frequency in 128 parts of both sides, and of the path that was fitted.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        frequency_hz: Of the tone.
        path: Fitted path `(sensor, time)`; None for none.
    """
    length, rate = comparison.n_samples // 128, comparison.info.rate

    def course(signal: Tensor) -> tuple[Tensor, Tensor]:
        n = signal.shape[-1] // length * length
        angle = 2 * math.pi * frequency_hz * comparison.info.seconds(n)
        turned = (signal[:n] - signal.mean()) * torch.polar(torch.full_like(angle, 2.0), -angle)
        return (torch.arange(n // length) + 0.5) * length / rate, turned.unflatten(-1, (-1, length)).mean(-1).abs()

    handles = _plot(ax, *course(comparison.recording[sensor]), **_DOT)
    handles += _plot(ax, *course(comparison.reference.signal[0, sensor]), **_LINE)
    if path is not None:
        handles += _plot(ax, *course(path[sensor]), **DASHED)
    label = with_unit(f"amplitude at {frequency_hz:.5g} Hz", comparison.info.measure)
    _finish(ax, handles, ["recording", "simulation", "fitted"][: len(handles)], "time (s)", label)


def tails(ax: Axes, comparison: Comparison, sensor: int) -> None:
    """Share of prediction errors beyond each size, in standard deviations, and that of normal noise."""
    handles: list[Any] = []
    for side, style in ((comparison.observed, {"color": INK, "linewidth": 1.4}), (comparison.reference, _LINE)):
        size = left_out(side).z[:, sensor].flatten().abs().sort(descending=True).values
        kept = torch.logspace(0, math.log10(len(size)), 400).long().unique().clamp(max=len(size)) - 1
        handles += _plot(ax, size[kept], (kept + 1) / len(size), **style)
    x = torch.linspace(0, 6, 100, dtype=torch.float64)
    handles += _plot(ax, x, torch.special.erfc(x / math.sqrt(2)), **DASHED)
    ax.set_yscale("log")
    ax.set_ylim(bottom=0.3 / comparison.n_samples)
    labels = ["recording", "simulation", "normal noise"]
    _finish(ax, handles, labels, "size of a prediction error (standard deviations)", "share beyond it")


def variance_over_time(ax: Axes, comparison: Comparison, sensor: int, course: Tensor | None) -> None:
    """Mean squares of whitened samples over 256 blocks.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        course: Fitted variance `(sensor, time)`, over that of the rest; None for none.
    """
    seconds = _block_times(comparison)
    white = whitened(comparison.observed.steady[0], comparison.base)
    squares = block_means(white[sensor].square())
    handles = _plot(ax, seconds, squares, **_DOT)
    if course is not None:
        fitted = block_means(course[sensor])
        handles += _plot(ax, seconds, fitted * squares.median() / fitted.median(), **DASHED)
    ax.set_yscale("log")
    _finish(ax, handles, ["recording", "fitted"], "time (s)", "variance over the simulation's")


def two_levels(ax: Axes, comparison: Comparison, sensor: int, half_step: float, dwell: float) -> None:
    """Means over an eighth of a dwell, and the likeliest path between two levels (Viterbi), over some forty dwells.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        half_step: Half the distance of the levels; 0 where none is left.
        dwell: Mean time in a level, samples.
    """
    length = max(int(dwell / 8), 1)
    n = min(comparison.n_samples // length, 320)
    means = comparison.recording[sensor, : n * length].unflatten(-1, (n, length)).mean(-1)
    means = means - means.median()
    seconds = (torch.arange(n) + 0.5) * length / comparison.info.rate
    handles = _plot(ax, seconds, means, color=INK, linewidth=0.8)
    if half_step:
        noise = float(means.diff().square().median()) / 0.9  # twice the variance of a mean: chi-square has median 0.45
        handles += _plot(ax, seconds, half_step * likeliest_path(means / half_step, noise / half_step**2), **DASHED)
    _finish(
        ax, handles, ["recording", "decoded"], "time (s)", with_unit("mean of a few samples", comparison.info.measure)
    )


def likeliest_path(y: Tensor, variance: float, stay: float = 7 / 8) -> Tensor:
    """Path of values +-1 that is likeliest for means `(time,)` of some variance."""
    log_likelihood = torch.stack([-(y + 1).square(), -(y - 1).square()], -1) / max(variance, 1e-6)
    start = torch.full((2,), 0.5, dtype=y.dtype)
    transition = torch.tensor([[stay, 1 - stay], [1 - stay, stay]], dtype=y.dtype)
    return 2.0 * most_likely_path(log_likelihood, start, transition) - 1


def spectrogram(
    ax: Axes,
    comparison: Comparison,
    sensor: int,
    band_hz: tuple[float, float],
    window_s: float,
    track: tuple[Tensor, Tensor] | None,
) -> None:
    """Power of the recording over time and frequency in a band, and the track that was fitted.

    Args:
        ax: Axes to draw into.
        comparison: Recording and simulation.
        sensor: Position of the sensor.
        band_hz: Lowest and highest frequency.
        window_s: Length of the pieces that are transformed.
        track: Times, s, and frequencies, Hz, `(time,)`; None for none.
    """
    seconds, f, power = power_over_time(comparison, sensor, window_s)
    shown = (f >= band_hz[0] - 4 * f[1]) & (f <= band_hz[1] + 4 * f[1])
    if int(shown.sum()) < 2:
        return
    level = power[:, shown].clamp(min=1e-300).log10().mT
    low = float(level.median())
    high = max(float(level.max()), low + 1.5)
    image = level.numpy()
    ax.pcolormesh(seconds.numpy(), f[shown].numpy(), image, cmap="Greys", vmin=low - 0.3, vmax=high, rasterized=True)
    handles = [] if track is None else _plot(ax, *track, color=DASHED["color"], linewidth=0.8)
    _finish(ax, handles, ["fitted"][: len(handles)], "time (s)", "frequency (Hz)")
    ax.grid(visible=False)


def power_over_time(comparison: Comparison, sensor: int, window_s: float) -> tuple[Tensor, Tensor, Tensor]:
    """Seconds `(piece,)`, frequencies in Hz `(bin,)` and powers `(piece, bin)` of the recording."""
    rate, n = comparison.info.rate, comparison.n_samples
    window = int(min(max(window_s * rate, 64), n / 8))
    hop = max(window // 4, n // 400)
    pieces = comparison.recording[sensor].unfold(-1, window, hop)
    power = torch.fft.rfft(pieces * torch.hann_window(window, dtype=pieces.dtype)).abs().square()
    f = torch.arange(power.shape[-1], dtype=torch.float64) / window * rate
    return (torch.arange(len(power)) * hop + window / 2) / rate, f, power


def _finish(ax: Axes, handles: list[Any], labels: list[str], x: str, y: str) -> None:
    """The common look: labels of the axes, and a legend for as many of the labels as something was drawn for."""
    ax.set_xlabel(x, parse_math=False)
    ax.set_ylabel(y, parse_math=False)
    finish(ax, handles, labels[: len(handles)])


def _plot(ax: Axes, x: Tensor, y: Tensor, **style: Any) -> list[Any]:
    """Lines or dots of tensors."""
    return list(ax.plot(x.numpy(), y.numpy(), **style))


def _block_times(comparison: Comparison) -> Tensor:
    """Middles of the 256 blocks, s."""
    return (torch.arange(N_BLOCKS) + 0.5) * comparison.block / comparison.info.rate
