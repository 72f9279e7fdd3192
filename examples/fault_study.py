"""How well the parity test finds faults: detection and naming curves, and false alarms on untouched recordings.

Faults of five kinds are put into every sensor of an array at ten strengths. A run is detected when a window after the
onset raises an alarm, named when the faulty sensor and no other is named, and told when its kind is right as well,
in the window that says it most clearly.

Strengths are in units of the sensor's white noise per sample: the step of a bias, what a drift makes of a window, the
noise added, the amplitude of a rotation of one second that all sensors feel while one of them has its sign turned;
for a frozen sensor how many windows it stays so.

    python examples/fault_study.py [--data FOLDER] [--quick] [--out faults.png]

FOLDER holds `mimu4444_8imu.npz` (8 IMUs on one board, 5 experiments of 20 orientations at rest) and
`xsensdot10_static.npz` (10 devices side by side). The reference is the first half of each session; false alarms are
also counted against the other sessions, between which the noise of these sensors really differs. Without the folder
a simulated array stands in.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fusion.faults.classify import KINDS
from gyrofuse.fusion.faults.parity import parity_test
from gyrofuse.fusion.faults.reference import ParityReference, fit_parity_reference

FALSE_ALARM = 0.01
ONSET = 2  # window at which the fault begins
STRENGTHS = {
    "frozen": np.geomspace(0.1, 2, 10),
    "biased": np.geomspace(0.1, 10, 10),
    "drifting": np.geomspace(0.1, 10, 10),
    "noisier": np.geomspace(0.1, 10, 10),
    "sign-flipped": np.geomspace(0.03, 3, 10),
}


@dataclass
class Session:
    """One array: `reference` of its healthy first half, and pieces `(piece, ..., sensor, time)` of the second."""

    reference: ParityReference
    pieces: Tensor
    rate: float


def mimu_pieces(path: Path) -> tuple[list[Tensor], float]:
    """Pieces at rest `(piece, axis, sensor, time)` in deg/s of every experiment."""
    data = np.load(path)
    front_of_back = np.array([[0, -1, 0], [-1, 0, 0], [0, 0, -1]])
    experiments = []
    for key in (f"exp{k}" for k in range(1, 6)):
        gyro = data[key][:, :, 3:] * data["scale"][3:]  # (time, device, axis)
        gyro[:, 1::2] = gyro[:, 1::2] @ front_of_back.T
        blocks = gyro.mean(1)[: len(gyro) // 32 * 32].reshape(-1, 32, 3)
        restless = blocks.std(1).max(-1)
        still = np.flatnonzero(restless < 3 * np.median(restless))
        runs = [run for run in np.split(still, np.flatnonzero(np.diff(still) > 1) + 1) if len(run) >= 42]
        pieces = [gyro[32 * (run[0] + 2) :][:1216].transpose(2, 1, 0) for run in runs[:20]]
        experiments.append(torch.from_numpy(np.stack(pieces)))
    return experiments, float(data["fs"])


def mimu_sessions(path: Path, window: int, n_pieces: int) -> list[Session]:
    experiments, rate = mimu_pieces(path)
    return [Session(fit_parity_reference(list(e[:10]), window), e[10 : 10 + n_pieces], rate) for e in experiments]


def mimu_other_sessions(path: Path, window: int, extra_sd: float) -> list[Session]:
    """The same with the reference from the other experiments."""
    experiments, rate = mimu_pieces(path)
    return [
        Session(
            fit_parity_reference([*torch.cat(experiments[:k] + experiments[k + 1 :])], window, extra_sd=extra_sd),
            e,
            rate,
        )
        for k, e in enumerate(experiments)
    ]


def xsens_sessions(path: Path, window: int, n_pieces: int) -> list[Session]:
    """The first half as reference for the second, and the other way round."""
    data = np.load(path)
    gyro = torch.from_numpy(data["data"][:, :3].astype(float)).transpose(0, 1)  # (axis, device, time)
    gyro = torch.where(gyro.isfinite(), gyro, torch.nan)
    half, length = gyro.shape[-1] // 2, 4 * window
    sessions = []
    for healthy, rest in ((gyro[..., :half], gyro[..., half:]), (gyro[..., half:], gyro[..., :half])):
        pieces = rest[..., : rest.shape[-1] // length * length].unflatten(-1, (-1, length)).movedim(-2, 0)
        sessions.append(Session(fit_parity_reference(healthy, window), pieces[:n_pieces], float(data["fs"])))
    return sessions


def simulated_sessions(window: int, n_pieces: int) -> list[Session]:
    walk = torch.tensor([2.0, 4.0, 30.0, 18.0, 5.0, 21.0], dtype=torch.float64) * 1e-6
    white = torch.tensor([2.8, 2.0, 1.4, 1.1, 1.1, 2.5], dtype=torch.float64)
    array = gf.ArrayModel([(gf.WhiteNoise(1.0), white.diag()), (gf.RandomWalk(1.0), walk.diag())])
    signal = array.simulate(12_000 + 4 * window * n_pieces, generator=torch.Generator().manual_seed(1))
    pieces = signal[:, 12_000:].unflatten(-1, (n_pieces, -1)).movedim(-2, 0)
    return [Session(fit_parity_reference(signal[:, :12_000], window), pieces, 50.0)]


def inject(pieces: Tensor, kind: str, strength: float, sensor: int, session: Session, window: int) -> Tensor:
    """Copies of the pieces in which `sensor` has a fault from window `ONSET` on."""
    signal = pieces.clone()
    time = torch.arange(pieces.shape[-1], dtype=torch.float64)
    onset = ONSET * window
    variance = session.reference.wavelet_cross_covariance[..., 0, sensor, sensor]
    size = strength * (2 * variance).sqrt().unsqueeze(-1)
    faulty = signal[..., sensor, onset:]
    if kind == "frozen":
        stop = round(strength * window)
        faulty[..., :stop] = faulty[..., :1]
    elif kind == "biased":
        faulty += size
    elif kind == "drifting":
        faulty += size * (time[onset:] - onset) / window
    elif kind == "noisier":
        noise = torch.randn(faulty.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(sensor))
        faulty += size * noise
    else:
        # Without its bias, which would give a turned sign away at rest.
        signal -= signal[..., :onset].nanmean(-1, keepdim=True)
        signal += (size * torch.sin(2 * torch.pi * time / session.rate)).unsqueeze(-2)
        signal[..., sensor, onset:] *= -1
    return signal


def rates(sessions: list[Session], kind: str, window: int, every: int) -> np.ndarray:
    """Share of runs detected, named and told, `(strength, 3)`, over `every` so many sensors, pieces, axes, sessions."""
    outcomes = []
    for session in sessions:
        for sensor in range(0, session.pieces.shape[-2], every):
            runs = [inject(session.pieces, kind, size, sensor, session, window) for size in STRENGTHS[kind]]
            result = parity_test(torch.stack(runs), session.reference, false_alarm=FALSE_ALARM)
            after = slice(ONSET, None)
            detected = result.alarm[..., after].any(-1)
            guilty = result.faulty[..., after, :].any(-2)  # (strength, ..., sensor)
            named = guilty[..., sensor] & (guilty.sum(-1) == 1)
            p_values = torch.where(result.faulty[..., sensor], result.p_values[..., sensor], 2.0)[..., after]
            clearest = p_values.argmin(-1, keepdim=True)
            kinds = result.kind[..., after, sensor].gather(-1, clearest).squeeze(-1)
            told = named & (kinds == KINDS.index(kind))
            outcomes.append(torch.stack([detected, named, told], -1).flatten(1, -2).double())
    return torch.cat(outcomes, 1).mean(1).numpy()


def false_alarms(sessions: list[Session]) -> tuple[int, int]:
    """Windows with an alarm, and windows."""
    alarms = [parity_test(s.pieces, s.reference, false_alarm=FALSE_ALARM).alarm for s in sessions]
    return sum(int(a.sum()) for a in alarms), sum(a.numel() for a in alarms)


def report_false_alarms(name: str, sessions: list[Session]) -> None:
    count, total = false_alarms(sessions)
    interval = stats.binomtest(count, total).proportion_ci(method="exact")
    print(
        f"  {name:<50} {count:>4} of {total:>5} windows: {100 * count / total:5.2f} % "
        f"[{100 * interval.low:.2f}, {100 * interval.high:.2f}], stated {100 * FALSE_ALARM:g} %"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--quick", action="store_true", help="every third sensor, fewer runs")
    parser.add_argument("--out", type=Path, default=Path("faults.png"), help="where the figure goes")
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    n_pieces = 1 if arguments.quick else 5

    arrays: dict[str, tuple[list[Session], int]] = {}
    print("False alarms on untouched recordings, 95 % interval:")
    if arguments.data is None:
        print("  (no folder of recordings given: a simulated array stands in)")
        report_false_alarms("simulated, 6 sensors", simulated_sessions(256, 40 if arguments.quick else 400))
        arrays["simulated, 6 sensors"] = (simulated_sessions(256, 2 * n_pieces), 256)
    else:
        mimu, xsens = arguments.data / "mimu4444_8imu.npz", arguments.data / "xsensdot10_static.npz"
        report_false_alarms("MIMU4444, rest of the same session", mimu_sessions(mimu, 256, 10))
        for extra in (0.0, 0.3):
            allowed = ", extra spread 0.3" if extra else ""
            for k, session in enumerate(mimu_other_sessions(mimu, 256, extra), 1):
                report_false_alarms(f"MIMU4444, session {k} against others{allowed}", [session])
        report_false_alarms("Xsens DOT, the other half", xsens_sessions(xsens, 256, 100))
        sessions = mimu_sessions(mimu, 256, n_pieces)
        arrays["MIMU4444, 8 sensors"] = (sessions[2:3] if arguments.quick else sessions, 256)
        arrays["Xsens DOT, 10 sensors"] = (xsens_sessions(xsens, 256, n_pieces)[: 1 if arguments.quick else 2], 256)

    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(11, 6.4), sharey=True, layout="constrained")
    unit = {"frozen": "windows frozen", "drifting": "drift over a window / noise", "sign-flipped": "rotation / noise"}
    for kind, ax in zip(STRENGTHS, axes.flat, strict=False):
        print(f"\n{kind}: share of runs detected, named, told")
        print(f"{'strength':>10}  " + "  ".join(f"{name:>24}" for name in arrays))
        curves = {
            name: rates(sessions, kind, window, 3 if arguments.quick else 1)
            for name, (sessions, window) in arrays.items()
        }
        for k, strength in enumerate(STRENGTHS[kind]):
            columns = ("  ".join(f"{value:6.3f}" for value in curve[k]) for curve in curves.values())
            print(f"{strength:>10.3f}  " + "  ".join(f"{column:>24}" for column in columns))
        for (name, curve), colour in zip(curves.items(), ("#0072b2", "#d55e00"), strict=False):
            for column, (what, style) in enumerate((("detected", "-"), ("named", "--"), ("told", ":"))):
                ax.semilogx(STRENGTHS[kind], curve[:, column], style, color=colour, label=f"{name}: {what}")
        ax.set(title=kind, xlabel=unit.get(kind, "size / noise"), ylim=(-0.02, 1.02))
        ax.grid(color="#e3e3e3")
    axes[0, 0].set_ylabel("share of runs")
    axes[1, 0].set_ylabel("share of runs")
    axes[1, 2].axis("off")
    axes[1, 2].legend(*axes[0, 0].get_legend_handles_labels(), loc="center", frameon=False)
    figure.savefig(arguments.out, dpi=120)
    print(f"\nThe curves are in {arguments.out}.")


if __name__ == "__main__":
    main()
