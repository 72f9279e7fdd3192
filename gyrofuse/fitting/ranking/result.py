"""Structures of noise processes, ranked."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gyrofuse._base.deprecation import RenamedAttribute
from gyrofuse._base.results import Result, counted, format_p_value, p_words, plain, scattered, sensor_label, signed
from gyrofuse.fitting.gmwm_result import MOST_TABLES, GMWMResult, axes_of, items_of
from gyrofuse.fitting.j_test import CLEARLY_REJECTED
from gyrofuse.fitting.ranking.candidates import name_of
from gyrofuse.fitting.ranking.table import Table
from gyrofuse.noise.parsing import parse_model

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Largest numbers of candidates in the table of a sensor, and of bars in a figure: what a screen holds.
_MOST_ROWS = 8
_MOST_BARS = 12


@dataclass(frozen=True, eq=False, repr=False)
class RankResult(Result):
    """Ranked candidates for every sensor; `...` are the leading dimensions of the signal.

    Attributes:
        candidates: Names, such as `WN + AR1 + RW`.
        criterion: Criterion, `(..., sensor, candidate)`, less is better; NaN where a candidate was not tried, as it has
            another number of sinusoids than were found, or the sensor could not be ranked. Of a signal without its
            sinusoids.
        wvic: Wavelet variance information criterion, the same.
        p_value: P value of the J test, that the candidate is complete, the same; at the parameters of greatest
            likelihood. Of a signal it is that of the record without its sinusoids, but for the chosen one that of its
            fit.
        redundant: Whether the fit amounts to a smaller candidate that explains the record as well, the same.
        reasons: Reason why a candidate is redundant or was not compared, for every sensor, `...` flattened, and
            candidate; None where there is none.
        equivalent: Whether a candidate is as good as the chosen one, and not it, the same as `criterion`.
        choice: Index of the chosen candidate, `(..., sensor)`; -1 where a sensor could not be ranked.
        wvic_choice: Index of the candidate with the smallest WVIC, `(..., sensor)`. For comparison only: WVIC weights
            each candidate by its own covariance and so favours bad fits.
        n_sinusoids: Number of sinusoids of the candidates compared, `(..., sensor)`, -1 as in `choice`; None of a
            wavelet variance.
        n_lines: Number of spectral lines that stand out of the noise, `(..., sensor)`, at most one more than candidates
            have sinusoids.
        best: Fit of the chosen candidate for every sensor, `...` flattened; None where there is none.
        n_samples: Length of the records.
        from_signal: Whether the criterion is that of the spectral likelihood, or of the wavelet variance.
        sensors: Names of the sensors.
        axes: Names along the leading dimension, empty when it has none.
    """

    candidates: tuple[str, ...]
    criterion: Tensor
    wvic: Tensor
    p_value: Tensor
    redundant: Tensor
    reasons: tuple[tuple[str | None, ...], ...]
    equivalent: Tensor
    choice: Tensor
    wvic_choice: Tensor
    n_sinusoids: Tensor | None
    n_lines: Tensor | None
    best: tuple[GMWMResult | None, ...]
    n_samples: int
    from_signal: bool
    sensors: tuple[str, ...]
    axes: tuple[str, ...] = ()

    n_tones = RenamedAttribute("n_sinusoids")
    _batched = (
        "criterion",
        "wvic",
        "p_value",
        "redundant",
        "equivalent",
        "choice",
        "wvic_choice",
        "n_sinusoids",
        "n_lines",
    )

    @classmethod
    def build(
        cls, *, table: Table, usable: Tensor, batch: tuple[int, ...], best: tuple[GMWMResult | None, ...], **rest: Any
    ) -> RankResult:
        """Put the items that could be ranked back into their places among all, `(item,)` -> `(..., sensor)`."""
        reasons = iter(table.reasons)
        nothing: list[str | None] = [None] * len(table.kinds)
        return cls(
            candidates=tuple(map(name_of, table.kinds)),
            criterion=scattered(table.criterion, usable, batch),
            wvic=scattered(table.wvic, usable, batch),
            p_value=scattered(table.p_value, usable, batch),
            redundant=scattered(table.redundant, usable, batch, False),
            reasons=tuple(tuple(next(reasons) if there else nothing) for there in usable.tolist()),
            equivalent=scattered(table.equivalent, usable, batch, False),
            choice=scattered(table.choice, usable, batch, -1),
            wvic_choice=scattered(table.wvic_choice, usable, batch, -1),
            n_sinusoids=None if table.n_sinusoids is None else scattered(table.n_sinusoids, usable, batch, -1),
            n_lines=None if table.n_lines is None else scattered(table.n_lines, usable, batch, -1),
            best=best,
            **rest,
        )

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions before the sensors; `()` for a single array."""
        return tuple(self.choice.shape[:-1])

    def __getitem__(self, index: Any) -> RankResult:
        """One item, or some, of the leading batch dimensions."""
        shape = self.choice.shape
        reasons, best = items_of(self.reasons, shape, index), items_of(self.best, shape, index)
        return replace(super().__getitem__(index), reasons=reasons, best=best, axes=axes_of(self.axes, index))

    @property
    def difference(self) -> Tensor:
        """Criterion less that of the chosen candidate, `(..., sensor, candidate)`; a redundant one may be below 0."""
        return self.criterion - self.criterion.gather(-1, self.choice.clamp(min=0)[..., None])

    @property
    def names(self) -> tuple[str | None, ...]:
        """Chosen for every sensor, `...` flattened."""
        return tuple(self.candidates[c] if c >= 0 else None for c in self.choice.flatten().tolist())

    @property
    def compared(self) -> str:
        """How many candidates were compared, such as `3 of 4 candidates`, and `2 and 3` for sensors that differ."""
        counts = self.criterion.isfinite().sum(-1)[self.choice >= 0].tolist()
        whole = counted(len(self.candidates), "candidate")
        least, most = min(counts), max(counts)
        if least == most:
            return whole if most == len(self.candidates) else f"{most} of {whole}"
        *first, last = map(str, counts)
        numbers = f"{', '.join(first)} and {last}" if len(counts) <= _MOST_ROWS else f"{least} to {most}"
        return f"{numbers} of {whole}"

    @property
    def wvic_difference(self) -> Tensor:
        """WVIC less the least, `(..., sensor, candidate)`."""
        return self.wvic - self.wvic.nan_to_num(nan=torch.inf).amin(-1, keepdim=True)

    def standing(self, index: tuple[int, ...], c: int) -> str:
        """Where a candidate stands for a sensor: `chosen`, `equivalent`, `redundant`, or nothing to say.

        Equivalent: its fit has the same spectrum as the chosen one.
        """
        if c == int(self.choice[index]):
            return "chosen"
        if bool(self.equivalent[index][c]):
            return "equivalent"
        return "redundant" if bool(self.redundant[index][c]) else ""

    def compared_to(self, index: tuple[int, ...]) -> list[int]:
        """Candidates that were compared for a sensor, from the best on."""
        difference = self.difference[index]
        order = difference.nan_to_num(nan=torch.inf).argsort().tolist()
        return [c for c in order if bool(difference[c].isfinite())]

    def set_aside(self, index: tuple[int, ...]) -> list[int]:
        """Candidates given that were not compared for a sensor; `reasons` says why."""
        known = self.reasons_of(index)
        return [c for c, value in enumerate(self.criterion[index].tolist()) if math.isnan(value) and known[c]]

    def doubts(self, index: tuple[int, ...]) -> list[str]:
        """What speaks against every candidate of a sensor, in sentences."""
        found = []
        if self.none_fits(index):
            largest = p_words(max(self._tested(index)))
            found.append(f"No candidate fits: the J test refuses all (largest {largest}).")
        if (
            self.n_lines is not None
            and self.n_sinusoids is not None
            and bool(self.n_lines[index] > self.n_sinusoids[index])
        ):
            found.append("The spectrum has more lines than those compared have sinusoids: allow more of them (SIN).")
        return found

    def lines_counted(self, index: tuple[int, ...]) -> bool:
        """Whether `n_lines` of a sensor is their number, or the count ended at one more than candidates have."""
        return self.n_lines is not None and int(self.n_lines[index]) <= max(map(_n_sinusoids, self.candidates))

    def none_fits(self, index: tuple[int, ...]) -> bool:
        """Whether the J test clearly rejects all candidates of a sensor that it could be made of."""
        return max(self._tested(index), default=1.0) < CLEARLY_REJECTED

    def _tested(self, index: tuple[int, ...]) -> list[float]:
        """P-values of the J tests there are, of candidates compared."""
        p_values = self.p_value[index]
        return p_values[p_values.isfinite() & self.criterion[index].isfinite()].tolist()

    def reasons_of(self, index: tuple[int, ...]) -> tuple[str | None, ...]:
        """`reasons` of a sensor, for every candidate."""
        return self.reasons[sum(i * step for i, step in zip(index, self.choice.stride(), strict=True))]

    def summary(self) -> str:
        """The best candidates, sensor by sensor; of a large batch how often each was chosen."""
        by = f"{'spectral likelihood' if self.from_signal else 'likelihood of the wavelet variance'} (Hannan-Quinn)"
        n_items = self.choice.numel()
        lines = [f"Noise models ranked by {by}: {self.n_samples} samples, {self.compared}"]
        if self.choice.ndim > 1:
            lines.append(f"{n_items} records in a batch {tuple(self.choice.shape[:-1])}")
        if n_items > MOST_TABLES:
            counts = Counter(name or "not ranked" for name in self.names)
            lines += [f"  {n:>8}  {name}" for name, n in counts.most_common(_MOST_ROWS)]
            return "\n".join(lines)
        for index in itertools.product(*map(range, self.choice.shape)):
            lines += ["", *self._table(index)]
        return "\n".join(lines)

    def _table(self, index: tuple[int, ...]) -> list[str]:
        head = f"sensor {self._place(index)}"
        if int(self.choice[index]) < 0:
            return [f"{head}: not ranked"]
        lines = [f"{head}: {self.candidates[int(self.choice[index])]}"]
        same = [name for name, there in zip(self.candidates, self.equivalent[index].tolist(), strict=True) if there]
        if same:
            lines.append(f"  equivalent: {', '.join(same)}")
        lines += [f"  {text}" for text in self.doubts(index)]
        wide = max(map(len, ("candidate", *self.candidates)))
        lines.append(f"  {'candidate':<{wide}}  {'criterion':>10}  {'WVIC':>8}  {'J test p':>8}")
        wvic, difference, reasons = self.wvic_difference[index], self.difference[index], self.reasons_of(index)
        order = self.compared_to(index)
        for c in order[:_MOST_ROWS]:
            row = f"  {self.candidates[c]:<{wide}}  {signed(difference[c].item()):>10}  {signed(wvic[c].item()):>8}"
            row += f"  {format_p_value(self.p_value[index][c].item()):>8}"
            phrase = ": ".join(filter(None, (self.standing(index, c), reasons[c])))
            lines.append(f"{row}  {phrase}".rstrip())
        if len(order) > _MOST_ROWS:
            lines.append(f"  and {len(order) - _MOST_ROWS} more")
        lines += [f"  {self.candidates[c]:<{wide}}  not compared: {reasons[c]}" for c in self.set_aside(index)]
        return lines

    @property
    def first_ranked(self) -> tuple[int, ...]:
        """Index of the first sensor that could be ranked."""
        return tuple((self.choice >= 0).nonzero()[0].tolist())

    def plot(self, ax: Axes | None = None, *, title: str | None = None) -> Axes:
        """Draw the criterion of the first ranked sensor's best candidates over that of the chosen one.

        Args:
            ax: Axes to draw on; a new figure by default.
            title: Title; by default the sensor, and its place in a batch.
        """
        from gyrofuse.fitting.plots import plot_ranking

        first = self.first_ranked
        compared = self.compared_to(first)
        order = compared[:_MOST_BARS]
        aside = self.set_aside(first)[: _MOST_BARS - len(order)]
        notes = [f"{len(order)} best of {len(compared)}"] if len(order) < len(compared) else []
        before = int((self.choice.flatten() < 0).cumprod(0).sum())
        if before:
            notes.append(f"{counted(before, 'sensor')} before it not ranked")
        p_value = self.p_value[first][int(self.choice[first])].item()
        return plot_ranking(
            [self.candidates[c] for c in order],
            self.difference[first][order],
            [self.standing(first, c) for c in order],
            rejected=p_value < CLEARLY_REJECTED,
            aside=[self.candidates[c] for c in aside],
            title=title or f"sensor {self._place(first)}",
            note=", ".join(notes),
            ax=ax,
        )

    def _place(self, index: tuple[int, ...]) -> str:
        return sensor_label(self.sensors, index, self.axes)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain lists and numbers, ready for JSON (NaN and infinities as None)."""
        named = [entry.name for entry in fields(self) if entry.name not in ("n_sinusoids", "axes")]
        others = {"names": self.names, "difference": self.difference, "n_tones": self.n_sinusoids}
        return {name: plain(value) for name, value in ({name: getattr(self, name) for name in named} | others).items()}


def _n_sinusoids(candidate: str) -> int:
    return sum(process.has_line for process in parse_model(candidate).processes)
