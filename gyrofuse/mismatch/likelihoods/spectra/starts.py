"""Where spectral terms start from: of grids of their numbers the likeliest in each sensor."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.spectra.common_sources import Common, CommonBump
from gyrofuse.mismatch.likelihoods.spectra.components import Flicker, LowPass, Peak, Shift, Term, oscillation
from gyrofuse.mismatch.likelihoods.spectra.filter_forms import FILTERS
from gyrofuse.mismatch.likelihoods.spectra.fit import data_model, pieces, powers
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios, log_gain, power_gains


def candidates(data: Ratios, company: Sequence[Term]) -> Iterator[Term]:
    """Terms to add to some, the best start of each in every sensor.

    Args:
        data: What is to be explained.
        company: Terms that are there.
    """
    names = {t.name for t in company}
    ground = data.ground
    if "parameter_shift" not in names and bool(ground.matters.any()):
        starts = [best_start(data, company, family)[0] for family in Shift.starts(ground)]
        yield from starts
        # Two parts together, each from where it starts alone: from all at once one may stay where the other should be.
        for one, other in itertools.combinations(starts, 2):
            if not bool((one.free & other.free).any()):
                yield replace(one, local=one.local + other.local, free=one.free | other.free)
    if "low_pass" not in names:
        most = 3  # forms of a filter, the likeliest
        yield from filter_starts(data, company)[:most]
    if "flicker" not in names:
        yield best_start(data, company, Flicker.starts(ground))[0]
    excess = data.observed - data_model(data, company)
    peak = best_bump(data, company, _peaks(data))
    if peak is not None:
        yield peak
        if data.n_sensors > 1:
            yield from CommonBump.starts(ground, excess, data.information, "oscillation", peak.shared)
    if data.n_sensors > 1:
        for kind in ("white", "walk"):
            yield from Common.starts(ground, excess, data.information, kind, torch.zeros(0, dtype=torch.float64))
        lowest, n_corners = 8 * float(ground.bands.frequency[0]), 8
        corners = torch.logspace(math.log10(lowest), math.log10(0.3), n_corners, dtype=torch.float64).log()
        starts_at = [Common.starts(ground, excess, data.information, "ar1", c[None]) for c in corners]
        yield from max(starts_at, key=lambda s: float(log_gain(data, data_model(data, [*company, s[0]])).sum()))


def filter_starts(data: Ratios, company: Sequence[Term]) -> list[LowPass]:
    """Every form of a filter at its likeliest corners, the likeliest first.

    Corners are searched in ever finer grids, each sensor's by itself: of strong filters a coarse one would decide
    between the forms.

    Args:
        data: What is to be explained.
        company: Terms that are there.
    """
    rounds, beside = 3, torch.linspace(-1, 1, 9, dtype=torch.float64)[:, None, None]
    found: list[tuple[LowPass, float]] = []
    for kind in FILTERS:
        family = LowPass.starts(data.ground, kind)
        step = float(family.local[:2, 0, 0].diff())
        start, gain = best_start(data, company, family)
        for _ in range(rounds):
            start, gain = best_start(data, company, replace(family, local=start.local + step * beside))
            step *= float(beside[1] - beside[0])
        found.append((replace(family, local=start.local), gain))
    return [start for start, _ in sorted(found, key=lambda entry: -entry[1])]


def best_start(data: Ratios, company: Sequence[Term], family: Term) -> tuple[Term, float]:
    """Of starts `local` `(start, number, sensor)` the likeliest in each sensor beside others, and its gain, nats."""
    values = family.values(data.ground, family.local, family.shared)  # (start, sensor, node)
    gains = power_gains(data, pieces(data, company).with_term(family.acts, values).power(data)).sum(-2)
    best = gains.argmax(0)
    local = family.local.gather(0, best[None, None].expand(1, *family.local.shape[1:]))[0]
    return replace(family, local=local), float(gains.amax(0).clamp(min=0).sum())


def best_bump(data: Ratios, company: Sequence[Term], shapes: Tensor) -> Peak | None:
    """The peak that what others leave is most like; None where nothing is left.

    Args:
        data: What is to be explained.
        company: The other terms.
        shapes: Centres and half widths, cycles per sample, `(peak, 2)`.
    """
    heights = torch.tensor([0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0], dtype=torch.float64)  # over what there is
    ground = data.ground
    filters = pieces(data, company).filters
    before = powers(data_model(data, company))  # (band, sensor)
    centre, width = shapes[:, 0, None], shapes[:, 1, None]
    profile = oscillation(ground.nodes, centre, width)  # (place of a bump, place)
    shown = ground.bands.mean_of(profile[:, None] * filters) / ground.mean  # (peak, sensor, band)
    at = (shown / before.mT).amax(-1)  # highest over what there is, of variance one, (peak, sensor)
    size = heights[:, None, None] / at.clamp(min=1e-300)
    changed = before + (size[..., None] * shown).transpose(-1, -2)
    gains = power_gains(data, changed).sum(-2) - power_gains(data, before).sum(-2)  # (height, peak, sensor)
    height = gains.argmax(0)  # (peak, sensor)
    own = gains.gather(0, height[None])[0]
    chosen = int(own.clamp(min=0).sum(-1).argmax())
    if not bool((own[chosen] > 0).any()):
        return None
    variance = size.gather(0, height[None])[0, chosen]
    least = heights[0] / at[chosen]
    at_centre, half_width = shapes[chosen].tolist()
    return Peak.start(at_centre, half_width, torch.where(own[chosen] > 0, variance, least))


def _peaks(data: Ratios) -> Tensor:
    """Centres at the bands and half widths of 6 to 35 % of them, cycles per sample, `(peak, 2)`.

    Both sides of a peak are to be seen; below 16 cycles per record it could not be distinguished from an AR1.
    """
    f = data.ground.bands.frequency
    widths = torch.tensor([0.06, 0.15, 0.35], dtype=torch.float64)
    centres = f[f > 16 * 2 * float(f[0])]
    found = torch.stack([centres.repeat_interleave(len(widths)), (centres[:, None] * widths).flatten()], -1)
    return found[found.sum(-1) < 0.5]
