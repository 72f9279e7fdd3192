"""The case study of Zhang et al. (2022), section VI, on public recordings: figures 9 and 10 of the paper.

Weights are chosen on one part of a recording and scored on another, which the paper does not do:

- ADIS16405: three gyros recorded three times for 3 h at rest. As in the paper, recordings are cut in half and the parts
  treated as if they had been recorded together: an array of 18. Weights from the first half of each part, scored on
  the second.
- MIMU4444: eight devices on a board, five sessions of 20 orientations at rest. Weights from four sessions, scored on
  the fifth, each session in turn.
- Xsens DOT: ten devices side by side for 2 min. Weights from one half, scored on the other, both ways.

`--quick` takes every 16th part of the ADIS16405 recordings and two sessions of the MIMU4444.

    python examples/papers/svo_case_study.py [--data FOLDER] [--quick] [--out FOLDER]

FOLDER holds `adis16405_rec1.npz` to `adis16405_rec3.npz`, `mimu4444_8imu.npz` and `xsensdot10_static.npz`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from _svo_study import LINES, arguments, figures_written, finish, n_levels, quadratic
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fusion import SVOResult
from gyrofuse.fusion.weights.baselines import nonnegative_weights
from gyrofuse.fusion.weights.svo import resolve_scale_weights

METHODS = ("SVO long", "SVO short", "nonnegative", "multi-scale")  # against equal weights
FILES = (*(f"adis16405_rec{k}.npz" for k in (1, 2, 3)), "mimu4444_8imu.npz", "xsensdot10_static.npz")
_FRONT_OF_BACK = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]  # devices 2, 4, 6, 8 of the MIMU4444
_BLOCK, _PIECE, _PIECES = 32, 1216, 20  # samples of a block, of a piece at rest, and pieces of a session


@dataclass(frozen=True)
class Trial:
    """One split of an array: `(axis, sensor, time)` to choose weights from and to score them on."""

    fitted: Tensor
    scored: Tensor


@dataclass(frozen=True)
class Array:
    """An array and its trials.

    Attributes:
        name: Of the array.
        rate: Hz.
        trials: One or more.
        levels: Number of levels.
        sensors: Names.
    """

    name: str
    rate: float
    trials: list[Trial]
    levels: int
    sensors: tuple[str, ...]


def adis(folder: Path, quick: bool) -> Array:
    """Parts of three recordings as one array; each part is cut once more to have something to score on."""
    records = [gf.read_recording(folder / name).axes_as_sensors() for name in FILES[:3]]
    n_samples = records[0].n_samples // (32 if quick else 2)
    parts = [record.signal[:, half * n_samples :][:, :n_samples] for record in records for half in range(2)]
    signal = torch.cat(parts)[None]
    names = tuple(f"{k}{axis}{half}" for k in (1, 2, 3) for half in "ab" for axis in records[0].sensors)
    middle = n_samples // 2
    trial = Trial(signal[..., :middle], signal[..., middle:])
    return Array("ADIS16405", records[0].rate, [trial], n_levels(middle) - 1, names)


def mimu(folder: Path, quick: bool) -> Array:
    """Sessions of a board of eight; the pieces of a session are joined with a missing sample between them."""
    mounting = {str(device): _FRONT_OF_BACK for device in (2, 4, 6, 8)}
    path, sessions = folder / FILES[3], range(1, 3 if quick else 6)
    records = [gf.read_recording(path, key=f"exp{k}", mounting=mounting) for k in sessions]
    joined = [still(record.signal) for record in records]
    trials = [Trial(torch.cat(joined[:k] + joined[k + 1 :], -1), joined[k]) for k in range(len(joined))]
    return Array("MIMU4444", records[0].rate, trials, n_levels(_PIECE), records[0].sensors)


def still(signal: Tensor) -> Tensor:
    """Pieces at rest of a session `(axis, sensor, time)`, each without its mean, which depends on the orientation."""
    mean = signal.mean(1)
    blocks = mean[:, : mean.shape[-1] // _BLOCK * _BLOCK].unflatten(-1, (-1, _BLOCK))
    restless = blocks.std(-1).amax(0)
    quiet = np.flatnonzero((restless < 3 * restless.median()).numpy())
    runs = [run for run in np.split(quiet, np.flatnonzero(np.diff(quiet) > 1) + 1) if len(run) >= _PIECE // _BLOCK + 4]
    pieces = []
    for run in runs[:_PIECES]:
        start = _BLOCK * (int(run[0]) + 2)
        piece = signal[..., start : start + _PIECE]
        pieces += [piece - piece.mean(-1, keepdim=True), signal.new_full((*signal.shape[:-1], 1), torch.nan)]
    return torch.cat(pieces, -1)


def xsens(folder: Path, quick: bool) -> Array:
    """Ten devices; half of a recording of two minutes for the other half."""
    record = gf.read_recording(folder / FILES[4])
    middle = record.n_samples // 2
    halves = record.signal[..., :middle], record.signal[..., middle:]
    trials = [Trial(*halves), Trial(*halves[::-1])]
    return Array("Xsens DOT", record.rate, trials[: 1 if quick else 2], n_levels(middle) - 1, record.sensors)


def score(trial: Trial, levels: int) -> tuple[Tensor, Tensor]:
    """Wavelet variance of equal weights `(axis, level)`, and of all methods over it `(axis, method, level)`."""
    options = {"n_levels": levels, "covariance": "none"}
    long, short = (gf.fit_svo(trial.fitted, name, **options) for name in ("long", "short"))
    wccv = gf.wavelet_cross_covariance(trial.fitted, levels)
    nonnegative = nonnegative_weights(wccv, resolve_scale_weights("long", levels))
    multiscale = gf.fit_multiscale(trial.fitted, n_levels=levels)
    new = gf.wavelet_cross_covariance(trial.scored, levels)
    fixed = [quadratic(w[:, None], new) for w in (long.weights, short.weights, nonnegative)]
    fused = gf.wavelet_variance(multiscale.virtual(trial.scored).unsqueeze(-2), levels)[..., 0]
    equal = new.mean((-1, -2))
    return equal, torch.stack([*fixed, fused], 1) / equal[:, None]


def score_array(array: Array) -> tuple[Tensor, Tensor]:
    """Wavelet variance of equal weights `(level,)` and ratios `(axis and trial, method, level)`."""
    scores = [score(trial, array.levels) for trial in array.trials]
    return torch.cat([equal for equal, _ in scores]).log().mean(0).exp(), torch.cat([ratio for _, ratio in scores])


def print_array(array: Array, equal: Tensor, ratio: Tensor) -> None:
    _, n_sensors, n_samples = array.trials[0].fitted.shape
    print(f"\n{array.name}: {n_sensors} sensors, weights from {n_samples} samples at {array.rate:g} Hz")
    several = f" (geometric mean of {len(ratio)} axes and trials, range)" if len(ratio) > 1 else ""
    print(f"Wavelet variance where the weights were not chosen, over equal weights{several}")
    print(f"{'level':>5}  {'tau (s)':>9}  {'equal (deg/s)^2':>15}  " + "  ".join(f"{m:>19}" for m in METHODS))
    for j in range(array.levels):
        middle, low, high = ratio[..., j].log().mean(0).exp(), ratio[..., j].amin(0), ratio[..., j].amax(0)
        triples = zip(middle.tolist(), low.tolist(), high.tolist(), strict=True)
        cells = [f"{m:.3f} [{a:.3f}, {b:.3f}]" if len(ratio) > 1 else f"{m:.3f}" for m, a, b in triples]
        row = "  ".join(f"{cell:>19}" for cell in cells)
        print(f"{j + 1:>5}  {2**j / array.rate:>9.4g}  {equal[j].item():>15.4e}  {row}")


def plot_variances(array: Array, equal: Tensor, ratio: Tensor, path: Path) -> None:
    """[Z] figure 9: wavelet variances below, ratios to equal weights above."""
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(7, 7), sharex=True, height_ratios=[1, 1.4], layout="constrained"
    )
    tau = torch.exp2(torch.arange(array.levels, dtype=torch.float64)) / array.rate
    variances = [gf.wavelet_variance(trial.scored, array.levels).log().mean(0) for trial in array.trials]
    below.loglog(tau, torch.stack(variances).mean(0).exp(), color="#969696", linewidth=0.8)
    below.lines[0].set_label("sensors")
    below.loglog(tau, equal, label="equal", **LINES["equal"])
    above.axhline(1, **LINES["equal"])
    for m, method in enumerate(METHODS):
        line, middle = LINES[method], ratio[:, m].log().mean(0).exp()
        below.loglog(tau, equal * middle, label=method, **line)
        above.semilogx(tau, middle, **line)
        low, high = ratio[:, m].amin(0), ratio[:, m].amax(0)
        above.fill_between(tau, low, high, color=line["color"], alpha=0.12, linewidth=0)
    above.set_ylim(0.9 * ratio.min().item(), min(2.5, 1.05 * ratio.max().item()))
    above.set_title(f"{array.name}: where the weights were not chosen", loc="left", fontsize=10)
    above.set_ylabel("wavelet variance / equal weights")
    below.set_ylabel("wavelet variance (deg/s)$^2$")
    below.set_xlabel("averaging time (s)")
    below.legend(fontsize=8)
    finish(figure, path)


def weights_of(array: Array) -> dict[str, SVOResult]:
    """Weights for long and short times with their 95 % intervals, from the first trial."""
    return {
        f"SVO {name}": gf.fit_svo(array.trials[0].fitted, name, n_levels=array.levels) for name in ("long", "short")
    }


def print_weights(array: Array, found: dict[str, SVOResult]) -> None:
    print(f"{'weights':>15}  " + "  ".join(f"{f'{method}, 95 % interval':>27}" for method in found))
    for i, sensor in enumerate(array.sensors):
        cells = []
        for result in found.values():
            low, high = (limit[0, i].item() for limit in result.confidence_interval)
            cells.append(f"{result.weights[0, i].item():+.4f} [{low:+.4f}, {high:+.4f}]")
        print(f"{sensor:>15}  " + "  ".join(f"{cell:>27}" for cell in cells))


def plot_weights(arrays: list[Array], found: list[dict[str, SVOResult]], path: Path) -> None:
    """[Z] figure 10: weights and their 95 % intervals, on the first axis."""
    figure, axes = plt.subplots(len(arrays), 1, figsize=(8, 2.8 * len(arrays)), layout="constrained")
    for ax, array, results in zip(axes, arrays, found, strict=True):
        for k, (method, result) in enumerate(results.items()):
            places = [i + 0.22 * (k - 0.5) for i in range(len(array.sensors))]
            weights, (low, high) = result.weights[0], (limit[0] for limit in result.confidence_interval)
            color = LINES[method]["color"]
            ax.vlines(places, low, high, color=color, linewidth=1.5)
            ax.plot(places, weights, "o", color=color, markersize=4, label=method)
        ax.axhline(1 / len(array.sensors), **LINES["equal"], label="equal", zorder=1)
        ax.axhline(0, color="#8c8c8c", linewidth=0.8, zorder=0)
        ax.set_xticks(range(len(array.sensors)), array.sensors)
        ax.set_title(array.name, loc="left", fontsize=10)
        ax.set_ylabel("weight")
    axes[-1].set_xlabel("sensor")
    axes[0].legend(fontsize=8, ncols=3, frameon=False, loc="lower right", bbox_to_anchor=(1, 1))
    finish(figure, path)


def main() -> None:
    parser = arguments(__doc__)
    beside = Path(__file__).resolve().parents[2].parent / "shared" / "data"
    parser.add_argument("--data", type=Path, default=beside, help="folder of the recordings; ../shared/data by default")
    options = parser.parse_args()
    missing = [name for name in FILES if not (options.data / name).is_file()]
    if missing:
        print(f"{options.data}: expected {', '.join(missing)}; name their folder with --data FOLDER", file=sys.stderr)
        sys.exit(2)

    arrays = [read(options.data, options.quick) for read in (adis, mimu, xsens)]
    figures, weights = [], []
    for array in arrays:
        equal, ratio = score_array(array)
        weights.append(weights_of(array))
        print_array(array, equal, ratio)
        print_weights(array, weights[-1])
        figures.append(f"svo_case_study_{array.name.split()[0].lower()}.png")
        plot_variances(array, equal, ratio, options.out / figures[-1])
    figures.append("svo_case_study_weights.png")
    plot_weights(arrays, weights, options.out / figures[-1])
    figures_written(options.out, *figures)


if __name__ == "__main__":
    main()
