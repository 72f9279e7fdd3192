"""A stationary tone: a rotor, a fan, a pump."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from scipy import stats
from torch import Tensor

from gyrofuse._base.transforms import squared_modulus
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Parameter, Rival
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples
from gyrofuse.mismatch.signals.psd import hann_transform
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False)
class VibrationTone(Mechanism):
    """`x_i(t) = cosine_i cos(2 pi f t) + sine_i sin(2 pi f t)` in every sensor `i`.

    Samples at one rate `f_s` do not tell `f` from `k f_s - f` and `k f_s + f`.

    Attributes:
        frequency_hz: `f`, one for all sensors.
        cosine, sine: `(sensor,)`, unit of the signal; `t` counts from the first sample.
    """

    name: ClassVar[str] = "vibration_tone"
    rivals: ClassVar[tuple[str, ...]] = ("resonance",)
    replaced_by: ClassVar[tuple[str, ...]] = ("resonance", "drifting_tone")
    separated_by: ClassVar[str] = "a longer recording: the line gets as narrow as one over its length"
    additive: ClassVar[bool] = True
    frequency_hz: float
    cosine: OfSensors
    sine: OfSensors

    @property
    def amplitude(self) -> Tensor:
        """`(sensor,)`, unit of the signal."""
        return torch.hypot(self.cosine, self.sine)

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        line = comparison.line
        if line.p_value > level:
            return None
        tone = cls.at(comparison, line.frequency * comparison.info.rate)
        f = tone.frequency_hz / comparison.info.rate
        n, noise = comparison.n_samples, density_near(comparison, f)  # (sensor,)
        sd = (2 * noise / n).sqrt()
        snr = tone.amplitude / sd
        there = included_sensors(snr.square(), 2)
        present, seen = there.positions, math.sqrt(there.least)
        # Noise adds to the squares of amplitudes, but has no information on the frequency.
        energy = max(float((snr.square() - 2).clamp(min=0.0)[list(present)].sum()), 1.0)
        spread = math.hypot(math.sqrt(12 / energy) / (2 * math.pi * n), tone.wander(comparison, noise, energy))
        parameters = {"frequency": _limits(tone.frequency_hz, spread * comparison.info.rate, "Hz")}
        low, value, high = sd[list(present)] * amplitude_limits(snr[list(present)], seen)
        for row in zip(present, value.tolist(), low.tolist(), high.tolist(), strict=True):
            parameters[f"amplitude[{row[0]}]"] = Parameter(*row[1:], comparison.info.measure)
        largest = max(present, key=lambda i: parameters[f"amplitude[{i}]"].value)
        info = comparison.info
        where = info.named(present, "all sensors")
        return Finding(
            cls.name,
            tone,
            f"a tone at {tone.frequency_hz:.6g} Hz in {where}, of amplitude up to "
            f"{parameters[f'amplitude[{largest}]'].value:.3g} {info.measure} (sensor {info.sensors[largest]}), "
            f"that the simulation does not have; without a filter before sampling it may be one at "
            f"{info.rate - tone.frequency_hz:.6g}, {info.rate + tone.frequency_hz:.6g} .. Hz",
            line.p_value,
            present,
            parameters,
            levels=(level_of(f),),
            frequency_hz=tone.frequency_hz,
            gain=float(snr.square().sum()) / 2,
        )

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        """A tone at the highest ordinate of a peak."""
        width = finding.effect.line_width(finding.parameters, comparison)
        if width is None or finding.frequency_hz is None:
            return None
        rate = comparison.info.rate
        f = line_near(comparison, finding.frequency_hz / rate, 2 * width / rate)
        return Rival(cls.at(comparison, f * rate), finding.gain)

    def line_width(self, parameters: Mapping[str, Parameter], comparison: Comparison) -> float | None:
        limits = parameters["frequency"]
        return max((limits.high - limits.low) / 2, comparison.info.rate / comparison.n_samples)

    def wander(self, comparison: Comparison, noise: Tensor, energy: float) -> float:
        """Standard deviation that a phase which walks gives to the mean frequency, cycles per sample.

        The phases of `n` parts of the record have the covariance `q min(i, j)` of a walk beside that of the noise. What
        is left of them beside a straight line tells `q`: the variance is the mean over the values that it may have, in
        proportion to their likelihoods, with as much weight on none as on all others.

        Args:
            comparison: Recording and simulation.
            noise: Density of the noise near the tone, per sample `(sensor,)`.
            energy: Sum over sensors of the squared amplitudes in units of the variance that noise gives them.
        """
        fewest_parts, most_parts = 4, 32
        per_part = 20.0  # squared amplitude over its variance: a phase has a standard deviation of 0.2 rad in a part
        n_sizes, decades = 60, 4  # of walks, from a tenth of the noise's variance in the slowest mode on
        n = min(int(energy / per_part), most_parts)
        if n < fewest_parts:
            return 0.0
        length = comparison.n_samples // n
        angle = 2 * math.pi * self.frequency_hz * comparison.info.seconds(n * length)
        turned = comparison.recording[:, : n * length] * torch.polar(torch.ones_like(angle), -angle)
        weight = torch.complex(self.cosine, self.sine) / noise  # conjugates of the amplitudes
        phase = (weight @ turned.unflatten(-1, (n, length)).sum(-1)).angle()
        steps = torch.remainder(phase.diff() + math.pi, 2 * math.pi) - math.pi
        phase = torch.nn.functional.pad(steps.cumsum(0), (1, 0))
        place = torch.arange(n, dtype=torch.float64)
        walk = torch.minimum(place, place[:, None])
        slope = (place - place.mean()) / (place - place.mean()).square().sum()
        line = torch.stack([torch.ones_like(place) / math.sqrt(n), slope / slope.norm()])
        beside = torch.eye(n, dtype=torch.float64) - line.mT @ line
        values, vectors = torch.linalg.eigh(beside @ walk @ beside)
        values, left = values[2:], (vectors.mT @ phase)[2:]  # of a line itself there are two zeros
        own = n / energy  # variance of a phase by the noise
        sizes = own / values[-1] * torch.logspace(-1, decades, n_sizes, dtype=torch.float64)
        variance = torch.cat([torch.zeros(1, dtype=torch.float64), sizes])[:, None] * values + own
        log_likelihood = -(left.square() / variance + variance.log()).sum(-1) / 2
        log_likelihood[0] += math.log(n_sizes)
        expected = log_likelihood.softmax(0)[1:] @ sizes
        return math.sqrt(float(expected * (slope @ walk @ slope))) / (2 * math.pi * length)

    @classmethod
    def at(cls, comparison: Comparison, frequency_hz: float) -> VibrationTone:
        """The tone of all samples within half a bin of a frequency."""
        return cls.fitted_to(comparison, frequency_hz, torch.ones(comparison.n_samples, dtype=torch.bool))

    @classmethod
    def fitted_to(cls, comparison: Comparison, frequency_hz: float, keep: Tensor) -> VibrationTone:
        """Least squares with the noise near the tone as weights, starting within half a bin of the samples' span."""
        weights = 1 / density_near(comparison, frequency_hz / comparison.info.rate)
        t = torch.arange(comparison.n_samples, dtype=torch.float64)[keep]
        signal = comparison.recording[:, keep]
        signal = signal - signal.mean(-1, keepdim=True)
        span = float(t[-1] - t[0]) + 1
        omega, clock = 2 * math.pi * frequency_hz / comparison.info.rate, (t - t.mean()) / span
        for _ in range(6):
            angle = omega * t
            tone = torch.stack([angle.cos(), angle.sin()])
            basis = torch.cat([tone, clock * tone])
            gram, seen = basis @ basis.mT, basis @ signal.mT
            gram = gram + 1e-12 * gram.trace() * torch.eye(4, dtype=gram.dtype)  # next to half the rate sines vanish
            at = torch.linalg.solve(gram[:2, :2], seen[:2])  # (2, sensor)
            slope = torch.stack([at[1], -at[0]])  # of the phase, on the clock
            slope = torch.cat([-torch.linalg.solve(gram[:2, :2], gram[:2, 2:] @ slope), slope])  # (4, sensor)
            left = seen - gram[:, :2] @ at
            step = (weights * (slope * left).sum(0)).sum() / (weights * (slope * (gram @ slope)).sum(0)).sum()
            omega += float(step.clamp(-1.0, 1.0)) / span
        return cls(omega * comparison.info.rate / (2 * math.pi), at[0], at[1])

    def fit_without(self, comparison: Comparison, fold: int) -> VibrationTone:
        keep = estimation_samples(comparison.n_samples, fold)
        return self.fitted_to(comparison, self.frequency_hz, keep)

    def plot(self, comparison: Comparison, ax: Axes, *, sensor: int, fitted: bool) -> None:
        pictures.spectrum_near(ax, comparison, sensor, self.frequency_hz, comparison.info.rate / comparison.n_samples)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        turn = 2 * math.pi * torch.rand((), generator=generator, dtype=torch.float64)
        return signal + self._path(signal.shape[-1], info, float(turn))

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        return signal - self._path(signal.shape[-1], info)

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        return comparison.subtract(self._path(comparison.n_samples, comparison.info))

    def apply_elsewhere(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        """A line that the simulation has: its phase counts from when a record began."""
        built = self.apply_to_reference(comparison, generator)
        return built.knowing((*comparison.reference.lines, self.frequency_hz / comparison.info.rate))

    def _path(self, n_samples: int, info: RecordingInfo, turn: float = 0.0) -> Tensor:
        angle = 2 * math.pi * self.frequency_hz * info.seconds(n_samples) + turn
        return self.cosine[:, None] * angle.cos() + self.sine[:, None] * angle.sin()


def density_near(comparison: Comparison, f: float) -> Tensor:
    """Noise of the recording around a line, without the line itself, per sample `(sensor,)`."""
    power, length = _tapered_power(comparison.observed)
    reach, guard = 64, 3  # bins on either side that tell the noise, and those too near to
    apart = torch.cat([torch.arange(-reach, -guard), torch.arange(guard + 1, reach + 1)])
    places = f + apart / comparison.n_samples
    places = places[(places > 2.5 / comparison.n_samples) & (places < 0.5 - 0.5 / comparison.n_samples)]
    here = comparison.base.spectrum(torch.tensor([f], dtype=torch.float64))
    return (power[:, (places * length).round().long()] / comparison.base.spectrum(places) * here).mean(-1)


def line_near(comparison: Comparison, f: float, reach: float) -> float:
    """The highest place of the recording's spectrum over the simulation's noise within a reach, cycles per sample."""
    power, length = _tapered_power(comparison.observed)
    first, last = max(math.floor((f - reach) * length), 1), min(math.ceil((f + reach) * length), length // 2 - 1)
    place = torch.arange(first, last + 1, dtype=torch.float64) / length
    return float(place[(power[:, first : last + 1] / comparison.base.spectrum(place)).sum(0).argmax()])


@derived
def _tapered_power(side: Records) -> tuple[Tensor, int]:
    """Periodogram `(sensor, bin)` of a recording under a Hann taper, and the length it was padded to."""
    transform, length = hann_transform(side.signal[0])
    return squared_modulus(transform), length


def amplitude_limits(snr: Tensor, seen: float) -> Tensor:
    """Lower limits, estimates and upper limits of amplitudes `(3, sensor)`, all in standard deviations.

    For amplitudes that were estimated because they are above `seen` (those that are not for having been the largest):
    the square is noncentral chi-square of two degrees of freedom, of which only the tail beyond `seen` comes here.
    Weak ones are there because noise has made them larger; equal tails of that law cover them as often as strong ones.
    Of the weakest both limits would be zero: none is below what the square less that of the noise says.
    """
    value = (snr.square() - 1).clamp(min=0.0).sqrt()
    limits = value + Z * torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
    strong = 12.0  # standard deviations, from which the law is normal
    weak = snr < strong
    if bool(weak.any()):
        low, high = _tail_limits(snr[weak], seen if float(snr.min()) > seen else 0.0)
        limits[:, weak] = torch.stack([low, high.maximum(value[weak])])
    return torch.stack([limits[0], value.clamp(limits[0], limits[1]), limits[1]])


def _tail_limits(snr: Tensor, seen: float) -> Tensor:
    """Amplitudes at which what comes beyond `seen` is beyond `snr` with 2.5 and 97.5 %, `(2, sensor)`, halved in on."""
    tail, far, halvings = 0.025, 6.0, 40  # beyond either limit; standard deviations beyond which no amplitude is
    wanted = torch.tensor([[tail], [1 - tail]], dtype=torch.float64)
    low, high = torch.zeros(2, len(snr), dtype=torch.float64), (snr + far).repeat(2, 1)
    for _ in range(halvings):
        middle = (low + high) / 2
        law = stats.ncx2(2, middle.square().numpy())
        share = torch.from_numpy(law.sf(snr.square().numpy()) / law.sf(seen**2))
        low, high = torch.where(share < wanted, middle, low), torch.where(share < wanted, high, middle)
    return torch.where(low > 0, high, 0.0)


def _limits(value: float, sd: float, unit: str) -> Parameter:
    return Parameter(value, value - Z * sd, value + Z * sd, unit)
