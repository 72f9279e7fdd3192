"""Motion: the device is handled, or knocked over, in a part of a recording that is taken for one at rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.detectors.variance.handling import handled
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.mechanisms.transients.transient import Transient, held_out_sums, in_fours, kept_of
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims

Span = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Motion(Transient):
    """From `start` to `stop` the device moves, smoothly and by amounts that nothing predicts.

    What was measured then is no matter of noise: samples of a quiet part nearby stand in its place. A simulation gets
    normal motion of the same covariance and smoothness.

    Attributes:
        start_s, stop_s: Of what is left out, s after the first sample, `(stretch,)`; the most conspicuous is the first.
        root: Root of the covariance of the motion, unit of the signal, `(stretch, sensor, sensor)`.
        louder: Covariance of whitened samples there, which is one at rest, `(stretch, sensor, sensor)`.
        smooth_s: Standard deviation of the kernel that makes white noise as smooth, s, `(stretch,)`.
    """

    name: ClassVar[str] = "motion"
    separated_by: ClassVar[str] = "accelerometers, a camera, or whoever was there"
    happened_once: ClassVar[bool] = True
    start_s: Annotated[Tensor, Dims(("stretch",))]
    stop_s: Annotated[Tensor, Dims(("stretch",))]
    root: Annotated[Tensor, Dims(("stretch", "sensor", "sensor"))]
    louder: Annotated[Tensor, Dims(("stretch", "sensor", "sensor"))]
    smooth_s: Annotated[Tensor, Dims(("stretch",))]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        stretches = sorted(handled(comparison), key=lambda one: -one.log_ratio)
        if not stretches:
            return None
        n, info, seen = comparison.n_samples, comparison.info, stretches[0]
        gain = sum(one.log_ratio for one in stretches)
        p_value = min(1.0, (n / seen.cell) ** 2 * math.exp(-min(seen.log_ratio, 700.0)))
        if p_value > level:
            return None
        # It begins and ends gently: what is left of it would be something that decays.
        margins = [(one.end - one.first) // 4 for one in stretches]
        spans = [(max(s.first - m, 0), min(s.end + m, n)) for s, m in zip(stretches, margins, strict=True)]
        effect = cls.fitted_to(comparison, spans, torch.ones(n, dtype=torch.bool))
        # It begins and ends somewhere in the outermost cells, which a mean over three of them reaches over.
        inside, reach = 1.5 * seen.cell / info.rate, 2 * seen.cell / info.rate + 2 * float(effect.smooth_s[0])
        start, stop = seen.first / info.rate + inside, seen.end / info.rate - inside
        parameters = {
            "start": Parameter.around(start, reach, "s", least=0.0),
            "stop": Parameter.around(stop, reach, "s", most=n / info.rate),
        }
        which = tuple(torch.stack([one.which for one in stretches]).any(0).nonzero()[:, 0].tolist())
        size = effect.root[0].square().sum(-1).sqrt()  # (sensor,)
        size = size * math.sqrt((spans[0][1] - spans[0][0]) / (seen.end - seen.first))  # over what was seen
        largest = max(which, key=lambda i: float(size[i]))
        free = max((stop - start) / (4 * float(effect.smooth_s[0])), 4.0)  # of values that are independent
        for i in which:
            value = float(size[i])
            spread = math.exp(2 / math.sqrt(2 * free))
            parameters[f"rms[{i}]"] = Parameter.within(value, spread, info.measure)
        moves = "moves" if len(which) == 1 else "move together"
        others = len(stretches) - 1
        more = f", and {others} more time{'s' if others > 1 else ''}" if others else ""
        return effect.found(
            f"the device is not at rest: {info.named(which, 'all sensors')} {moves} from {start:.4g} s to "
            f"{stop:.4g} s{more}, by up to {float(size[largest]):.3g} {info.measure} rms (sensor "
            f"{info.sensors[largest]}); leave that part out, or give what moves it as a channel",
            p_value,
            which,
            parameters,
            levels=(level_of(min(0.1 / (float(effect.smooth_s[0]) * info.rate), 0.5)),),
            time_s=start,
            gain=gain,
        )

    @classmethod
    def fitted_to(cls, comparison: Comparison, spans: Sequence[Span], keep: Tensor) -> Motion:
        """Motion in some spans of samples, of those to keep."""
        rate, roots, louder, smooth = comparison.info.rate, list[Tensor](), list[Tensor](), list[float]()
        tiny = 1e-9 * torch.eye(comparison.n_sensors, dtype=torch.float64)
        noise = comparison.base.spectrum(torch.tensor([0.5], dtype=torch.float64))[:, 0]  # of single samples
        for first, end in spans:
            kept = keep[first:end]
            moved = comparison.recording[:, first:end]
            moved = moved - torch.lerp(moved[:, :1], moved[:, -1:], torch.linspace(0, 1, end - first).to(moved))
            own, white = moved[:, kept], comparison.white[:, first:end][:, kept]
            covariance = own @ own.mT / own.shape[-1]
            roots.append(torch.linalg.cholesky(covariance + tiny * covariance.trace()))
            louder.append(white @ white.mT / white.shape[-1] + tiny)
            change = (moved.diff().square().mean(-1) - 2 * noise).clamp(min=0).sum()
            # Of a normal kernel: the mean square of changes over that of values is 1 / (2 sd^2).
            smooth.append(
                float((covariance.trace() / (2 * change).clamp(min=1e-300)).sqrt().clamp(1, (end - first) / 8))
            )
        start, stop = (torch.tensor(x, dtype=torch.float64) / rate for x in zip(*spans, strict=True))
        return cls(
            start, stop, torch.stack(roots), torch.stack(louder), torch.tensor(smooth, dtype=torch.float64) / rate
        )

    def fit_without(self, comparison: Comparison, fold: int) -> Motion:
        spans = self._spans(comparison.n_samples, comparison.info.rate)
        return self.fitted_to(comparison, spans, kept_of(comparison.n_samples, fold))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        gains = torch.zeros(comparison.n_samples, dtype=torch.float64)
        for (first, end), louder in zip(self._spans(len(gains), comparison.info.rate), self.louder, strict=True):
            white = comparison.white[:, first:end]
            explained = (white * torch.linalg.solve(louder, white)).sum(0)
            gains[first:end] = (white.square().sum(0) - explained - torch.logdet(louder)) / 2
        return in_fours(held_out_sums(gains, fold))

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        first, end = self._spans(comparison.n_samples, comparison.info.rate)[0]
        around = (end - first) // 2
        pictures.transient(ax, comparison, sensor, first - around, end - first + 2 * around, None)

    def drawn(self, n_samples: int, rate: float, generator: torch.Generator) -> Tensor:
        path = torch.zeros(self.root.shape[-1], n_samples, dtype=torch.float64)
        for (first, end), root, smooth in zip(
            self._spans(n_samples, rate), self.root, (self.smooth_s * rate).tolist(), strict=True
        ):
            if first == end:
                continue
            reach = math.ceil(4 * smooth)
            kernel = (-(torch.arange(-reach, reach + 1, dtype=torch.float64) / smooth).square() / 2).exp()
            noise = torch.randn(len(root), end - first + 2 * reach, generator=generator, dtype=torch.float64)
            moved = torch.nn.functional.conv1d(noise[:, None], (kernel / kernel.norm())[None, None])[:, 0]
            path[:, first:end] = root @ moved
        return path

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        """Signals with samples of a quiet part in the place of those that moved, level with what is around."""
        n, out = signal.shape[-1], signal.clone()
        spans = self._spans(n, info.rate)
        for first, end in spans:
            at = _quiet(spans, first, end, n)
            if at is None or first == end:
                continue
            quiet = signal[..., at : at + end - first]
            around = max(min(64, (end - first) // 4), 1)  # samples that tell a level
            levels = [signal[..., max(first - around, 0) : first], signal[..., end : end + around]]
            levels = [level for level in levels if level.shape[-1]] or [quiet]
            ends = (quiet[..., :around], quiet[..., -around:])
            shifts = [
                levels[k].mean(-1, keepdim=True) - own.mean(-1, keepdim=True)
                for k, own in zip((0, -1), ends, strict=True)
            ]
            # Where levels agree, samples stay as they are, on the lattice of numbers that they have.
            same = [
                s.abs() < 3 * own.std(-1, keepdim=True) / math.sqrt(around) for s, own in zip(shifts, ends, strict=True)
            ]
            shifts = [torch.where(same[0] & same[1], 0.0, shift) for shift in shifts]
            course = torch.linspace(0, 1, end - first, dtype=signal.dtype)
            out[..., first:end] = quiet + torch.lerp(shifts[0], shifts[1], course)
        return out

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        return comparison.with_recording(self.remove(comparison.recording, comparison.info))

    def apply_elsewhere(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """Another recording is at rest, or moves in its own way."""
        return comparison

    def _spans(self, n_samples: int, rate: float) -> list[Span]:
        """Samples of each stretch, as far as a record goes."""
        ends = torch.stack([self.start_s, self.stop_s]).mul(rate).round().clamp(0, n_samples).long()
        return [(first, end) for first, end in ends.mT.tolist()]


def _quiet(spans: Sequence[Span], first: int, end: int, n: int) -> int | None:
    """First sample of a part as long as a span, near it, that no span is in; None where there is none."""
    length = end - first
    step = max(length // 8, 1)
    starts = sorted(range(0, n - length + 1, step), key=lambda at: abs(at - first))
    for at in [end, first - length, *starts]:
        if 0 <= at <= n - length and all(at + length <= a or at >= b for a, b in spans):
            return at
    return None
