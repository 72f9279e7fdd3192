"""Another recording of the same device judges what a diagnosis repaired.

Blocks held out have the weather of their own recording: a repair that predicts them may still be of that day alone. How
far two recordings of the device are apart is what no simulation that knows nothing of the second one can beat.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import same_rate
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.repair.inputs import prepared
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.repair.session_model import SessionModel, records_for
from gyrofuse.mismatch.reporting.discrepancy import compared
from gyrofuse.mismatch.selection.classifier import distinguishability
from gyrofuse.mismatch.selection.discrepancy import discrepancy_of_fold
from gyrofuse.mismatch.selection.shares import Share, shares_of
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.folds import N_FOLDS
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.model import Model

_RECORDS = 4  # of the repaired simulation, each as long as the judge: of its own scatter half that of the judge is left
_BETTER_SD = 2.0  # standard errors of the difference over the folds: one judge of 14 says so by chance


@dataclass(frozen=True)
class Judged:
    """How far simulations are from a recording that nothing was estimated from.

    Discrepancies are per degree of freedom, of which 1 is what noise alone gives; areas under the curve of a classifier
    are 0.5 where it guesses.

    Attributes:
        before: Discrepancy of the simulation as it came.
        after: Of the repaired one.
        repeatability: Of the recording that was diagnosed, in the place of the simulation.
        auc_before, auc_after, auc_repeatability: Areas under the curve of the same.
        helps: Whether `after` is below `before` by more than two standard errors of their difference.
        lacks: Channels that the repaired simulation follows and the judge has not; what follows them was left out.
        shares: Of the discrepancy, in the order of the repairs; without what happened once, or follows such a channel.
    """

    before: float
    after: float
    repeatability: float
    auc_before: float
    auc_after: float
    auc_repeatability: float
    helps: bool
    lacks: tuple[str, ...] = ()
    shares: tuple[Share, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        classifier = {"before": self.auc_before, "after": self.auc_after, "repeatability": self.auc_repeatability}
        plain = {name: getattr(self, name) for name in ("before", "after", "repeatability", "helps")}
        shares = [share._asdict() for share in self.shares]
        return {**plain, "classifier": classifier, "lacks": list(self.lacks), "shares": shares}


def checked_judge(judge: Any, recording: Recording | Tensor, rate: float | None) -> Recording | Tensor:
    """The judge, in the recording's unit, after all that can be said at the door.

    Raises:
        TypeError: It is not of the recording's kind.
        ValueError: It is no recording of the same array, too short, has gaps, or is constant.
    """
    if isinstance(judge, Recording) != isinstance(recording, Recording) or not isinstance(judge, Recording | Tensor):
        expected = "a recording" if isinstance(recording, Recording) else "a tensor (sensor, time)"
        raise TypeError(f"`judge`: expected {expected} as `recording` is one, got {type(judge).__name__}")
    if isinstance(judge, Recording) and isinstance(recording, Recording):
        if not same_rate(judge.rate, recording.rate):
            raise ValueError(
                f"`judge`: expected the {recording.rate:g} Hz of the recording, got {judge.rate:g} Hz; give another "
                "recording of the same device, or resample it"
            )
        if len({judge.unit, recording.unit, "unknown"}) == 3:
            try:
                judge = judge.to(recording.unit)
            except ValueError as error:
                raise ValueError(
                    f"`judge`: expected the recording's unit {recording.unit}, or one that it can be converted to, got "
                    f"{judge.unit} ({error})"
                ) from None
        for name in {*judge.channels} & {*recording.channels}:
            rows, wanted = judge.channels[name].shape[:-1], recording.channels[name].shape[:-1]
            if rows != wanted:
                raise ValueError(
                    f"`judge`: expected the channel {name} with the rows {tuple(wanted)} of the recording, got "
                    f"{tuple(rows)}; leave it out, or give it whole"
                )
    shapes = [x.signal.shape if isinstance(x, Recording) else x.shape for x in (judge, recording)]
    if len(shapes[0]) != 2 or shapes[0][0] != shapes[1][0]:
        raise ValueError(
            f"`judge`: expected (sensor, time) with {shapes[1][0]} sensors as in the recording, got shape "
            f"{tuple(shapes[0])}; give the same sensors of one axis"
        )
    try:
        prepared(judge, recording, None if isinstance(judge, Recording) else rate, torch.Generator())
    except ValueError as error:
        raise ValueError(str(error).replace("`recording`", "`judge`").replace("`simulation`", "`recording`")) from None
    return judge


def judged(
    judge: Recording | Tensor,
    recordings: Sequence[Recording | Tensor],
    simulation: Recording | Tensor | Model | ArrayModel | RepairedModel,
    repaired: Sequence[RepairedModel],
    rate: float | None,
    n_known: int = 0,
) -> Judged:
    """Set a simulation, the repaired one, and the recordings behind it against another recording.

    Args:
        judge: As `checked_judge` gives it.
        recordings: What was diagnosed; the other recording is as far from them as from one of them in the mean.
        simulation: As it came.
        repaired: What the diagnosis made of it for each recording; none where there was nothing to repair.
        rate: Hz, of tensors.
        n_known: Number of effects, the first, that the simulation had as it came.
    """
    generator = torch.Generator().manual_seed(0)
    rate = None if isinstance(judge, Recording) else rate
    lacks: tuple[str, ...] = ()

    def apart(other: Any, drawn_with: Sequence[Mechanism] | None = None) -> tuple[Tensor, Comparison]:
        """Discrepancies of the folds, and both sides as they came."""
        given = prepared(judge, other, rate, generator)
        comparison = compared(given, other, generator, drawn_with)
        folds = [discrepancy_of_fold(comparison, fold) for fold in range(N_FOLDS)]
        return torch.tensor(folds, dtype=torch.float64), given

    def drawn(model: RepairedModel | SessionModel) -> Recording | Tensor:
        """Samples of a repaired simulation for the judge, with the same noise whatever it was repaired by."""
        return records_for(model, judge, _RECORDS, _whole_channels(judge), torch.Generator().manual_seed(1))

    def told(given: Comparison) -> float:
        """The area under the classifier's curve."""
        return sum(distinguishability(given, fold) for fold in range(N_FOLDS)) / N_FOLDS

    if isinstance(simulation, RepairedModel):
        simulation = drawn(_usable(simulation, judge)[0])
    before, given = apart(simulation)
    after, auc_before = before, told(given)
    effects, courses = list[Mechanism](), list[float]()
    if len(repaired) > 1:
        usable = [_usable(model, judge) for model in repaired]
        lacks = tuple(sorted({name for _, missing in usable for name in missing}))
        after, given = apart(drawn(SessionModel(tuple(model for model, _ in usable))))
    elif repaired:
        model, lacks = _usable(repaired[0], judge)
        known = _usable(replace(repaired[0], effects=repaired[0].effects[:n_known]), judge)[0]
        for n in range(len(known.effects) + 1, len(model.effects) + 1):
            made = replace(model, effects=model.effects[:n])
            rescaled = any(effect.rescales for effect in made.effects)
            after, given = apart(drawn(made), None if rescaled else made.effects)
            effects.append(model.effects[n - 1])
            courses.append(float(after.mean()))
    auc_after = told(given)
    if isinstance(judge, Recording):
        judge = replace(judge, channels={})  # which no other recording follows
    again = [apart(recording) for recording in recordings]
    less = before - after
    helps = float(less.mean()) > _BETTER_SD * float(less.std()) / N_FOLDS**0.5
    return Judged(
        before=float(before.mean()),
        after=float(after.mean()),
        repeatability=sum(float(folds.mean()) for folds, _ in again) / len(again),
        auc_before=auc_before,
        auc_after=auc_after,
        auc_repeatability=sum(told(given) for _, given in again) / len(again),
        helps=helps and bool(repaired),
        lacks=lacks,
        shares=shares_of(float(before.mean()), effects, courses),
    )


def _usable(model: RepairedModel, judge: Recording | Tensor) -> tuple[RepairedModel, tuple[str, ...]]:
    """A repaired simulation for another recording, and the channels that this lacks to follow."""
    model = model.elsewhere()
    lacks = tuple(sorted({name for effect in model.effects for name in effect.follows} - {*_whole_channels(judge)}))
    return replace(model, effects=tuple(e for e in model.effects if not {*e.follows} & {*lacks})), lacks


def _whole_channels(judge: Recording | Tensor) -> dict[str, Tensor]:
    """Its channels that lack no sample."""
    channels = judge.channels if isinstance(judge, Recording) else {}
    return {name: values for name, values in channels.items() if bool(values.isfinite().all())}
