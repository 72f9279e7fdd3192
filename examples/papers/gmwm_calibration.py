"""The calibration study of Voirol et al., section 5, table 1 and figure 5, on public recordings.

An AR1 and a random walk, without tones and with them, fitted to accelerometers:

- ADIS16405, x axis, three recordings of 3 h at rest, in all of which something swings at 0.56 Hz.
- BROAD, y axis at 286 Hz: at rest before and after a trial, and in between, where the board is moved with a vibrating
  phone on it.

Parameters of the basic model with 95 % intervals side by side, J tests, and the paper's conclusions in numbers.
`--quick` takes a tenth of the ADIS16405 recordings.

    python examples/papers/gmwm_calibration.py --data FOLDER [--quick] [--out FOLDER]

FOLDER holds `adis16405_rec1.npz` to `adis16405_rec3.npz` and `broad_trials.npz`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from _svo_study import arguments, conclusion, figures_written, finish
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting import GMWMResult

ADIS, BROAD = tuple(f"adis16405_rec{k}.npz" for k in (1, 2, 3)), "broad_trials.npz"
BASIC = "AR1 + RW"
_MARGIN = 600  # samples between rest and movement that belong to neither
_FIGURES = ("gmwm_calibration_adis16405.png", "gmwm_calibration_broad.png")


@dataclass(frozen=True)
class Fitted:
    """A recording of one sensor, with the fits of the basic model and of the one with tones where there are any."""

    name: str
    basic: GMWMResult
    toned: GMWMResult | None

    @property
    def results(self) -> tuple[GMWMResult, ...]:
        """One or both."""
        return (self.basic,) if self.toned is None else (self.basic, self.toned)


def fit(name: str, signal: Tensor, rate: float, unit: str, n_tones: int) -> Fitted:
    """Fit a recording `(time,)` without tones, and with `n_tones` if that is more than none."""
    recording = gf.Recording(signal[None], rate=rate, unit=unit)
    toned = gf.fit_gmwm(recording, BASIC + f" + {n_tones}*SIN") if n_tones else None
    return Fitted(name, gf.fit_gmwm(recording, BASIC), toned)


def adis(folder: Path, quick: bool) -> list[Fitted]:
    """The x axis of three recordings at rest, with one tone."""
    found = []
    for k, name in enumerate(ADIS, 1):
        with np.load(folder / name) as data:
            channel = data["channels"].tolist().index("ax")
            signal = torch.from_numpy(data["counts"][channel] * data["scale"][channel])
            signal = signal[: len(signal) // (10 if quick else 1)]
            found.append(fit(f"recording {k}", signal, float(data["fs"]), str(data["units"][channel]), 1))
    return found


def broad(folder: Path) -> list[Fitted]:
    """The y axis at rest before and after the trial with the phone, and in it, with two tones."""
    with np.load(folder / BROAD) as data:
        channel = data["channels"].tolist().index("ay")
        signal = torch.from_numpy(data["t26"][channel]).double()
        start, stop = (np.flatnonzero(np.diff(data["t26_movement"])) + 1).tolist()
        rate, unit = float(data["fs"]), str(data["units"][channel])
    parts = {
        "rest before": (signal[_MARGIN : start - _MARGIN], 0),
        "rest after": (signal[stop + _MARGIN :], 0),
        "vibrating": (signal[start + _MARGIN : stop - _MARGIN], 2),
    }
    return [fit(name, part, rate, unit, n_tones) for name, (part, n_tones) in parts.items()]


def print_table(title: str, recordings: list[Fitted]) -> None:
    """[V] table 1: estimates and intervals of the basic model, fit by fit, then what the J test says."""
    print(f"\n{title}, 95 % intervals")
    names = recordings[0].basic.param_names
    print(
        f"{'':>14}  {'tones':>5}" + "".join(f"  {name:^34}" for name in names) + f"  {'J':>8}  {'p':>7}  {'misfit':>6}"
    )
    for recording in recordings:
        for result in recording.results:
            low, high = result.confidence_interval
            n_tones = len(result.model.processes) - len(recording.basic.model.processes)
            row = f"{recording.name:>14}  {n_tones:>5}"
            for k in range(len(names)):
                value, first, last = (t[0, k].item() for t in (result.params, low, high))
                row += f"  {f'{value:.4g} ({first:.4g}; {last:.4g})':^34}"
            print(row + f"  {result.j_statistic[0]:>8.1f}  {result.p_value[0]:>7.1g}  {misfit(result):>6.3f}")
        if recording.toned is not None:
            model = recording.toned.model
            tones = [process.params[0].tolist() for process in model.processes if isinstance(process, gf.Sinusoid)]
            rate = recording.toned.rate or 1.0
            listed = ", ".join(f"{a:.3g} {recording.toned.unit} at {rate * b / (2 * np.pi):.4g} Hz" for a, b in tones)
            print(f"{'':>14}  tones: {listed}")
    print("misfit: root mean square of ln(measured / fitted wavelet variance)")


def misfit(result: GMWMResult) -> float:
    """Root mean square of the logarithm of measured over fitted wavelet variance."""
    return float((result.wavelet_variance / result.fitted_wavelet_variance).log().square().mean().sqrt())


def apart(one: GMWMResult, other: GMWMResult) -> list[str]:
    """Parameters of the basic model whose intervals do not overlap."""
    first, second = one.confidence_interval, other.confidence_interval
    names = [name for name in one.param_names if name in other.param_names and not name.startswith("sinusoid")]
    return [
        name
        for k, name in enumerate(names)
        if bool((first.high[0, k] < second.low[0, k]) | (second.high[0, k] < first.low[0, k]))
    ]


def print_conclusions(swinging: list[Fitted], phone: list[Fitted]) -> None:
    print("\nThe paper's conclusions (section 5)")
    *rests, vibrating = phone
    toned = vibrating.toned
    assert toned is not None
    p = [rest.basic.p_value.item() for rest in rests]
    conclusion(
        "fig 5",
        "an AR1 and a random walk describe the sensor at rest (J test)",
        "BROAD: p " + ", ".join(f"{value:.2g}" for value in p),
        min(p) > 0.05,
    )
    pairs = [(fitted.basic, fitted.toned) for fitted in (*swinging, vibrating) if fitted.toned is not None]
    ratios = [misfit(with_tones) / misfit(basic) for basic, with_tones in pairs]
    conclusion(
        "fig 5",
        "with tones the model fits the disturbed recordings better",
        "misfit over that without, ADIS16405 and BROAD: " + ", ".join(f"{ratio:.2f}" for ratio in ratios),
        max(ratios) < 1,
    )
    p = [with_tones.p_value.item() for _, with_tones in pairs]
    conclusion(
        "fig 5",
        "and describes them well (J test)",
        "p " + ", ".join(f"{value:.2g}" for value in p),
        min(p) > 0.05,
    )
    names = rests[0].basic.param_names
    different = [apart(rest.basic, toned) for rest in rests]
    conclusion(
        "table 1",
        "all parameters of the basic model differ between the sensor at rest and disturbed, with tones",
        "BROAD, intervals apart: " + "; ".join(", ".join(found) or "none" for found in different),
        all(len(found) == len(names) for found in different),
    )
    different = [apart(basic, with_tones) for basic, with_tones in pairs]
    conclusion(
        "section 5",
        "leaving the tones out changes the AR1",
        "intervals apart, ADIS16405 and BROAD: " + "; ".join(", ".join(found) or "none" for found in different),
        all("ar1_1.phi" in found and "ar1_1.variance" in found for found in different),
    )


def plot(recordings: list[Fitted], path: Path) -> None:
    """[V] figure 5: measured and fitted, without tones and with them."""
    panels = [(recording.name, result) for recording in recordings for result in recording.results]
    columns = (len(panels) + 1) // 2
    figure, axes = plt.subplots(2, columns, figsize=(5.2 * columns, 8), layout="constrained", squeeze=False)
    for ax, (name, result) in zip(axes.T.flat, panels, strict=True):
        result.plot(ax)
        ax.set_title(f"{name}: {result.name}", loc="left", fontsize=10)
    finish(figure, path)


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    options = parser.parse_args()
    if options.data is None:
        print(f"expected a folder with {', '.join((*ADIS, BROAD))}; name it with --data FOLDER", file=sys.stderr)
        sys.exit(2)
    missing = [name for name in (*ADIS, BROAD) if not (options.data / name).is_file()]
    if missing:
        print(f"{options.data}: expected {', '.join(missing)}; name their folder with --data FOLDER", file=sys.stderr)
        sys.exit(2)
    swinging, phone = adis(options.data, options.quick), broad(options.data)
    print_table("ADIS16405 at rest, accelerometer x (g)", swinging)
    print_table("BROAD with a vibrating phone, accelerometer y (m/s^2)", phone)
    print_conclusions(swinging, phone)
    for name, recordings in zip(_FIGURES, (swinging, phone), strict=True):
        plot(recordings, options.out / name)
    figures_written(options.out, *_FIGURES)


if __name__ == "__main__":
    main()
