"""A tone of the simulation in another size: a rotor that shakes harder, the same array on another mount."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import CERTAIN
from gyrofuse.mismatch.detectors.lines.line_sizes import line_sizes
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism, Rival
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import estimation_samples, signal_gains
from gyrofuse.mismatch.signals.known_lines import resized
from gyrofuse.mismatch.stats.limits import Z

_CERTAIN = 6.0  # standard deviations from which the simulation has a line beyond doubt
_SEEN_SD = 3.5  # of an amplitude, below which there is none
_SEEN = 0.05  # p value, for having looked at all sensors, of one in which the size is another


@dataclass(frozen=True, eq=False)
class ToneSize(Mechanism):
    """`x_i(t) = a_i cos(2 pi f t + theta_i)` with another `a_i` than that of the simulation's tone at `f`.

    Phases are not compared: they count from when a record began.

    Attributes:
        frequency_hz: `f`.
        amplitude: `a`, `(sensor,)`, unit of the signal.
    """

    name: ClassVar[str] = "parameter_shift"
    likelihood: ClassVar[str] = "known paths"
    separated_by: ClassVar[str] = "a longer recording, or one of the same device under other conditions"
    sets_sizes: ClassVar[bool] = True
    frequency_hz: float
    amplitude: OfSensors

    @property
    def only_numbers(self) -> bool:
        return True

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        sizes = line_sizes(comparison)
        if sizes is None or sizes.p_value > level:
            return None
        sensor, at = sizes.worst
        own, before, sd = (values[:, at] for values in (sizes.observed, sizes.reference, sizes.sd))
        if float(sizes.present[:, at].max()) < _CERTAIN:
            return None
        other = sizes.tails[:, at] < _SEEN / comparison.n_sensors
        sensors, info = tuple(other.nonzero()[:, 0].tolist()), comparison.info
        f = comparison.reference.lines[at] * info.rate
        old, new = (f"{float(size[sensor]):.3g}" for size in (before, own))
        of_sensor = f"{info.measure} (sensor {info.sensors[sensor]})"
        if float((own / sd)[other].max()) < _SEEN_SD:
            words = f"the simulation's tone at {f:.6g} Hz, of amplitude {old} {of_sensor}, is not in the recording"
        else:
            words = f"the tone at {f:.6g} Hz that the simulation has is of amplitude {new} instead of {old} {of_sensor}"
        return cls(f, torch.where(other, own, before)).found(
            f"{words}, in {info.named(sensors, 'all sensors')}",
            sizes.p_value,
            sensors,
            {f"amplitude[{i}]": _limits(float(own[i]), float(sd[i]), info.measure) for i in sensors},
            levels=(level_of(comparison.reference.lines[at]),),
            frequency_hz=f,
            gain=float(sizes.z[:, at].square().sum()) / 2,
        )

    def is_seen(self, comparison: Comparison) -> bool:
        """Whether a filter that was found later leaves the tone of another size."""
        sizes = line_sizes(comparison)
        if sizes is None:
            return False
        return float(sizes.tails[:, self._at(comparison)].min()) < CERTAIN / comparison.n_sensors

    @classmethod
    def fit_in_place_of(cls, finding: Finding, comparison: Comparison) -> Rival | None:
        return None  # stands for no other noise

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        pictures.spectrum_near(ax, comparison, sensor, self.frequency_hz, comparison.info.rate / comparison.n_samples)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return resized(signal, self.frequency_hz / info.rate, self.amplitude)

    def fit_without(self, comparison: Comparison, fold: int) -> ToneSize:
        here = self._parts(comparison, fold).abs()
        return replace(self, amplitude=torch.where(self.amplitude != self._before(comparison), here, self.amplitude))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        """In the phases of the recording, as the blocks that are not held out show them."""
        own = self._parts(comparison, fold).sgn()
        angle = 2 * math.pi * self.frequency_hz * comparison.info.seconds(comparison.n_samples)
        path = own.real[:, None] * angle.cos() - own.imag[:, None] * angle.sin()
        after, before = (
            signal_gains(comparison, a[:, None] * path, fold) for a in (self.amplitude, self._before(comparison))
        )
        return after - before

    def _before(self, comparison: Comparison) -> Tensor:
        """Amplitude that the simulation has, `(sensor,)`."""
        sizes = line_sizes(comparison)
        assert sizes is not None
        return sizes.reference[:, self._at(comparison)]

    def _at(self, comparison: Comparison) -> int:
        """Its place among the simulation's lines."""
        lines = torch.tensor(comparison.reference.lines, dtype=torch.float64)
        return int((lines - self.frequency_hz / comparison.info.rate).abs().argmin())

    def _parts(self, comparison: Comparison, fold: int) -> Tensor:
        """Complex amplitudes `(sensor,)` in the samples that may be used for estimates."""
        keep = estimation_samples(comparison.n_samples, fold)
        angle = 2 * math.pi * self.frequency_hz * comparison.info.seconds(comparison.n_samples)[keep]
        basis = torch.stack([angle.cos(), angle.sin(), torch.ones_like(angle)])
        cosine, sine, _ = torch.linalg.solve(basis @ basis.mT, basis @ comparison.recording[:, keep].mT)
        return torch.complex(cosine, -sine)


def _limits(value: float, sd: float, unit: str) -> Parameter:
    return Parameter.around(value, Z * sd, unit, least=0.0)
