"""Codes that a converter never puts out: a bit that is stuck, or a step of its scale that is lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.detectors.values.lattices import code_lattices
from gyrofuse.mismatch.detectors.values.missing_codes import missing_codes
from gyrofuse.mismatch.mechanisms import pictures
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding, Mechanism
from gyrofuse.mismatch.mechanisms.values.rounding.quantization import Quantization
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo
from gyrofuse.mismatch.signals.dims import OfSensors
from gyrofuse.mismatch.signals.folds import held_out_blocks


@dataclass(frozen=True, eq=False)
class MissingCodes(Mechanism):
    """`y = x + step shifts[k mod m]`, with `k` the code of `x` and `m` the number of shifts.

    Attributes:
        step: Of the codes, `(sensor,)`, unit of the signal; 0 in sensors that have all of them.
        offset: Value of code 0, `(sensor,)`, likewise.
        shifts: Codes that each remainder is put out above its own, for each sensor; empty in those that have all.
    """

    name: ClassVar[str] = "missing_codes"
    likelihood: ClassVar[str] = Quantization.likelihood
    separated_by: ClassVar[str] = "the codes of the converter, before they are scaled"
    stage: ClassVar[int] = Quantization.stage
    step: OfSensors
    offset: OfSensors
    shifts: tuple[tuple[int, ...], ...]

    @classmethod
    def detect_and_fit(cls, comparison: Comparison, level: float) -> Finding | None:
        found = {i: one for i, one in missing_codes(comparison).items() if one.p_value <= level}
        if not found:
            return None
        info, lattices = comparison.info, code_lattices(comparison.as_came)
        step, offset = torch.zeros(2, comparison.n_sensors, dtype=torch.float64)
        parameters = {}
        for i, one in found.items():
            lattice = lattices[i]
            assert lattice is not None
            step[i], offset[i] = lattice.step, lattice.offset
            share = sum(shift != 0 for shift in one.shifts) / len(one.shifts)
            parameters[f"missing_share[{i}]"] = Parameter.exact(share, "")
        effect = cls(step, offset, tuple(found[i].shifts if i in found else () for i in range(comparison.n_sensors)))
        where = info.named(tuple(found), "all sensors")
        bits = sorted({one.bit for one in found.values() if one.bit is not None})
        what = f"bit {' and '.join(map(str, bits))} of the converter, counted from 0, is stuck" if bits else ""
        first = next(iter(found.values()))
        lost = sum(shift != 0 for shift in first.shifts)
        words = what or f"codes are missing: {lost} of every {len(first.shifts)} are put out as one beside them"
        return effect.found(
            f"{words}, in {where}",
            min(one.p_value for one in found.values()),
            tuple(found),
            parameters,
            levels=(1,),
            gain=float(effect._scores(comparison).sum()),
        )

    def fit_without(self, comparison: Comparison, fold: int) -> MissingCodes:
        """Codes are whole numbers, and known from whatever part of the record."""
        return self

    def plot(self, comparison: Comparison, ax: pictures.Axes, *, sensor: int, fitted: bool) -> None:
        centre = float(comparison.as_came.signal[0, sensor].median())
        reach = 2 * len(self.shifts[sensor]) * float(self.step[sensor])
        pictures.values(ax, comparison, sensor, centre, reach)

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        moved = signal.clone()
        for i, shifts in enumerate(self.shifts):
            if shifts:
                by = torch.tensor(shifts, dtype=signal.dtype)
                moved[..., i, :] += float(self.step[i]) * by[self._remainders(signal[..., i, :], i)]
        return moved

    def held_out_scores(self, comparison: Comparison, fold: int) -> Tensor:
        return held_out_blocks(self._scores(comparison), fold).sum((0, -1))

    def _remainders(self, values: Tensor, sensor: int) -> Tensor:
        code = ((values - float(self.offset[sensor])) / float(self.step[sensor])).round().long()
        return code % len(self.shifts[sensor])

    def _scores(self, comparison: Comparison) -> Tensor:
        """Log likelihood ratio of each sample's remainder over one of all that are as frequent, `(sensor, time)`."""
        signal, found, rarest = comparison.as_came.signal[0], missing_codes(comparison), 1e-4
        scores = torch.zeros_like(signal)
        for i, shifts in enumerate(self.shifts):
            if shifts and i in found and len(found[i].shifts) == len(shifts):
                ratio = (found[i].shares * len(shifts)).clamp(min=rarest).log()
                scores[i] = ratio[self._remainders(signal[i], i)]
        return scores
