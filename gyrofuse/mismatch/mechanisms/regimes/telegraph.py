"""Random telegraph noise: a trap that is filled and emptied moves the rate between two levels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.detectors.spectra.power_differs import power_differs
from gyrofuse.mismatch.detectors.variance.haar_kurtosis import jump_test
from gyrofuse.mismatch.likelihoods.telegraph_fit import Numbers, excess, scores, two_levels
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import N_JUDGED, in_fold
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.mismatch.stats.limits import Z
from gyrofuse.noise.processes import AR1

_PRESENT, _CERTAIN = 5.0, 8.0  # nats over the Gaussian rival, of all sensors together
_GAUSSIAN = ("flicker", "parameter_shift")  # what may have the same spectrum
_CHOSEN = 1.5  # nats that each sensor costs that is to show it by itself
_FASTEST = 0.01  # mean dwell, samples: far below one sample a telegraph is white noise, drawn at endless cost
_NUMBERS = 4  # of a sensor: half step, dwells, and the rival's place


@dataclass(frozen=True, eq=False)
class RandomTelegraph(Mechanism):
    """`y_t = x_t + half_step s_t`, `s_t = +-1` with exponential dwells of mean `up` and `down`.

    Has the spectrum of an AR1; that it has two levels instead of a normal law tells them apart. For noise with so much
    power that it can just be seen that is not enough: the name takes a likelihood above that of the best Gaussian
    process of any variance and time constant.

    Attributes:
        half_step: `(sensor,)`, unit of the signal; 0 where there is none.
        up, down: Mean dwells in the upper and the lower level, s, `(sensor,)`.
        signs: 1 or -1 where several sensors jump at the same times, either way; 0 where one does by itself. By default
            all do.
    """

    name: ClassVar[str] = "random_telegraph"
    likelihood: ClassVar[str] = "regimes"
    separated_by: ClassVar[str] = "a longer recording with more switches"
    half_step: OfSensors
    up: OfSensors
    down: OfSensors
    signs: tuple[int, ...] = ()

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        if not (power_differs(comparison, level) or jump_test(comparison).p_value <= level):
            return None
        possible = {i: fit for i, fit in two_levels(comparison).items() if fit.resolved}
        own = {i: fit for i, fit in possible.items() if fit.over > _CHOSEN and fit.lasts}
        over = _CHOSEN + sum(fit.over - _CHOSEN for fit in own.values())
        if over < _PRESENT:
            return None
        # Beside sensors that jump, excess of another one is likelier to be jumps than anything else but one event.
        fits = {i: fit for i, fit in possible.items() if i in own or (fit.over > 0 and not fit.momentary)}
        sensors = tuple(fits)
        gain = float(excess(comparison).gain[list(sensors)].sum()) + sum(fit.over for fit in fits.values())
        sets = math.comb(comparison.n_sensors, len(sensors))
        p_value = min(sets * float(stats.chi2.sf(2 * gain, _NUMBERS * len(sensors))), 1.0)
        if p_value > level:
            return None
        effect = cls._of(comparison, {i: fit.best for i, fit in fits.items()})
        effect = replace(effect, signs=_signs(comparison, effect))
        together = tuple(i for i, sign in enumerate(effect.signs) if sign)
        parameters = {}
        for i, fit in fits.items():
            found = (
                ("half_step", effect.half_step, comparison.info.measure),
                ("dwell_up", effect.up, "s"),
                ("dwell_down", effect.down, "s"),
            )
            for (name, values, unit), sd in zip(found, fit.log_sd, strict=True):
                value, reach = float(values[i]), math.exp(min(Z * sd, 50.0))
                parameters[f"{name}[{i}]"] = Parameter.within(value, reach, unit)
        largest = max(sensors, key=lambda i: float(effect.half_step[i]))
        where = comparison.info.named(sensors, "all sensors")
        return effect.found(
            f"the rate jumps between two levels in {where}: half a step of {float(effect.half_step[largest]):.3g} "
            f"{comparison.info.measure} to either side in sensor {comparison.info.sensors[largest]}, "
            f"staying {float(effect.up[largest]):.3g} s "
            f"in the upper and {float(effect.down[largest]):.3g} s in the lower one on average"
            f"{f', at the same times in {comparison.info.named(together)}' if together else ''}",
            p_value,
            sensors,
            parameters,
            levels=_levels(effect, sensors, comparison.info.rate),
            alternatives=() if over > _CERTAIN else _GAUSSIAN,
            gain=gain,
        )

    @classmethod
    def _of(cls, comparison: Comparison, numbers: Mapping[int, Numbers]) -> RandomTelegraph:
        """With the numbers of some sensors, times in samples."""
        values = torch.zeros(3, comparison.n_sensors, dtype=torch.float64)
        values[1:] = 1.0
        for i, (half, up, down) in numbers.items():
            values[:, i] = torch.tensor(
                [half, up / comparison.info.rate, down / comparison.info.rate], dtype=torch.float64
            )
        return cls(*values)

    def fit_without(self, comparison: Comparison, fold: int) -> RandomTelegraph:
        fits = two_levels(comparison)
        sensors = self.half_step.nonzero()[:, 0].tolist()
        again = self._of(comparison, {i: fits[i].without(fold) for i in sensors if i in fits})
        return replace(again, signs=self.signs)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        dwell = float(torch.minimum(self.up, self.down)[sensor]) * comparison.info.rate
        pictures.two_levels(ax, comparison, sensor, float(self.half_step[sensor]) if fitted else 0.0, dwell)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        n = signal.shape[-1]
        records = signal.reshape(-1, len(self.half_step), n).clone()
        signs = (*self.signs, *(0,) * len(self.half_step))
        sensors = self.half_step.nonzero()[:, 0].tolist()
        together = [i for i in sensors if signs[i]]
        for i in [i for i in sensors if not signs[i]] + together[:1]:
            up, down = float(self.up[i]) * info.rate, float(self.down[i]) * info.rate
            if not min(up, down) > _FASTEST:
                raise ValueError(f"expected dwells of more than {_FASTEST:g} samples, got {min(up, down):.3g}")
            for record in records:
                path = _path(n, up, down, generator)
                for k in together if signs[i] else [i]:
                    record[k] += float(self.half_step[k]) * (signs[i] * signs[k] or 1) * path
        return records.reshape(signal.shape)

    def apply_to_reference(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        built = super().apply_to_reference(comparison, generator)
        scatter = partial(self._scatter, comparison.base, comparison.info.rate)
        # Where a model is Gaussian, jumps that were built into it are not.
        return replace(built, bent=(*built.bent, scatter), reference=replace(built.reference, gaussian=False))

    def _scatter(self, base: NoiseSpectrum, rate: float, f: Tensor) -> Tensor:
        """Factors `(sensor, frequency)` by which powers of two records differ, at `f` cycles per sample.

        All power above the inverse dwells rises and falls with the number of jumps in a record.
        """
        up, down = self.up[:, None] * rate, self.down[:, None] * rate
        phi = torch.exp(-1 / up - 1 / down)
        variance = 4 * up * down / (up + down).square() * self.half_step[:, None].square()
        own = AR1._spectrum(f, phi, variance * (1 - phi.square()))
        jumps = 2 * base.n_samples / (up + down)
        return 1 + own / (own + base.spectrum(f)) * (2 / jumps).sqrt()

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        total = torch.zeros(N_JUDGED, dtype=torch.float64)
        for i in self.half_step.nonzero()[:, 0].tolist():
            up, down = (float(v[i]) * comparison.info.rate for v in (self.up, self.down))
            total += torch.from_numpy(scores(comparison, i, Numbers(float(self.half_step[i]), up, down)))
        return total[in_fold(N_JUDGED, fold)]


def _signs(comparison: Comparison, effect: RandomTelegraph) -> tuple[int, ...]:
    """Which sensors jump at the same times, and which way, as `RandomTelegraph` has it; none where no two do.

    Differences of means over a quarter of a dwell, a dwell apart, have half of the covariance of jumps in step or more,
    beyond what the simulation has.
    """
    fewest, shared = 16, 0.5  # jumps to and fro, and share of the covariance
    sensors = effect.half_step.nonzero()[:, 0]
    up, down = (values[sensors] * comparison.info.rate for values in (effect.up, effect.down))
    if len(sensors) < 2 or float(comparison.n_samples / (up + down).amax()) < fewest:
        return ()
    parts = 4
    mean = max(int(torch.minimum(up, down).median()) // parts, 1)

    def covariance(signal: Tensor) -> Tensor:
        means = signal[..., : signal.shape[-1] // mean * mean].unflatten(-1, (-1, mean)).mean(-1)
        apart = means[..., parts:] - means[..., :-parts]
        return (apart @ apart.mT / apart.shape[-1]).reshape(-1, len(sensors), len(sensors)).mean(0)

    variance = 4 * up * down / (up + down).square() * effect.half_step[sensors].square()
    moved = (2 * variance * (1 - torch.exp(-parts * mean * (1 / up + 1 / down)))).sqrt()
    more = covariance(comparison.recording[sensors]) - covariance(comparison.reference.signal[:, sensors])
    alike = more / (moved[:, None] * moved)
    first = int((alike.abs() > shared).sum(-1).argmax())
    signs = torch.where(alike[first].abs() > shared, alike[first].sign(), 0.0)
    signs[first] = 1.0
    if int((signs != 0).sum()) < 2:
        return ()
    every = torch.zeros(comparison.n_sensors, dtype=torch.float64)
    every[sensors] = signs
    return tuple(int(sign) for sign in every)


def _levels(effect: RandomTelegraph, sensors: tuple[int, ...], rate: float) -> tuple[int, ...]:
    """Wavelet levels as long as the dwells."""
    dwells = [float(v[i]) * rate for v in (effect.up, effect.down) for i in sensors]
    return tuple(sorted({max(round(math.log2(max(d, 2.0))), 1) for d in dwells}))


def _path(n: int, up: float, down: float, generator: torch.Generator) -> Tensor:
    """A telegraph `(time,)` of values +-1, stationary."""
    mean = torch.tensor([up, down], dtype=torch.float64)
    first = int(torch.rand((), generator=generator, dtype=torch.float64) >= up / (up + down))
    ends: list[Tensor] = []
    total, state = 0.0, first
    while total < n:
        draws = torch.empty(64, dtype=torch.float64).exponential_(generator=generator)
        stays = draws * mean[(torch.arange(64) + state) % 2]
        ends.append(total + stays.cumsum(0))
        total = float(ends[-1][-1])
    switches = torch.searchsorted(torch.cat(ends), torch.arange(n, dtype=torch.float64), right=True)
    return 1.0 - 2.0 * ((switches + first) % 2)
