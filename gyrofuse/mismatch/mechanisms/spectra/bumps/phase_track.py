"""The phase of a line whose frequency wanders, and what follows it: multiples of it turn in step.

In the band of a strong line the sum of the sensors in phase is analytic, and its angle the phase. Turned back by a
multiple of that, a harmonic is a line at frequency zero, however far it wandered, and noise stays noise: complex
Hotelling's over the bins beside it (`signals.lines`) says whether there is one. A resonance has no harmonics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import CHANCE
from gyrofuse.mismatch.detectors.spectra.frequency_courses import rampless_transform, weights_in_phase
from gyrofuse.mismatch.detectors.spectra.peak_fit import Oscillation
from gyrofuse.mismatch.mechanisms.signals.harmonics import folded
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.lines import log_hotelling, sets_of


@dataclass(frozen=True, eq=False)
class PhaseTrack:
    """A line followed through a record.

    Attributes:
        phase: `(time,)`, without jumps.
        clearness: Power of the line over that of the noise in its band, `(time,)`.
    """

    phase: Tensor
    clearness: Tensor

    @classmethod
    def of(cls, comparison: Comparison, peak: Oscillation) -> PhaseTrack | None:
        """That of a bump; None where noise hides its phase for more than a twentieth of the time."""
        faint, often, fewest = 4.0, 1 / 20, 32  # bins
        n, centre = comparison.n_samples, round(peak.centre * comparison.n_samples)
        reach = max(round(_reach(peak.width) * n), fewest)
        reach = min(reach, centre - 1, n // 2 - centre)
        if reach < fewest:
            return None
        weights = weights_in_phase(comparison, peak)
        bins = (weights @ rampless_transform(comparison))[centre - reach : centre + reach]
        noise = comparison.base.spectrum(torch.tensor([peak.centre], dtype=torch.float64))[:, 0]
        padded = torch.zeros(n, dtype=torch.complex128)
        padded[torch.arange(-reach, reach) % n] = bins
        analytic = torch.fft.ifft(padded)
        clearness = analytic.abs().square() / (float(weights.abs().square() @ noise) * 2 * reach / n)
        if float((clearness < faint).double().mean()) > often:
            return None
        turn = analytic[1:] * analytic[:-1].conj()
        angle = torch.cat([analytic[:1].angle(), turn.angle()]).cumsum(0)
        return cls(2 * math.pi * centre / n * torch.arange(n, dtype=torch.float64) + angle, clearness)

    @property
    def wanders(self) -> bool:
        """Whether the phase is off that of a steady frequency by more than a radian: else most of it is a line."""
        t = torch.linspace(-1, 1, len(self.phase), dtype=torch.float64)
        left = self.phase - self.phase.mean()
        left = left - t * (left @ t) / (t @ t)
        return float(left.std()) > 1

    def spread(self, width: float) -> float:
        """Standard deviation of its frequency over an eighth of the time in which a line of a width turns once more."""
        lag = min(max(round(1 / (8 * width)), 1), len(self.phase) // 4)
        return float((self.phase[lag:] - self.phase[:-lag]).std()) / (2 * math.pi * lag)

    def kept(self, ratio: float) -> float:
        """Share of an amplitude that is left at a multiple of the phase, by what noise moves that."""
        return float(torch.exp(-(ratio**2) / (4 * self.clearness.clamp(min=1.0))).mean())


class InStep(NamedTuple):
    """A line at a multiple of a phase.

    Attributes:
        multiple: Of the fundamental frequency.
        amplitude: Complex, in step with that multiple of the phase of the fundamental, `(sensor,)`.
        square: Of each sensor's amplitude over its variance, `(sensor,)`.
        log_p: Of noise.
    """

    multiple: int
    amplitude: Tensor
    square: Tensor
    log_p: float


class Family(NamedTuple):
    """Lines in step.

    Attributes:
        multiple: That of the line whose phase was followed.
        lines: All of them, that one first.
        p_value: Of the clearest of the others, for all that were looked at.
    """

    multiple: int
    lines: tuple[InStep, ...]
    p_value: float


def lines_in_step(comparison: Comparison, peak: Oscillation, track: PhaseTrack) -> Family | None:
    """Lines at multiples of a line that wanders, or of a half or a third of it; None where there is no other."""
    highest, found = 12, []
    by_ratio = dict[float, InStep]()  # the multiples 2, 4 and 6 of one, a half and a third of a line are the same
    for multiple in (1, 2, 3):
        places = _places(comparison, peak, multiple, highest * multiple)
        each = CHANCE / (3 * max(len(places), 1))
        for k, place in places:
            if k / multiple not in by_ratio:
                by_ratio[k / multiple] = _in_step(comparison, track, k, k / multiple, place)
        lines = [by_ratio[k / multiple]._replace(multiple=k) for k, _ in places]
        others = [line for line in lines if line.log_p < math.log(each)]
        if others:
            own = _in_step(comparison, track, multiple, 1.0, peak.centre)
            p = min(3 * len(places) * math.exp(min(line.log_p for line in others)), 1.0)
            found.append(Family(multiple, (own, *others), p))
    # A fundamental is divided only where that tells of more lines.
    return max(found, key=lambda one: (len(one.lines), -one.multiple), default=None)


def _places(comparison: Comparison, peak: Oscillation, multiple: int, most: int) -> list[tuple[int, float]]:
    """Multiples of a fundamental frequency and where they are seen, apart from each other, cycles per sample."""
    n, margin = comparison.n_samples, 36  # bins
    taken, places = [(peak.centre, peak.width)], list[tuple[int, float]]()
    for k in range(1, most + 1):
        ratio = k / multiple
        place = float(folded(torch.tensor(ratio * peak.centre, dtype=torch.float64)))
        reach = _reach(ratio * peak.width) + margin / n
        inside = reach < place < 0.5 - reach
        if inside and all(abs(place - other) > reach + _reach(width) for other, width in taken):
            places.append((k, place))
            taken.append((place, ratio * peak.width))
    return places


def _reach(width: float) -> float:
    """On either side of the centre of a line of a half width."""
    return 6 * width


def _in_step(comparison: Comparison, track: PhaseTrack, multiple: int, ratio: float, place: float) -> InStep:
    """A line at a multiple of a phase, whether or not it is there."""
    n = comparison.n_samples
    turned = torch.fft.fft(comparison.white * torch.exp(-1j * ratio * track.phase)) / math.sqrt(n)
    beside = torch.arange(4, 36)  # bins on either side of a line at frequency zero
    around = turned[:, torch.cat([beside, n - beside])]
    m = around.shape[-1]
    matrix, here = around @ around.mH / m, turned[:, 0]
    sets, log_chance = sets_of(comparison.n_sensors)
    log_p = log_hotelling(here[None], matrix[None], sets, torch.tensor([[float(m)]], dtype=torch.float64)) - log_chance
    noise = comparison.base.spectrum(torch.tensor([place], dtype=torch.float64))[:, 0]
    left = 1.0 if ratio == 1 else track.kept(ratio)
    amplitude = 2 * here * (noise / n).sqrt() / left
    return InStep(multiple, amplitude, 2 * here.abs().square() / matrix.diagonal().real, float(log_p.min()))
