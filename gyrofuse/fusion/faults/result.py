"""Result of the parity test: faulty sensors with the kind of fault and the time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from gyrofuse._base.results import Result, numbered, plain
from gyrofuse.fusion.faults.classify import KINDS

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Fault(NamedTuple):
    """A fault of one sensor, over windows that follow each other.

    Attributes:
        sensor: Its name.
        kind: One of `KINDS`.
        item: Index of the batch item, `()` without a batch.
        start: Begin of the first window, seconds or samples.
        stop: End of the last window.
        tau: Averaging time at which the fault shows most, seconds or samples.
        size: Step (signal), slope (signal per second or sample), or factor on the standard deviation of the difference
            from the other sensors; NaN for other kinds.
        p_value: Smallest p-value of the windows, adjusted for all tests of a window.
        sentence: The fault in words.
    """

    sensor: str
    kind: str
    item: tuple[int, ...]
    start: float
    stop: float
    tau: float
    size: float
    p_value: float
    sentence: str


@dataclass(frozen=True, eq=False)
class ParityResult(Result):
    """Outcome of a parity test, batched over `(..., window)`.

    Attributes:
        faulty: `(..., window, sensor)`, bool, the isolated sensors.
        kind: `(..., window, sensor)`, index of `KINDS`, -1 where the sensor is not isolated.
        level: `(..., window, sensor)`, from 0, at which the fault shows most; -1 likewise.
        statistic: `(..., window, sensor)`, energy at that level in units of that of a nominal array; NaN likewise.
        size: `(..., window, sensor)`, as in `Fault`, per sample.
        p_values: `(..., window, sensor)`, adjusted for all tests of a window; for a sensor that is not isolated, in the
            array without the isolated ones.
        p_value: `(..., window)`, p-value of the array.
        tested: `(..., window, sensor)`, whether a sensor was tested at one level at least; where it was not, for want
            of samples, its `p_values` are 1.
        window: Samples of a window.
        false_alarm: Stated probability of an alarm in a window of a nominal array.
        sensors: Name of each sensor.
        axes: Names along the leading dimension, empty when it has none.
        rate: Sampling rate in Hz, when known.
        unit: Unit of the signal, when known.
    """

    faulty: Tensor
    kind: Tensor
    level: Tensor
    statistic: Tensor
    size: Tensor
    p_values: Tensor
    p_value: Tensor
    tested: Tensor
    window: int
    false_alarm: float
    sensors: tuple[str, ...]
    axes: tuple[str, ...] = ()
    rate: float | None = None
    unit: str | None = None
    _batched = ("faulty", "kind", "level", "statistic", "size", "p_values", "p_value", "tested")
    _contents = tuple("sensors axes rate unit window false_alarm start alarm p_value p_values faulty tested".split())

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions before `window`; `()` for a single array."""
        return tuple(self.p_value.shape[:-1])

    def __getitem__(self, index: Any) -> ParityResult:
        """One item, or some, of the leading batch dimensions."""
        return replace(super().__getitem__(index), axes=())

    @property
    def alarm(self) -> Tensor:
        """Windows `(..., window)` whose p-value is below `false_alarm`."""
        return self.p_value < self.false_alarm

    @property
    def start(self) -> Tensor:
        """Begin of each window, `(window,)`; seconds, or samples without a rate."""
        return torch.arange(self.p_value.shape[-1], dtype=torch.float64) * self.window / (self.rate or 1.0)

    @property
    def faults(self) -> list[Fault]:
        """All faults; consecutive windows of the same sensor and kind are one fault."""
        found = []
        kind = self.kind.movedim(-1, -2)  # (..., sensor, window)
        same = kind[..., 1:] == kind[..., :-1]
        isolated = kind >= 0
        begins = isolated & ~torch.nn.functional.pad(same & isolated[..., 1:], (1, 0))
        ends = isolated & ~torch.nn.functional.pad(same & isolated[..., 1:], (0, 1))
        for first, last in zip(begins.nonzero().tolist(), ends.nonzero().tolist(), strict=True):
            found.append(self._fault(tuple(first[:-2]), first[-2], first[-1], last[-1]))
        return found

    def _fault(self, item: tuple[int, ...], sensor: int, first: int, last: int) -> Fault:
        here: Any = (*item, slice(first, last + 1), sensor)
        p_values = self.p_values[here]
        best = int(p_values.argmin())
        kind = KINDS[int(self.kind[here][best])]
        size, ratio = self.size[here][best].item(), self.statistic[here][best].item()
        second = 1 / (self.rate or 1.0)
        size = size / second if kind == "drifting" else size
        start, stop = first * self.window * second, (last + 1) * self.window * second
        tau = 2.0 ** int(self.level[here][best]) * second
        time, unit = "s" if self.rate else "samples", self.unit or "signal"
        times = math.sqrt(max(ratio, 0.0))
        what = {
            "frozen": f"is frozen: it varies {100 * times:.2g} % of what it should",
            "quieter": f"is quieter: it varies {100 * times:.2g} % of what it should",
            "biased": f"is biased: it steps by {size:+.3g} {unit} against the others",
            "drifting": f"drifts by {size:+.3g} {unit} per {'second' if self.rate else 'sample'} against the others",
            "noisier": f"is noisier: its difference from the others varies {times:.3g} times as much",
            "sign-flipped": "has its sign flipped: turned back, it agrees with the others",
        }[kind]
        where = f"[{self._item(item)}] " if item else ""
        p = p_values[best].item()
        chance = f"p = {p:.1g}" if p > 0 else "p < 1e-300"
        sentence = (
            f"{where}Sensor {self.sensors[sensor]} {what}; seen from {start:.6g} to {stop:.6g} {time}, "
            f"most at {tau:.4g} {time} ({chance})."
        )
        return Fault(self.sensors[sensor], kind, item, start, stop, tau, size, p, sentence)

    def _item(self, item: tuple[int, ...]) -> str:
        return self.axes[item[0]] if self.axes and len(item) == 1 else ", ".join(map(str, item))

    def summary(self) -> str:
        """The faults and the untested windows, in sentences."""
        n_windows = self.p_value.numel()
        seconds = f" ({self.window / self.rate:.6g} s)" if self.rate else ""
        lines = [
            f"Parity test of {len(self.sensors)} sensors, {n_windows} windows of {self.window} samples{seconds}, "
            f"false alarms in {100 * self.false_alarm:g} % of them at most"
        ]
        faults = self.faults
        lines += [f"- {fault.sentence}" for fault in faults[:20]]
        if len(faults) > 20:
            lines.append(f"- ... and {len(faults) - 20} more")
        n_detected = int((self.alarm & ~self.faulty.any(-1)).sum())
        if n_detected:
            lines.append(f"- In {n_detected} window(s) two sensors disagree; it takes a third to tell which is wrong.")
        untested = self._untested()
        if not faults and not n_detected:
            where = ", as far as they were tested" if untested else ""
            lines.append(f"- No sensor stands out{where} (smallest p = {self.p_value.min().item():.2g}).")
        lines += [f"- {gap}" for gap in untested[:20]]
        if len(untested) > 20:
            lines.append(f"- ... and {len(untested) - 20} more not tested")
        return "\n".join(lines)

    def _untested(self) -> list[str]:
        """Sensors and windows that could not be tested, in words; sensors with the same windows in one sentence."""
        missing = ~self.tested.movedim(-1, -2).cpu()  # (..., sensor, window)
        gaps: dict[tuple[tuple[int, ...], tuple[int, ...]], list[int]] = {}
        for *item, sensor in missing.any(-1).nonzero().tolist():
            here: Any = (*item, sensor)
            windows = tuple(missing[here].nonzero().flatten().tolist())
            gaps.setdefault((tuple(item), windows), []).append(sensor)
        return [self._gap(item, sensors, list(windows)) for (item, windows), sensors in gaps.items()]

    def _gap(self, item: tuple[int, ...], sensors: list[int], windows: list[int]) -> str:
        second = 1 / (self.rate or 1.0)
        runs: list[list[int]] = []
        for window in windows:
            if runs and window == runs[-1][1] + 1:
                runs[-1][1] = window
            else:
                runs.append([window, window])
        numbers = [f"{first + 1}" if first == last else f"{first + 1} to {last + 1}" for first, last in runs]
        edges = [(first * self.window * second, (last + 1) * self.window * second) for first, last in runs]
        times = [f"{start:.6g} to {stop:.6g}" for start, stop in edges]
        n_windows, more = self.p_value.shape[-1], f" and {len(runs) - 5} more" if len(runs) > 5 else ""
        when = "in any window"
        if len(windows) < n_windows:
            when = (
                f"in window{'s' if len(windows) > 1 else ''} {', '.join(numbers[:5])}{more} of {n_windows} "
                f"({', '.join(times[:5])}{more} {'s' if self.rate else 'samples'})"
            )
        who = f"sensor{'s' if len(sensors) > 1 else ''} {', '.join(self.sensors[i] for i in sensors)}"
        if len(sensors) == len(self.sensors):
            who = "all sensors"
        return f"{f'[{self._item(item)}] ' if item else ''}Not tested: {who} {when}; too few samples to compare."

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain lists and numbers, ready for JSON (NaN as None)."""
        return super().to_dict() | {"faults": [plain(fault._asdict()) for fault in self.faults]}

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draw the p-value of each sensor over time; windows with a fault are outlined, untested windows are blue.

        Args:
            ax: Where to draw; new axes by default.

        Returns:
            The axes.

        Raises:
            ValueError: The result holds a batch.
        """
        import matplotlib.pyplot as plt

        if self.batch_shape:
            raise ValueError(f"expected one array to plot, got a batch {self.batch_shape}; index the result, result[0]")
        if ax is None:
            ax = plt.subplots(figsize=(7.0, 3.2), layout="constrained")[1]
        strength = -self.p_values.clamp(min=1e-12).log10()
        strength = torch.where(self.tested, strength, torch.nan).cpu().numpy().T  # (sensor, window)
        edges = [*self.start.tolist(), self.p_value.shape[-1] * self.window / (self.rate or 1.0)]
        rows = [i - 0.5 for i in range(len(self.sensors) + 1)]
        ax.set_facecolor("#cfe3ef")  # shows where there is no value
        image = ax.pcolormesh(edges, rows, strength, cmap="Greys", vmin=0, vmax=12)
        for window, sensor in self.faulty.nonzero().tolist():
            width = edges[window + 1] - edges[window]
            ax.add_patch(plt.Rectangle((edges[window], sensor - 0.5), width, 1, fill=False, edgecolor="#d55e00"))
        ax.set_yticks(range(len(self.sensors)), self.sensors or numbered(len(self.sensors)))
        ax.invert_yaxis()
        ax.set(xlabel="time (s)" if self.rate else "time (samples)", ylabel="sensor")
        ax.figure.colorbar(image, ax=ax, label="-log10 of the adjusted p-value")
        return ax
