"""What mechanisms that follow an auxiliary channel instantaneously have in common."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from gyrofuse._base.results import readable
from gyrofuse._base.units import GRAVITY
from gyrofuse.mismatch.detectors.slow.channels import ChannelFit, regress
from gyrofuse.mismatch.detectors.slow.transfer import Transfer, likeliest_transfer
from gyrofuse.mismatch.detectors.spectra.band_tests import level_of
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.known_path import KnownPath
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import Dims
from gyrofuse.mismatch.signals.folds import estimation_samples, signal_gains
from gyrofuse.mismatch.stats.inclusion import included_sensors
from gyrofuse.mismatch.stats.limits import Z

NOT_IDENTIFIABLE = "not_identifiable"  # what is seen but has no name: several mechanisms explain it equally well
_OF_ONE_BAND = 0.9  # share of the evidence from which a gain might be a line's alone
_WHOLE = ("each", "length")  # kinds of rows that are made from all of a channel
_LATE = 0.25  # share of the evidence a quarter of a cycle late, from which it is no instantaneous coupling
_AHEAD = 0.04  # cycles by which sensors may be ahead of a channel: as a simple filter of that has it
_SCATTER = 3.0  # standard deviations of what is so by chance


@dataclass(frozen=True, eq=False)
class ChannelGain(KnownPath):
    """`x_i(t) = sum_k coupling_ik (m * a_k)(t)` with rows `a` made from an auxiliary channel.

    The response `m`, which all sensors share, is one for a plain gain; see `Transfer`.

    Attributes:
        channel: Name of the channel.
        coupling: `(sensor, row)`, signal per unit of the rows at the frequencies of most information; 0 for sensors
            that do not show it.
        kind: Which rows are made from the channel.
        pole, response: Of `m`.
    """

    rivals: ClassVar[tuple[str, ...]] = ("parameter_shift", "low_pass", "flicker", "common_mode")
    of_one_band: ClassVar[tuple[str, ...]] = ()
    quantity: ClassVar[str] = "gain"
    largest: ClassVar[float] = math.inf  # that a sensor has, deg/s per g to the power below
    power_of_g: ClassVar[int] = 1
    channel: str
    coupling: Annotated[Tensor, Dims(("sensor", "row"))]
    kind: str = "each"
    pole: float = field(default=0.0, metadata={"plain": True})
    response: Annotated[Tensor, Dims(("term",))] = field(
        default_factory=lambda: torch.ones(1, dtype=torch.float64), metadata={"plain": True}
    )

    @property
    def amplitudes(self) -> Tensor:
        return self.coupling

    def with_amplitudes(self, amplitudes: Tensor) -> ChannelGain:
        return replace(self, coupling=amplitudes)

    @property
    def follows(self) -> tuple[str, ...]:
        return (self.channel,)

    @property
    def transfer(self) -> Transfer:
        return Transfer(self.pole, self.response)

    @classmethod
    def channels(cls, comparison: Comparison) -> list[str]:
        """Channels that it may follow."""
        raise NotImplementedError

    @classmethod
    def rows(cls, values: Tensor) -> Mapping[str, Tensor]:
        """Kinds of rows `(row, time)` that it may follow, made of a channel's values `(row, time)`."""
        return {"each": values}

    @classmethod
    def words(cls, gain: float, channel: str, where: str, unit: str) -> str:
        """The sentence."""
        raise NotImplementedError

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        tried = [
            (fit, name, kind)
            for name in cls.channels(comparison)
            for kind, rows in cls._rows(comparison.info, name).items()
            if (fit := regress(comparison, rows)) is not None
        ]
        if not tried:
            return None
        fit, name, kind = min(tried, key=lambda entry: (entry[0].p_value, _cost(entry[0], comparison.n_samples)))
        p_value = min(fit.p_value * len(tried), 1.0)
        if p_value > level:
            return None
        rows = cls._rows(comparison.info, name)[kind]
        transfer, words = likeliest_transfer(comparison, rows, fit), ""
        if transfer is not None:
            transfer, f, cycles = transfer.scaled(comparison, rows, fit.gains)
            if cycles < -_AHEAD:  # what comes first does not come from it
                return None
            rows = transfer.applied(rows)
            fit = regress(comparison, rows) or fit
            hertz = f * comparison.info.rate
            words = (
                f"; it comes {1e3 * cycles / hertz:.3g} ms late near {hertz:.3g} Hz, and not at every frequency "
                "alike, as through a mount or a filter: its form is not quite that of a gain"
            )
        chance = fit.gains.numel()  # mean of the statistic a quarter of a cycle late, with the variance twice as large
        if fit.quadrature > chance + _SCATTER * math.sqrt(2 * chance) + _LATE * fit.excess:
            return None
        present = included_sensors(fit.squares, fit.gains.shape[-1]).positions
        unit, factor = cls._unit(comparison.info, name)
        sizes = {i: _size(fit, i, unit, factor) for i in present}
        largest = max(sizes, key=lambda i: abs(sizes[i].value))
        where = f"the output of {comparison.info.named(present, 'every sensor')}"
        busiest = (
            float(torch.fft.rfft(rows - rows.mean(-1, keepdim=True)).abs().square().sum(0).argmax())
            / comparison.n_samples
        )
        effect = cls(name, _only(fit.gains, present), kind)
        if transfer is not None:
            effect = replace(effect, pole=transfer.pole, response=transfer.weights)
        finding = effect.found(
            cls.words(abs(sizes[largest].value), name if kind in _WHOLE else f"{kind} of {name}", where, unit) + words,
            p_value,
            present,
            {f"{cls.quantity}[{i}]": entry for i, entry in sizes.items()},
            levels=(level_of(max(busiest, 1 / comparison.n_samples)),),
            alternatives=cls.of_one_band if fit.share > _OF_ONE_BAND else (),
            channel=name,
            gain=fit.excess / 2,
        )
        if gain_in_g(comparison.info, finding, cls.power_of_g, sure=True) <= cls.largest:
            return finding
        power = "" if cls.power_of_g == 1 else f"^{cls.power_of_g}"
        what = readable(cls.name)
        return replace(
            finding,
            mechanism=NOT_IDENTIFIABLE,
            alternatives=(),
            sentence=f"{finding.sentence}; this is no {what}, of which no gyroscope has {cls.largest:g} "
            f"deg/s/g{power}: what moves {name} moves the output in another way",
        )

    def fit_without(self, comparison: Comparison, fold: int) -> ChannelGain:
        """Regression on the kept samples alone, the others left out of both sides."""
        keep = estimation_samples(comparison.n_samples, fold)
        weight = keep.to(torch.float64)
        rows = self._rows(comparison.info, self.channel)[
            self.kind
        ]  # the response stays: of all numbers it has the fewest
        means = [(v * weight).sum(-1, keepdim=True) / weight.sum() for v in (rows, comparison.recording)]
        rows = self.transfer.applied(rows - means[0])
        means[0] = (rows * weight).sum(-1, keepdim=True) / weight.sum()
        fit = regress(comparison, (rows - means[0]) * weight, (comparison.recording - means[1]) * weight)
        present = tuple(self.coupling.any(-1).nonzero()[:, 0].tolist())
        return self if fit is None else replace(self, coupling=_only(fit.gains, present))

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return signal_gains(comparison, self._path(comparison.info, comparison.n_samples), fold)

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        path = self._path(comparison.info, comparison.n_samples)[sensor]
        pictures.gain_on_channel(ax, comparison, sensor, path, f"share that follows {self.channel}, as fitted")

    def _path(self, info: RecordingInfo, n_samples: int) -> Tensor:
        rows = self._rows(info, self.channel)[self.kind]
        if rows.shape[-1] < n_samples:
            raise ValueError(
                f"`channels`: expected {n_samples} samples of {self.channel!r}, which {self.name} follows, "
                f"got {rows.shape[-1]}; give the channel for the whole simulation"
            )
        return self.coupling @ self.transfer.applied(rows[:, :n_samples])

    @classmethod
    def _rows(cls, info: RecordingInfo, name: str) -> dict[str, Tensor]:
        kinds = cls.rows(info.channel_rows(name))
        return {kind: rows - rows.mean(-1, keepdim=True) for kind, rows in kinds.items()}

    @classmethod
    def _unit(cls, info: RecordingInfo, name: str) -> tuple[str, float]:
        """Unit of the numbers given to readers, and what gains are multiplied with for it."""
        return f"{info.measure} per unit of {name}", 1.0


def _only(gains: Tensor, sensors: tuple[int, ...]) -> Tensor:
    """Gains of some sensors, those of the others zero."""
    kept = torch.zeros_like(gains)
    kept[list(sensors)] = gains[list(sensors)]
    return kept


def gravity_unit(info: RecordingInfo, name: str) -> str | None:
    """Unit of a channel of acceleration, by the size of gravity in it."""
    size = float(info.channel_rows(name).mean(-1).norm())
    return next(
        (unit for unit, one in (("g", 1.0), ("m/s^2", GRAVITY)) if abs(math.log(max(size, 1e-9) / one)) < 0.2), None
    )


def gain_in_g(info: RecordingInfo, finding: Finding, power_of_g: int, *, sure: bool) -> float:
    """The largest gain of a finding, or its lower limit, deg/s per power of g; 0 where units are not known."""
    unit, turn = gravity_unit(info, finding.channel or ""), {"deg/s": 1.0, "rad/s": math.degrees(1)}.get(info.unit)
    if unit is None or turn is None:
        return 0.0
    gains = finding.parameters.values()
    size = max(max(gain.low, -gain.high, 0.0) if sure else abs(gain.value) for gain in gains)
    return size * turn * (GRAVITY if unit == "m/s^2" else 1.0) ** power_of_g


def _cost(fit: ChannelFit, n_samples: int) -> float:
    """Schwarz's criterion, for where p values are too small to be told apart."""
    return fit.gains.numel() * math.log(n_samples) - fit.excess


def _size(fit: ChannelFit, sensor: int, unit: str, factor: float) -> Parameter:
    """A sensor's gain with its sign, or the length of its vector of gains, with limits.

    Of an axis along which next to nothing moves no gain is known: the length would be that of its error.
    """
    gains, covariance = factor * fit.gains[sensor], factor**2 * fit.covariance[sensor, :, sensor]
    still, sure = 5.0, 4.0  # times the error of the axis that is known best; standard deviations
    sd = covariance.diagonal().sqrt()
    known = (sd < still * sd.min()) | (gains.abs() > sure * sd)
    gains, covariance = gains[known], covariance[known][:, known]
    size = float(gains[0] if len(gains) == 1 else gains.norm())
    direction = gains / max(abs(size), 1e-300)
    reach = Z * math.sqrt(float(direction @ covariance @ direction))
    return Parameter.around(size, reach, unit, least=-math.inf if len(gains) == 1 else 0.0)


def not_identifiable(finding: Finding, seen: str) -> Finding:
    """The finding without its name, which is one among its alternatives, where the data cannot prefer any.

    The effect stays, since the rivals have the same: the repair does not depend on the name.

    Args:
        finding: With alternatives.
        seen: What is there whatever its name, the beginning of a sentence.
    """
    rivals = (finding.mechanism, *finding.alternatives)
    words = ", ".join(map(readable, rivals[:-1]))
    return replace(
        finding,
        mechanism=NOT_IDENTIFIABLE,
        alternatives=rivals,
        sentence=f"{seen}; {words} and {readable(rivals[-1])} explain it equally well",
    )
