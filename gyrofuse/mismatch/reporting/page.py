"""Report of a diagnosis as one self-contained HTML page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from gyrofuse._base.axes import with_unit
from gyrofuse._base.page import image, number, render
from gyrofuse._base.results import format_p_value, readable
from gyrofuse.mismatch.detectors.result import TestResult
from gyrofuse.mismatch.mechanisms.catalogue import STAGES, named
from gyrofuse.mismatch.mechanisms.finding_parts import Parameter
from gyrofuse.mismatch.mechanisms.mechanism import Finding
from gyrofuse.mismatch.reporting.figures_data import VarianceComparison, compared_powers, grouped_spectrum
from gyrofuse.mismatch.reporting.outcome import Outcome
from gyrofuse.mismatch.reporting.plots import (
    ends_of_colours,
    plot_blocks,
    plot_deviations,
    plot_map,
    plot_shares,
    plot_spectra,
)
from gyrofuse.mismatch.reporting.text import (
    ALIKE,
    benefit_of,
    capital,
    chance_words,
    family_words,
    fused_words,
    headline,
    judged_shares,
    nats,
    otherwise_words,
    parameter_words,
    typeset,
    verdict,
)
from gyrofuse.mismatch.selection.shares import Share
from gyrofuse.mismatch.signals.comparison import Comparison, block_means

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WIDTH = 7.0  # inches
_LEFT, _RIGHT, _BELOW, _ABOVE, _BETWEEN = 0.85, 0.15, 0.5, 0.25, 0.35  # margins, inches
_SCALE = 0.7  # more to the right of a map
_PICTURE = 2.6  # height of one picture of a finding, inches
_MOST_NAMED = 8  # sensors in a cell


def mismatch_page(outcome: Outcome, *, title: str, remarks: Sequence[str] = ()) -> str:
    """Write the report of a diagnosis.

    Args:
        outcome: What was found.
        title: Heading of the page.
        remarks: Sentences shown below the verdict.

    Returns:
        An HTML page that needs no other file, no network and no script.
    """
    info, comparison = outcome.comparison.info, outcome.comparison
    repaired = outcome.repaired is not comparison  # if only by a filter that stands for no physics
    both = [comparison, outcome.repaired] if repaired else [comparison]
    variances = outcome.variances[: len(both)]
    sensor = _most_concerned(outcome.findings, variances[0])
    moving = _most_concerned([f for f in outcome.findings if f.time_s is not None], variances[0])
    lines = sorted({f.frequency_hz for f in outcome.findings if f.frequency_hz is not None})
    onsets = sorted({f.time_s for f in outcome.findings if f.time_s is not None})
    panels = len(both)
    before, shares, judge = judged_shares(outcome)
    rows = 0.5 + 0.22 * min(comparison.n_sensors, 24)  # inches of a map
    return render(
        Path(__file__).parent / "mismatch.html.j2",
        title=title,
        outcome=outcome,
        family_words=family_words,
        info=info,
        headline=typeset(headline(outcome)),
        verdict=[typeset(sentence) for sentence in verdict(outcome)],
        remarks=remarks,
        shares=image(_WIDTH, 0.8 + 0.26 * (len(shares) + 1), _draw_shares, before, shares) if shares else None,
        judge=judge,
        overshoots=min([share.share for share in shares] + [1 - sum(share.share for share in shares)]) < 0,
        parts=[_part(outcome, f) for f in outcome.findings],
        repaired=repaired,
        level_map=image(_WIDTH, panels * (rows + 0.75), _draw_maps, outcome, [v.z for v in variances]),
        band_map=image(
            _WIDTH,
            panels * (rows + 0.75),
            _draw_maps,
            outcome,
            [compared_powers(c) for c in both],
            edges=torch.tensor(comparison.bands.edges, dtype=torch.float64) / comparison.bands.n_samples,
            lines=lines,
        ),
        deviations=image(_WIDTH, 3.3 * panels, _draw_deviations, outcome, variances, sensor),
        spectra=image(_WIDTH, 3.3 * panels, _draw_spectra, outcome, both, sensor, lines),
        blocks=image(_WIDTH, 2.3 * panels, _draw_blocks, outcome, both, moving, onsets) if onsets else None,
        shown=info.sensors[sensor],
        moving=info.sensors[moving],
        lines=lines,
        tests=_tests(outcome),
        otherwise=[capital(words) for words in map(otherwise_words, outcome.findings) if words],
        looked_for=_looked_for(outcome),
        fused=_fused(outcome),
    )


def _most_concerned(findings: Sequence[Finding], variances: VarianceComparison) -> int:
    """The sensor that figures of one sensor show: that in which the first finding is clearest, or the one furthest off.

    Args:
        findings: Those that the figure is about.
        variances: Of recording and simulation as they came.
    """
    worst = variances.z.abs().nan_to_num(nan=0.0).amax(0).tolist()
    which = next((f.sensors for f in findings if f.sensors), tuple(range(len(worst))))
    if findings and findings[0].sensors:
        return findings[0].clearest_sensor
    return max(which, key=lambda i: worst[i])


def _part(outcome: Outcome, finding: Finding) -> dict[str, Any]:
    """What the page shows of one finding."""
    info = outcome.comparison.info
    facts = {
        "sensors": _names(outcome, finding.sensors),
        "averaging times": _times(finding.levels, info.rate),
        "frequency": "" if finding.frequency_hz is None else f"{number(finding.frequency_hz, 6)} Hz",
        finding.effect.time_words: "" if finding.time_s is None else f"{number(finding.time_s, 6)} s",
        "follows": finding.channel or "",
        "p value": format_p_value(finding.p_value),
        "gain held out": "" if finding.held_out_gain is None else f"{finding.held_out_gain:+.1f} nats",
        "lost if left out alone": "" if finding.gain_without is None else f"{nats(finding.gain_without)} nats",
    }
    return {
        "name": readable(finding.mechanism),
        "sentence": typeset(capital(finding.sentence)),
        "facts": {name: value for name, value in facts.items() if value},
        "picture": image(_WIDTH, 2 * _PICTURE, _draw_finding, finding),
        "parameters": [
            {"name": with_unit(parameter_words(name, info.sensors), entry.unit), **_resolved(entry)}
            for name, entry in finding.parameters.items()
        ],
        "alternatives": [
            {"name": readable(name), "by": next((kind.separated_by for kind in named([name])), "a longer recording")}
            for name in finding.alternatives
        ],
    }


def _times(levels: tuple[int, ...], rate: float) -> str:
    """Averaging times of levels, neighbours as a range."""
    runs: list[list[int]] = []
    for level in sorted(levels):
        if runs and level == runs[-1][-1] + 1:
            runs[-1].append(level)
        else:
            runs.append([level])
    ends = [[number(2 ** (level - 1) / rate) for level in dict.fromkeys((run[0], run[-1]))] for run in runs]
    return ", ".join(f"{' to '.join(pair)} s" for pair in ends)


def _resolved(entry: Parameter) -> dict[str, str]:
    """Estimate and limits with the digits that the interval leaves."""
    width, size = entry.high - entry.low, max(map(abs, (entry.value, entry.low, entry.high)))
    resolved = math.isfinite(size) and 0 < width < size
    digits = min(3 + math.floor(math.log10(size / width)), 15) if resolved else 4
    return {name: number(getattr(entry, name), digits) for name in ("value", "low", "high")}


def _tests(outcome: Outcome) -> list[dict[str, Any]]:
    """Every test before and after the repair."""
    left = {e.test for e in outcome.unexplained}
    return [
        {
            "name": readable(before.test),
            "p": format_p_value(before.p_value),
            "p_after": format_p_value(after.p_value),
            "chance": chance_words(before.p_value),
            "words": _seen_words(before, before.test in left or before.p_value * len(outcome.evidence) < 0.01),
            "words_after": capital(after.words),
            "surprised": before.p_value * len(outcome.evidence) < 0.01,
            "left": before.test in left,
        }
        for before, after in zip(outcome.evidence, outcome.evidence_after, strict=True)
    ]


def _seen_words(result: TestResult, beyond_chance: bool) -> str:
    """What a test found: where it is no more than chance gives, as the most extreme of all that it looked at."""
    if beyond_chance or not result.sensors:  # of no sensors: why nothing was tested
        return capital(result.words)
    return f"Nothing beyond chance; most extreme: {result.words}"


def _looked_for(outcome: Outcome) -> list[str]:
    """Mechanisms of the catalogue that were looked for and not found, by name."""
    known = {f.mechanism for f in outcome.findings} | {a for f in outcome.findings for a in f.alternatives}
    return [readable(n) for n in dict.fromkeys(m.name for stage in STAGES for m in stage) if n not in known]


def _fused(outcome: Outcome) -> dict[str, Any] | None:
    """Weights before and after, and how much smaller the variance gets."""
    gained = benefit_of(outcome)
    if gained is None:
        return None
    rate = outcome.comparison.info.rate
    return {
        "sentence": " ".join(fused_words(outcome)),
        "weights": list(
            zip(outcome.comparison.info.sensors, gained.before.tolist(), gained.after.tolist(), strict=True)
        ),
        "levels": [(2**j / rate, r) for j, r in enumerate(gained.level_factor.tolist()) if abs(r - 1) > ALIKE],
    }


def _names(outcome: Outcome, which: tuple[int, ...]) -> str:
    names = [outcome.comparison.info.sensors[i] for i in which]
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return ", ".join(names[:_MOST_NAMED]) + more


def _draw_shares(figure: Figure, before: float, shares: Sequence[Share]) -> None:
    plot_shares(before, shares, ax=figure.subplots())


def _draw_finding(figure: Figure, finding: Finding) -> None:
    figure.set_layout_engine("constrained")
    finding.plot(list(figure.subplots(2, 1)))


def _panels(figure: Figure, n: int, right: float = _RIGHT, **options: Any) -> list[Any]:
    """Axes above each other, named before and after where there are two."""
    figure.set_layout_engine("none")  # margins in inches suit figures of any height
    width, height = figure.get_size_inches()
    each = (height - _BELOW - _ABOVE - (n - 1) * _BETWEEN) / n
    margins = {
        "left": _LEFT / width,
        "right": 1 - right / width,
        "bottom": _BELOW / height,
        "top": 1 - _ABOVE / height,
        "hspace": _BETWEEN / each,
    }
    panels = figure.subplots(n, 1, sharex=True, squeeze=False, gridspec_kw=margins, **options)[:, 0]
    if n == 2:
        for ax, name in zip(panels, ("As they came", "After the repair"), strict=True):
            ax.set_title(name, loc="left", fontsize=9)
    return list(panels)


def _said_once(panels: list[Any]) -> None:
    """Labels of the time axis below the last panel alone, legends in the first."""
    for ax in panels[:-1]:
        ax.set_xlabel("")
    for ax in panels[1:]:
        if ax.get_legend():
            ax.get_legend().remove()


def _draw_maps(
    figure: Figure, outcome: Outcome, maps: list[Any], edges: Any = None, lines: list[float] | None = None
) -> None:
    panels, info = _panels(figure, len(maps), _RIGHT + _SCALE), outcome.comparison.info
    for ax, z in zip(panels, maps, strict=True):
        plot_map(
            z,
            names=info.sensors,
            rate=info.rate,
            edges=edges,
            lines_hz=lines or [],
            largest=ends_of_colours(*maps),
            ax=ax,
        )
    _said_once(panels)


def _draw_deviations(figure: Figure, outcome: Outcome, variances: list[VarianceComparison], sensor: int) -> None:
    panels, info = _panels(figure, len(variances), sharey=True), outcome.comparison.info
    for ax, v in zip(panels, variances, strict=True):
        columns = (v.observed[:, sensor], v.reference[:, sensor], v.spread[:, sensor])
        plot_deviations(*columns, rate=info.rate, unit=info.measure, ax=ax)
    _said_once(panels)


def _draw_spectra(figure: Figure, outcome: Outcome, both: list[Comparison], sensor: int, lines: list[float]) -> None:
    panels, info = _panels(figure, len(both), sharey=True), outcome.comparison.info
    for ax, comparison in zip(panels, both, strict=True):
        observed, reference = (
            (s.frequency, s.mean, s.largest)
            for s in (
                grouped_spectrum(comparison, side, sensor) for side in (comparison.observed, comparison.reference)
            )
        )
        plot_spectra(observed, reference, rate=info.rate, lines_hz=lines, ax=ax)
    _said_once(panels)


def _draw_blocks(figure: Figure, outcome: Outcome, both: list[Comparison], sensor: int, onsets: list[float]) -> None:
    panels, info = _panels(figure, len(both), sharey=True), outcome.comparison.info
    for ax, comparison in zip(panels, both, strict=True):
        means = block_means(comparison.recording[sensor])
        plot_blocks(means, duration=comparison.n_samples / info.rate, unit=info.measure, onsets=onsets, ax=ax)
    _said_once(panels)
