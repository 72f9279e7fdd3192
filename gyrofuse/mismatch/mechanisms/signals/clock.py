"""A clock of its own: sensors that sample at another rate than the others, or lose samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.lines.clocks import SIMULATION, strongest_slip
from gyrofuse.mismatch.detectors.lines.demodulation import BLOCKS, best_slope, demodulated
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.filters import resampled
from gyrofuse.mismatch.signals.folds import estimation_samples, held_out_blocks
from gyrofuse.mismatch.stats.limits import Z

_MILLION = 1e6
_BLOCKS_AROUND = 3  # around each loss that are searched


@dataclass(frozen=True, eq=False)
class ClockSkew(Mechanism):
    """`x_i(t) = y_i((1 + skew) t + lost(t))` for some sensors `i`, `y_i` with the clock of the others, `t` in samples.

    A slope or steps in the phase of a tone that all feel. Of noise alone, which has no common clock, it changes nothing
    that could be seen.

    Attributes:
        sensors: Positions of those sensors.
        skew: What they are ahead per sample.
        losses: First sample after each loss, and how many samples were lost, in the order of time.
        frequency: Of the tone that shows it, cycles per sample.
        slipping, steady: Amplitudes of the tone with and without the slip, complex, `(sensor concerned,)`, in units of
            the noise.
    """

    name: ClassVar[str] = "clock_skew"
    separated_by: ClassVar[str] = "timestamps of each sensor, or a known motion that all of them feel"
    likelihood: ClassVar[str] = "known paths"
    additive: ClassVar[bool] = True
    sensors: tuple[int, ...]
    skew: float
    losses: tuple[tuple[int, int], ...]
    frequency: float
    slipping: Annotated[Tensor, Dims(("sensor concerned",), complex=True)]
    steady: Annotated[Tensor, Dims(("sensor concerned",), complex=True)]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        slip = strongest_slip(comparison)
        if slip is None or slip.p_value > level:
            return None
        rate, info = comparison.info.rate, comparison.info
        none = torch.zeros(len(slip.sensors), dtype=torch.complex128)
        losses = tuple((loss.at, loss.count) for loss in slip.losses)
        effect = cls(slip.sensors, slip.skew, losses, slip.frequency, none, none)
        everywhere = torch.ones(comparison.n_samples, dtype=torch.bool)
        effect = effect._fitted(comparison, everywhere)
        limits = [loss.at_limits for loss in slip.losses]
        span: tuple[int, int] | None = slip.lost
        rounds, further = 2, 3  # times and amplitudes in turns; looks for more losses behind those that were found
        for _ in range(rounds if losses else 0):
            effect, limits = effect._placed(comparison)
            effect = effect._fitted(comparison, everywhere)
        for _ in range(further if losses else 0):
            more = effect._with_what_is_left(comparison, level)
            if more is None:
                break
            effect, limits = more._placed(comparison)
            span = None
        losses = effect.losses
        who = info.named(slip.sensors, "all sensors")
        against = f"the tone at {slip.frequency * rate:.6g} Hz in "
        against += "the other sensors" if slip.reference is None else slip.reference
        if losses and slip.reference == SIMULATION:
            against = f"a tone at {slip.frequency * rate:.6g} Hz that keeps its phase"
        if losses:
            lost = sum(count for _, count in losses)
            counted = f"{lost} sample{'s' if lost > 1 else ''}"
            parameters = {"lost": Parameter(lost, *(span or (lost, lost)), "")}
            for j, ((at, _), (first, last)) in enumerate(zip(losses, limits, strict=True)):
                parameters[f"time_of_loss_{j + 1}"] = Parameter(at / rate, first / rate, last / rate, "s")
            times = ", ".join(f"{at / rate:.4g}" for at, _ in losses)
            sentence = (
                f"{who} lost {counted} against {against}: its phase steps at {times} s; whole periods of "
                f"the tone, {1 / slip.frequency:.4g} samples each, would leave no step"
            )
        else:
            reach = Z * slip.skew_sd
            parameters = {
                "skew": Parameter(
                    _MILLION * slip.skew, _MILLION * (slip.skew - reach), _MILLION * (slip.skew + reach), "ppm"
                )
            }
            sentence = f"the clock of {who} differs by {_MILLION * slip.skew:.3g} ppm from {against}: its phase slips"
            if slip.reference == SIMULATION:
                sentence = (
                    f"the simulation's tone at {slip.frequency * rate:.6g} Hz is at "
                    f"{slip.frequency * (1 + slip.skew) * rate:.8g} Hz in {who}: their clock differs by "
                    f"{_MILLION * slip.skew:.3g} ppm, or the frequency of the tone"
                )
        return effect.found(
            sentence,
            slip.p_value,
            slip.sensors,
            parameters,
            levels=(level_of(slip.frequency),),
            frequency_hz=slip.frequency * rate,
            time_s=losses[0][0] / rate if losses else None,
            channel=None if slip.reference == SIMULATION else slip.reference,
            alternatives=("vibration_tone",) if slip.reference == SIMULATION and not losses else (),
            gain=slip.gain,
        )

    def _fitted(self, comparison: Comparison, keep: Tensor) -> ClockSkew:
        """Amplitudes with and without the slip, least squares on the samples to keep."""
        signal = comparison.white[list(self.sensors)] * keep
        turned = [self._carrier(comparison.n_samples, slips) for slips in (True, False)]
        # Over many cycles the two quadratures are orthogonal.
        slipping, steady = ((2 * signal.to(carrier.dtype) @ carrier.conj()) / keep.sum() for carrier in turned)
        return replace(self, slipping=slipping, steady=steady)

    def _placed(self, comparison: Comparison) -> tuple[ClockSkew, list[tuple[int, int]]]:
        """Losses at the sample that suits the tone best, each between the blocks around it, and limits of each.

        Until a loss the tone is what it was, from there on what it turns to: a loud tone places it to a sample.
        """
        losses, limits, as_good = list(self.losses), [], 2.0  # nats: 95 % limits of a likelihood ratio
        reach = _BLOCKS_AROUND * (comparison.n_samples // BLOCKS)
        for j, (at, count) in enumerate(losses):
            low = max(at - reach, losses[j - 1][0] + 1 if j else 1)
            high = min(at + reach, losses[j + 1][0] - 1 if j + 1 < len(losses) else comparison.n_samples - 1)
            if low >= high:  # no sample is left between those next to it
                limits.append((at, at))
                continue
            t = torch.arange(low, high, dtype=torch.float64)
            ahead = float(sum(lost for _, lost in losses[:j]))
            turn = 2 * math.pi * self.frequency * (t + ahead)
            before, after = (
                (self.slipping[:, None] * torch.polar(torch.ones_like(t), turn + extra)).real
                for extra in (0.0, 2 * math.pi * self.frequency * count)
            )
            signal = comparison.white[list(self.sensors), low:high]
            gain = (signal * (before - after) - (before.square() - after.square()) / 2).sum(0).cumsum(0)
            gain = torch.nn.functional.pad(gain, (1, 0))  # of a loss before each sample from `low` to `high`
            likely = (gain >= gain.amax() - as_good).nonzero()[:, 0]
            losses[j] = low + int(gain.argmax()), count
            limits.append((low + int(likely[0]), low + int(likely[-1])))
        return replace(self, losses=tuple(losses)), limits

    def _with_what_is_left(self, comparison: Comparison, level: float) -> ClockSkew | None:
        """With the losses that show once these are made room for; None where none do, or the tone is no more in phase.

        A loss next to one that is known says that more were lost there.
        """
        slip = strongest_slip(comparison.with_recording(self.remove(comparison.recording, comparison.info)))
        if slip is None or slip.p_value > level or not slip.losses or slip.sensors != self.sensors:
            return None
        losses, near = dict(self.losses), _BLOCKS_AROUND * (comparison.n_samples // BLOCKS)
        for loss in slip.losses:
            at = loss.at - sum(count for start, count in self.losses if start <= loss.at)
            known = min(losses, key=lambda start: abs(start - at))
            at = known if abs(known - at) <= near else max(at, 1)
            losses[at] = losses.get(at, 0) + loss.count
        more = replace(self, losses=tuple(sorted(losses.items())))
        more = more._fitted(comparison, torch.ones(comparison.n_samples, dtype=torch.bool))
        return more if float(more.slipping.abs().square().sum()) > float(self.slipping.abs().square().sum()) else None

    def fit_without(self, comparison: Comparison, fold: int) -> ClockSkew:
        keep = estimation_samples(comparison.n_samples, fold)
        if not self.skew:
            return self._fitted(comparison, keep)
        signal = comparison.white[list(self.sensors)] * keep
        slope, _ = best_slope(demodulated(signal, self.frequency))
        skew = slope / (self.frequency * (comparison.n_samples // BLOCKS * BLOCKS))
        return replace(self, skew=skew)._fitted(comparison, keep)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        signal = comparison.white[list(self.sensors)]
        scores = []
        for amplitude, slips in ((self.slipping, True), (self.steady, False)):
            tone = (amplitude[:, None] * self._carrier(comparison.n_samples, slips)).real
            scores.append(held_out_blocks(signal * tone - tone.square() / 2, fold).sum((0, -1)))
        return scores[0] - scores[1]

    def _carrier(self, n_samples: int, slips: bool) -> Tensor:
        """`exp(i phase)` of the tone, with the slip or without it, `(time,)`."""
        t = torch.arange(n_samples, dtype=torch.float64)
        phase = 2 * math.pi * self.frequency * (t + self._ahead(t) if slips else t)
        return torch.polar(torch.ones_like(phase), phase)

    def _ahead(self, t: Tensor) -> Tensor:
        """By how many samples the sensors are ahead at their sample `t`."""
        return self.skew * t + sum(count * (t >= at) for at, count in self.losses)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        rate = comparison.info.rate
        pictures.spectrum_near(ax, comparison, sensor, self.frequency * rate, rate / comparison.n_samples)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        t = torch.arange(signal.shape[-1], dtype=torch.float64)
        return self._with(signal, t + self._ahead(t))

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        n = signal.shape[-1]
        ends = [0, *(end for at, _ in self.losses for end in (at - 1, at) if 0 < at < n), n - 1]
        knots = torch.tensor(ends, dtype=torch.float64)
        true = knots + self._ahead(knots)
        t = torch.arange(n, dtype=torch.float64)
        piece = (torch.bucketize(t, true, right=True) - 1).clamp(0, len(knots) - 2)
        slope = (knots[piece + 1] - knots[piece]) / (true[piece + 1] - true[piece])
        return self._with(signal, knots[piece] + (t - true[piece]) * slope)

    def _with(self, signal: Tensor, times: Tensor) -> Tensor:
        """Signals with these sensors taken at other times, in samples."""
        which = list(self.sensors)
        changed = signal.clone()
        changed[..., which, :] = resampled(signal[..., which, :], times).to(signal.dtype)
        return changed

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """Lost samples are made room for; of a skew only the tone is put right: resampling would colour the noise."""
        if self.losses:
            return comparison.with_recording(self.remove(comparison.recording, comparison.info))
        slip = self._carrier(comparison.n_samples, slips=True) - self._carrier(comparison.n_samples, slips=False)
        taken = torch.zeros_like(comparison.recording)
        taken[list(self.sensors)] = (self.slipping[:, None] * slip).real
        density = comparison.base.spectrum(torch.tensor([self.frequency], dtype=torch.float64))
        return comparison.subtract(taken * density.sqrt())
