"""What mechanisms that follow an auxiliary channel instantaneously have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.case import Case, Scene
from gyrofuse.mismatch.channels import ChannelFit, regress
from gyrofuse.mismatch.folds import estimation_samples, signal_gains
from gyrofuse.mismatch.mechanism import Finding, Mechanism, Parameter, Z
from gyrofuse.mismatch.witnesses import level_of

_OF_ONE_BAND = 0.9  # share of the evidence from which a gain might be a line's alone
_LATE = 0.25  # share of the evidence a quarter of a cycle late, from which it is no instantaneous coupling


@dataclass(frozen=True, eq=False)
class ChannelGain(Mechanism):
    """`x_i(t) = sum_k coupling_ik a_k(t)` with rows `a` made from an auxiliary channel.

    Attributes:
        channel: Its name.
        coupling: `(sensor, row)`, signal per unit of the rows; 0 for sensors that do not show it.
    """

    of_one_band: ClassVar[tuple[str, ...]] = ()
    channel: str
    coupling: Tensor

    @classmethod
    def channels(cls, case: Case) -> list[str]:
        """Channels that it may follow."""
        raise NotImplementedError

    @classmethod
    def rows(cls, values: Tensor) -> Tensor:
        """Rows `(row, time)` of a channel's values `(row, time)`."""
        return values

    @classmethod
    def words(cls, gain: float, channel: str, where: str, unit: str) -> str:
        """The sentence."""
        raise NotImplementedError

    @classmethod
    def nominate(cls, case: Case, level: float) -> Finding | None:
        best: tuple[ChannelFit, str] | None = None
        candidates = cls.channels(case)
        for name in candidates:
            fit = regress(case, cls._rows(case.scene, name))
            if (
                fit is not None
                and fit.p_value * len(candidates) <= level
                and (best is None or fit.statistic > best[0].statistic)
            ):
                best = fit, name
        if best is None:
            return None
        fit, name = best
        chance = fit.gains.numel()  # what either would be without any gain
        if fit.quadrature - chance > _LATE * (fit.statistic - chance):
            return None
        present = tuple((fit.own < 0.01 / case.n_sensors).nonzero()[:, 0].tolist()) or (int(fit.own.argmin()),)
        unit = f"{case.scene.unit}{cls._per(case.scene, name)}"
        sizes = {i: _size(fit, i, unit) for i in present}
        largest = max(sizes, key=lambda i: sizes[i].value)
        where = case.scene.named(present, "every sensor")
        rows = cls._rows(case.scene, name)
        busiest = (
            float(torch.fft.rfft(rows - rows.mean(-1, keepdim=True)).abs().square().sum(0).argmax()) / case.n_samples
        )
        return Finding(
            cls.name,
            cls(name, _only(fit.gains, present)),
            cls.words(sizes[largest].value, name, where, unit),
            fit.p_value * len(candidates),
            present,
            {f"gain[{i}]": entry for i, entry in sizes.items()},
            levels=(level_of(max(busiest, 1 / case.n_samples)),),
            alternatives=cls.of_one_band if fit.share > _OF_ONE_BAND else (),
            channel=name,
            gain=fit.statistic / 2,
        )

    def refitted(self, case: Case, fold: int) -> ChannelGain:
        """Regression on the kept samples alone, the others left out of both sides."""
        keep = estimation_samples(case.n_samples, fold)
        weight = keep.to(torch.float64)
        rows = self._rows(case.scene, self.channel)
        means = [(v * weight).sum(-1, keepdim=True) / weight.sum() for v in (rows, case.recording)]
        fit = regress(case, (rows - means[0]) * weight, (case.recording - means[1]) * weight)
        present = tuple(self.coupling.any(-1).nonzero()[:, 0].tolist())
        return self if fit is None else type(self)(self.channel, _only(fit.gains, present))

    def gains(self, case: Case, fold: int) -> Tensor:
        return signal_gains(case, self._path(case.scene, case.n_samples), fold)

    def simulated(self, signal: Tensor, scene: Scene, generator: torch.Generator) -> Tensor:
        return signal + self._path(scene, signal.shape[-1])

    def removed(self, signal: Tensor, scene: Scene) -> Tensor:
        return signal - self._path(scene, signal.shape[-1])

    def explained(self, case: Case, generator: torch.Generator) -> Case:
        return case.less(self._path(case.scene, case.n_samples))

    def _path(self, scene: Scene, n_samples: int) -> Tensor:
        rows = self._rows(scene, self.channel)
        if rows.shape[-1] < n_samples:
            raise ValueError(
                f"`channels`: expected {n_samples} samples of {self.channel!r}, which {self.name} follows, "
                f"got {rows.shape[-1]}; give the channel for the whole simulation"
            )
        return self.coupling @ rows[:, :n_samples]

    @classmethod
    def _rows(cls, scene: Scene, name: str) -> Tensor:
        values = scene.channels[name].to(torch.float64)
        rows = cls.rows(values.reshape(-1, values.shape[-1]))
        return rows - rows.mean(-1, keepdim=True)

    @classmethod
    def _per(cls, scene: Scene, name: str) -> str:
        """What a gain is per: the unit of acceleration that gravity gives away, or nothing."""
        return f" per unit of {name}"


def _only(gains: Tensor, sensors: tuple[int, ...]) -> Tensor:
    """Gains of some sensors, those of the others zero."""
    kept = torch.zeros_like(gains)
    kept[list(sensors)] = gains[list(sensors)]
    return kept


def gravity_unit(scene: Scene, name: str) -> str | None:
    """Unit of a channel of acceleration, by the size of gravity in it."""
    size = float(scene.channels[name].to(torch.float64).reshape(-1, scene.channels[name].shape[-1]).mean(-1).norm())
    return next(
        (unit for unit, one in (("g", 1.0), ("m/s^2", 9.80665)) if abs(math.log(max(size, 1e-9) / one)) < 0.2), None
    )


def _size(fit: ChannelFit, sensor: int, unit: str) -> Parameter:
    """Length of a sensor's vector of gains, with limits."""
    gains = fit.gains[sensor]
    size = float(gains.norm())
    direction = gains / max(size, 1e-300)
    sd = math.sqrt(float(direction @ fit.covariance[sensor, :, sensor] @ direction))
    return Parameter(size, max(size - Z * sd, 0.0), size + Z * sd, unit)
