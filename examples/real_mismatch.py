"""What simulators leave out of real gyroscopes: seven kinds of recordings, each diagnosed and judged on other data.

The simulator is the one that an engineer would have used: white noise, an AR1 and a random walk for each sensor by
itself, fitted to one recording (or part) by wavelet moments. It is diagnosed against another recording; the repaired
simulation is then judged against a third, or, where there is none, on blocks held out.

- ADIS16405, three recordings of 3 h at rest: fitted on the first, diagnosed on the second, judged on the third.
- MIMU4444, eight IMUs on a board at rest in twenty attitudes, one axis: three experiments in the same way.
- Ten Xsens DOT at rest for two minutes: the first half, the second half.
- BROAD, one IMU: at rest, and at rest in another trial.
- MTi-G, one gyroscope with outliers; MPU-6050 at rest for ten minutes: thirds, in the same way.
- Four Xsens DOT on a quadrotor in flight, as deviations from their mean: noise of devices at
  rest, the flight.

    python examples/real_mismatch.py --data FOLDER [--only NAME ...] [--quick] [--out FOLDER]

FOLDER holds the files named in `STUDIES`. The output folder receives a page for each, and `real.md`: a table of all,
and each finding with the share of the discrepancy that it takes away on the data that judge, on which nothing was found
or fitted. `--quick` takes the first recording of each kind, and of the ADIS16405 a tenth.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import gyrofuse as gf
from gyrofuse.mismatch import MismatchReport

BASE = "WN + AR1 + RW"
AXES = "xyz"
LEAD = (
    "Written by `examples/real_mismatch.py`. Each simulator is white noise, an AR1 and a random walk for each sensor "
    "by itself, fitted to one recording, diagnosed against another, and judged on a third or, where there is none, on "
    "blocks held out. Discrepancy: of wavelet cross-covariances per degree of freedom, of which 1 is noise alone; "
    "*recordings apart* has the diagnosed recording in the place of the simulation. AUC: of a classifier that tells "
    "windows of the one from windows of the other, where 0.5 is guessing. Share: of the discrepancy above noise alone "
    "on the data that judge, repair after repair; nothing was found or fitted there, so that a share above zero "
    "confirms a finding and one below refutes it. What happened once in a recording has none on another one."
)
FRONT_OF_BACK = torch.tensor([[0.0, -1, 0], [-1, 0, 0], [0, 0, -1]], dtype=torch.float64)


@dataclass(frozen=True)
class Study:
    """What a simulator is fitted to, diagnosed against, and judged by.

    Attributes:
        name: For pages and tables.
        fitted: Signals `(sensor, time)` behind the simulator.
        diagnosed: The recording that it is compared with.
        judged: A recording that nothing was fitted to, if there is one.
        deviations: Whether signals are deviations from the mean of the sensors, the simulated ones as well.
    """

    name: str
    fitted: Tensor
    diagnosed: gf.Recording
    judged: gf.Recording | None = None
    deviations: bool = False


@dataclass(frozen=True)
class Outcome:
    """A diagnosis, and how well simulations before and after it agree with another recording.

    Attributes:
        before, after: Discrepancies per degree of freedom; 1 is noise alone.
    """

    study: Study
    report: MismatchReport
    before: float
    after: float
    elsewhere: str = field(default="blocks held out")


def arrays(path: Path) -> Mapping[str, np.ndarray]:
    """All arrays of a file."""
    with np.load(path) as file:
        return {key: file[key] for key in file.files}


def adis(folder: Path, quick: bool) -> Iterator[Study]:
    """Three gyroscopes of a device; its accelerometers go along."""
    records = []
    for k in (1, 2, 3):
        data = arrays(folder / f"adis16405_rec{k}.npz")
        signal = torch.from_numpy(data["counts"] * data["scale"][:, None])
        signal = signal[:, : signal.shape[-1] // (10 if quick else 1)]
        channels = {"acceleration": signal[3:]}
        records.append(
            gf.Recording(
                signal[:3], rate=float(data["fs"]), unit="deg/s", sensors=("gx", "gy", "gz"), channels=channels
            )
        )
    yield Study("adis16405", records[0].signal, records[1], records[2])


def mimu(folder: Path, quick: bool) -> Iterator[Study]:
    """Eight devices at rest in twenty attitudes, one after the other, each axis as an array."""
    data = arrays(folder / "mimu4444_8imu.npz")
    parts = [at_rest(torch.from_numpy(data[f"exp{k}"]), torch.from_numpy(data["scale"])) for k in (1, 2, 3)]
    rate = float(data["fs"])
    for axis, name in enumerate(AXES):
        records = [
            gf.Recording(part[:, 3 + axis], rate=rate, unit="deg/s", channels={"acceleration": part[:, :3].mean(0)})
            for part in parts
        ]
        yield Study(f"mimu4444_{name}", records[0].signal, *records[1:])


def at_rest(counts: Tensor, scale: Tensor) -> Tensor:
    """Stretches at rest of `(time, device, channel)`, one after the other, as `(device, channel, time)` in units."""
    turned = counts.to(torch.float64).unflatten(-1, (2, 3))
    turned[:, 1::2] = turned[:, 1::2] @ FRONT_OF_BACK.mT
    restless = turned[:, :, 1].mean(1)
    restless = restless[: len(restless) // 32 * 32].unflatten(0, (-1, 32)).std(1).amax(-1)
    still = np.flatnonzero(restless.numpy() < 3 * float(restless.median()))
    runs = [run for run in np.split(still, np.flatnonzero(np.diff(still) > 1) + 1) if len(run) >= 42]
    pieces = [turned[32 * (run[0] + 2) :][:1216] for run in runs[:20]]
    # Each attitude has a bias of its own, by gravity: a stretch's mean is taken off, in whole counts.
    level = torch.cat([piece - piece.mean(0).round() for piece in pieces])
    return (level.flatten(-2) * scale).permute(1, 2, 0)


def xsens(folder: Path, quick: bool) -> Iterator[Study]:
    """Ten devices side by side, each axis as an array; up to the sample that one of them lacks."""
    data = arrays(folder / "xsensdot10_static.npz")
    whole = torch.from_numpy(data["data"].astype(float))
    whole = whole[..., : int(np.flatnonzero(~np.isfinite(data["data"]).all((0, 1)))[0])]
    rate, half = float(data["fs"]), whole.shape[-1] // 2
    for axis, name in enumerate(AXES):
        later = whole[..., half:]
        channels = {"acceleration": later[:, 3:].mean(0)}
        yield Study(
            f"xsensdot10_{name}",
            whole[:, axis, :half],
            gf.Recording(later[:, axis], rate=rate, unit="deg/s", channels=channels),
        )


def broad(folder: Path, quick: bool) -> Iterator[Study]:
    """One device: at rest before a trial, at rest before another one, and after that."""
    data = arrays(folder / "broad_trials.npz")

    def rest(trial: str, *, before: bool) -> gf.Recording:
        signal = torch.from_numpy(data[trial].astype(float))
        start, stop = (np.flatnonzero(np.diff(data[f"{trial}_movement"])) + 1).tolist()
        part = signal[:, 600 : start - 600] if before else signal[:, stop + 600 :]
        channels = {"acceleration": part[3:]}
        return gf.Recording(
            part[:3], rate=float(data["fs"]), unit="rad/s", sensors=("gx", "gy", "gz"), channels=channels
        )

    for trial, name in (("t01", "other_trial"), ("t24", "tapping"), ("t26", "phone")):
        fitted = rest("t06" if trial == "t01" else "t01", before=True)
        yield Study(f"broad_{name}", fitted.signal, rest(trial, before=True), rest(trial, before=False))


def quadrotor(folder: Path, quick: bool) -> Iterator[Study]:
    """Four devices in flight on one frame, aligned by their clocks to the nearest sample, without their mean.

    Deviations from the mean add up to nothing: the last one says what the others do.
    """
    data = arrays(folder / "xsensdot4_quadrotor.npz")
    names = sorted(key.removesuffix("_t_us") for key in data if key.endswith("_t_us"))
    period = 1e6 / float(data["fs"])
    first = max(int(data[f"{name}_t_us"][0]) for name in names)
    starts = [round((first - int(data[f"{name}_t_us"][0])) / period) for name in names]
    length = min(data[name].shape[-1] - start for name, start in zip(names, starts, strict=True))
    signal = np.stack([data[name][:, s : s + length] for name, s in zip(names, starts, strict=True)]).astype(float)
    gap = np.flatnonzero(~np.isfinite(signal).all((0, 1)))
    signal[..., gap] = (signal[..., gap - 1] + signal[..., gap + 1]) / 2  # one sample
    flight = torch.from_numpy(signal)
    still = torch.from_numpy(arrays(folder / "xsensdot10_static.npz")["data"][1:5].astype(float))
    for axis, name in enumerate(AXES):
        deviation = (flight[:, axis] - flight[:, axis].mean(0))[:-1]
        part = gf.Recording(
            deviation,
            rate=float(data["fs"]),
            unit="deg/s",
            channels={"rate": flight[:, :3].mean(0), "acceleration": flight[:, 3:].mean(0)},
        )
        yield Study(f"quadrotor_{name}", still[:, axis], part, deviations=True)


def thirds(signal: Tensor, rate: float, unit: str, channels: Mapping[str, Tensor]) -> list[gf.Recording]:
    """A recording in three parts."""
    n = signal.shape[-1] // 3
    return [
        gf.Recording(
            signal[..., k * n : (k + 1) * n],
            rate=rate,
            unit=unit,
            channels={name: values[..., k * n : (k + 1) * n] for name, values in channels.items()},
        )
        for k in range(3)
    ]


def mtig(folder: Path, quick: bool) -> Iterator[Study]:
    """One gyroscope."""
    data = arrays(folder / "mtig_contaminated_gx.npz")
    parts = thirds(torch.from_numpy(data["gyro_x"])[None], float(data["fs"]), "rad/s", {})
    yield Study("mtig", parts[0].signal, *parts[1:])


def mpu(folder: Path, quick: bool) -> Iterator[Study]:
    """One device; the clock of the host comes in bursts, so that samples are taken as evenly spaced."""
    data = arrays(folder / "mpu6050_static10min_rotations_temp.npz")
    whole = torch.from_numpy(data["static10min"].astype(float))
    parts = thirds(whole[:3], float(data["fs"]), "deg/s", {"acceleration": whole[3:6], "temperature": whole[6]})
    yield Study("mpu6050", parts[0].signal, *parts[1:])


STUDIES: Mapping[str, tuple[Callable[[Path, bool], Iterator[Study]], tuple[str, ...]]] = {
    "adis16405": (adis, tuple(f"adis16405_rec{k}.npz" for k in (1, 2, 3))),
    "mimu4444": (mimu, ("mimu4444_8imu.npz",)),
    "xsensdot10": (xsens, ("xsensdot10_static.npz",)),
    "broad": (broad, ("broad_trials.npz",)),
    "mtig": (mtig, ("mtig_contaminated_gx.npz",)),
    "mpu6050": (mpu, ("mpu6050_static10min_rotations_temp.npz",)),
    "quadrotor": (quadrotor, ("xsensdot4_quadrotor.npz", "xsensdot10_static.npz")),
}


def examine(study: Study) -> Outcome:
    """Fit the simulator, diagnose it, and judge what became of it."""
    fit = gf.fit_gmwm(gf.Recording(study.fitted, rate=study.diagnosed.rate, unit=study.diagnosed.unit), BASE)
    simulator = gf.ArrayModel.from_sensors([fit.model.with_params(row) for row in fit.params])
    generator = torch.Generator().manual_seed(0)

    simulation: gf.ArrayModel | Tensor = simulator
    if study.deviations:
        signal = simulator.simulate(4 * study.diagnosed.signal.shape[-1], generator=generator)
        simulation = (signal - signal.mean(0))[:-1]
    report = gf.diagnose(study.diagnosed, simulation, judge=study.judged)
    if report.judged is not None:
        return Outcome(study, report, report.judged.before, report.judged.after, "another recording")
    after = report.held_out.after if report.held_out.paired is None else report.held_out.paired
    return Outcome(study, report, report.held_out.before, after)


def table(outcomes: list[Outcome]) -> str:
    """One row for each recording as Markdown, and below it what was found."""
    titles = ("recording", "discrepancy before", "after", "recordings apart", "AUC before", "after", "judged on")
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for outcome in outcomes:
        held, judged = outcome.report.held_out, outcome.report.judged
        apart = "-" if judged is None else f"{judged.repeatability:.3g}"
        areas = (held.auc_before, held.auc_after) if judged is None else (judged.auc_before, judged.auc_after)
        lines.append(
            f"| {outcome.study.name} | {outcome.before:.3g} | {outcome.after:.3g} | {apart} | {areas[0]:.2f} | "
            f"{areas[1]:.2f} | {outcome.elsewhere} |"
        )
    return "\n".join([*lines, *(line for outcome in outcomes for line in findings(outcome))])


def findings(outcome: Outcome) -> list[str]:
    """What was found in a recording, with the share of the discrepancy that each takes away where it is judged."""
    report = outcome.report
    shares = report.held_out.shares if report.judged is None else report.judged.shares
    lines = ["", f"## {outcome.study.name}", ""]
    if not report.mismatch:
        return [*lines, "Recording and simulation agree."]
    if shares:
        lines += ["| what | share |", "|---|---|"]
        lines += [f"| {share.name.replace('_', ' ')} | {100 * share.share:.3g} % |" for share in shares]
        lines += [f"| left | {100 * (1 - sum(share.share for share in shares)):.3g} % |", ""]
    lines += [f"- **{finding.mechanism.replace('_', ' ')}**: {finding.sentence}." for finding in report.findings]
    left = ", ".join(entry.test for entry in report.unexplained)
    return [*lines, f"- Unexplained: {left or 'nothing'}."]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--only", nargs="+", choices=list(STUDIES), help="some of the studies; all by default")
    parser.add_argument("--quick", action="store_true", help="one recording of each kind, a tenth of a long one")
    parser.add_argument("--out", type=Path, default=Path("real_mismatch"), help="folder of what is written")
    options = parser.parse_args()
    chosen = options.only or list(STUDIES)
    missing = [name for key in chosen for name in STUDIES[key][1] if not (options.data / name).is_file()]
    if missing:
        parser.error(f"--data: expected a folder with {', '.join(missing)}, which {options.data} has not")
    options.out.mkdir(parents=True, exist_ok=True)
    outcomes = []
    for key in chosen:
        for study in islice(STUDIES[key][0](options.data, options.quick), 1 if options.quick else None):
            outcome = examine(study)
            outcomes.append(outcome)
            outcome.report.to_html(options.out / f"{study.name}.html", title=study.name)
            print(f"== {study.name}\n{outcome.report}", flush=True)
            print(f"On {outcome.elsewhere}: discrepancy {outcome.before:.3g} before, {outcome.after:.3g} after\n")
    page = f"# What simulators leave out of real gyroscopes\n\n{LEAD}\n\n{table(outcomes)}\n"
    (options.out / "real.md").write_text(page, encoding="utf-8")
    print(table(outcomes))


if __name__ == "__main__":
    main()
