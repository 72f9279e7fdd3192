"""A time scale of its own: a recording that was taken at another rate than the simulation has."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.decisions import NATS_AS_GOOD
from gyrofuse.mismatch.detectors.lines.time_scales import common_ratio
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.filters import filtered
from gyrofuse.mismatch.signals.folds import estimation_samples, signal_gains
from gyrofuse.mismatch.signals.known_lines import line_parts, without_lines
from gyrofuse.mismatch.signals.psd import between_bands, narrow_bands
from gyrofuse.mismatch.signals.records import Records
from gyrofuse.mismatch.stats.limits import Z


@dataclass(frozen=True, eq=False)
class TimeScale(Mechanism):
    """`x(t) = y(r t)` of what the simulation has: lines at `r f`, and where spectra say so noise of density `S(f / r)`.

    One line that is elsewhere is another line: two of the simulation's have to agree on `r`. Levels of noise say
    nothing of it, as those of samples stay what they are.

    Attributes:
        ratio: `r`, frequencies in the recording over those in the simulation.
        lines_hz: `f`, of the lines in the simulation, `(line,)`.
        parts: Of the lines in the recording, complex, `(sensor, line)`, unit of the signal.
        frequency: Where the density of the noise is given, cycles per sample, `(band,)`.
        log_gain: Half the logarithm of the density over that of the simulation, `(sensor, band)`.
    """

    name: ClassVar[str] = "time_scale"
    likelihood: ClassVar[str] = "known paths"
    separated_by: ClassVar[str] = "timestamps, or the output rate in the data sheet"
    changes_noise: ClassVar[bool] = True
    ratio: float
    lines_hz: tuple[float, ...]
    parts: Annotated[Tensor, Dims(("sensor", "line"), complex=True)]
    frequency: Annotated[Tensor, Dims(("band",))]
    log_gain: Annotated[Tensor, Dims(("sensor", "band"))]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found, info = common_ratio(comparison), comparison.info
        if found is None or found.p_value > level:
            return None
        lines = tuple(f * info.rate for f in found.gone)
        none = torch.zeros(comparison.n_sensors, len(lines), dtype=torch.complex128)
        there = comparison.knowing(tuple(found.ratio * f for f in found.gone))
        effect = cls(found.ratio, lines, none, *_noise(there.observed, comparison.reference, found.ratio))
        effect = effect._fitted(comparison, torch.ones(comparison.n_samples, dtype=torch.bool))
        reach = Z * found.sd
        moved = [f * info.rate for f in found.matched]
        before, after = (" and ".join(f"{f * r:.6g}" for f in moved) for r in (1.0, found.ratio))
        return effect.found(
            f"the rates of recording and simulation differ: the simulation's tones at {before} Hz are at {after} Hz, "
            f"all of them {found.ratio:.6g} times as high, as where {info.rate:g} Hz were "
            f"{info.rate / found.ratio:.6g} Hz",
            found.p_value,
            tuple(range(comparison.n_sensors)),
            {
                "ratio": Parameter.around(found.ratio, reach, ""),
                "rate": Parameter(
                    info.rate / found.ratio, info.rate / (found.ratio + reach), info.rate / (found.ratio - reach), "Hz"
                ),
            },
            levels=tuple(sorted({level_of(f * found.ratio) for f in found.matched})),
            frequency_hz=moved[0] * found.ratio,
            gain=found.gain,
        )

    def fit_without(self, comparison: Comparison, fold: int) -> TimeScale:
        return self._fitted(comparison, estimation_samples(comparison.n_samples, fold))

    def _fitted(self, comparison: Comparison, keep: Tensor) -> TimeScale:
        """With the lines of the recording by least squares on the samples to keep."""
        turn = self._carriers(comparison.n_samples, comparison.info)[:, keep]
        basis = torch.cat([turn.real, turn.imag, torch.ones_like(turn.real[:1])])
        sizes = torch.linalg.solve(basis @ basis.mT, basis @ comparison.recording[:, keep].mT)
        cosine, sine, _ = sizes.split([len(turn), len(turn), 1])
        return replace(self, parts=torch.complex(cosine, -sine).mT)

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        path = (self.parts @ self._carriers(comparison.n_samples, comparison.info)).real
        return signal_gains(comparison, path, fold)

    def _carriers(self, n_samples: int, info: RecordingInfo) -> Tensor:
        """`exp(i phase)` of the lines where they are, `(line, time)`."""
        f = self.ratio * torch.tensor(self.lines_hz, dtype=torch.float64)[:, None]
        angle = 2 * torch.pi * f * info.seconds(n_samples)
        return torch.polar(torch.ones_like(angle), angle)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        rate = comparison.info.rate
        pictures.spectrum_near(ax, comparison, sensor, self.lines_hz[0] * self.ratio, rate / comparison.n_samples)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        lines = tuple(f / info.rate for f in self.lines_hz)
        parts, rest = line_parts(signal, lines), without_lines(signal, lines)
        if bool(self.log_gain.any()):
            rest = filtered(rest, lambda f: between_bands(self.log_gain, self.frequency, f).exp())
        return rest + (parts @ self._carriers(signal.shape[-1], info)).real.to(rest.dtype)

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        built = super().apply_to_reference(comparison, generator)
        lines, near = [f / comparison.info.rate for f in self.lines_hz], 0.5 / comparison.n_samples
        return built.knowing(
            tuple(
                f * self.ratio if any(abs(f - line) < near for line in lines) else f for f in comparison.reference.lines
            )
        )


def _noise(observed: Records, reference: Records, ratio: float) -> tuple[Tensor, Tensor]:
    """Frequencies, and half the logarithm by which the noise's density changes: by nothing where spectra do not ask."""

    def log_change(f: Tensor) -> Tensor:
        # Beyond half its rate the simulation says nothing: what it has there is as recorded.
        there = torch.where(f / ratio < 0.49, _smooth_log_power(reference, f / ratio), _smooth_log_power(observed, f))
        return there - _smooth_log_power(reference, f)

    apart = observed.log_power - reference.log_power
    dof = 1 / (1 / observed.power_dof.clamp(min=1e-300) + 1 / reference.power_dof.clamp(min=1e-300))
    change = log_change(observed.bands.frequency)
    gained = (dof * (apart.square() - (apart - change).square())).sum() / 2
    f = narrow_bands(observed.bands.n_samples).frequency
    return f, (log_change(f) / 2 if float(gained) > NATS_AS_GOOD else torch.zeros(len(apart), len(f)).to(f))


def _smooth_log_power(side: Records, f: Tensor) -> Tensor:
    """Logarithms of densities `(sensor, frequency)` at `f` cycles per sample, by local parabolas in log frequency."""
    width, bands = 0.08, side.in_bands(narrow_bands(side.bands.n_samples))
    x = bands.bands.frequency.log()
    away = (x - f.clamp(bands.bands.frequency[0], bands.bands.frequency[-1]).log()[:, None]) / width
    closeness = -(away.square() - away.square().amin(-1, keepdim=True)) / 2
    weight = bands.dof * closeness.exp()  # (frequency, band)
    design = torch.stack([torch.ones_like(away), away, away.square()], -1)
    weighted = weight[..., None] * design
    gram = weighted.mT @ design + 1e-9 * torch.eye(3, dtype=f.dtype) * weight.sum(-1)[:, None, None]
    moments = weighted.mT @ torch.where(bands.dof > 0, bands.log_power, 0.0).mT
    return torch.linalg.solve(gram, moments)[:, 0].mT
