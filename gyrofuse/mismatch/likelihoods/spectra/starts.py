"""Where spectral terms start from: of grids of their numbers the likeliest in each sensor.

Mechanisms declare their terms as subclasses of `SpectralTerms`; the selection knows them by that alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.likelihoods.declared import declared
from gyrofuse.mismatch.likelihoods.spectra.coherence import connected
from gyrofuse.mismatch.likelihoods.spectra.common_sources import Common, CommonBump
from gyrofuse.mismatch.likelihoods.spectra.components import Peak, Term, oscillation
from gyrofuse.mismatch.likelihoods.spectra.fit import Pieces, data_model, pieces, powers
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios, log_gain, power_gains


class SpectralTerms:
    """What a mechanism declares to compete for the spectra.

    Attributes:
        made_of: What its terms do: they "scale" the noise, "add" to it, or "filter" everything.
        leaves_levels: Whether they leave the level of the noise to be seen at low frequencies, as filters do.
    """

    made_of: ClassVar[str] = "add"
    leaves_levels: ClassVar[bool] = False

    @classmethod
    def starts(cls, data: Ratios, company: Sequence[Term]) -> Iterable[Term]:
        """Its terms to add to some, each at the best start in every sensor; none by default.

        Args:
            data: What is to be explained.
            company: Terms that are there.
        """
        return ()

    @classmethod
    def levels(cls, data: Ratios, passed: Tensor) -> Iterable[Term]:
        """Terms that set the level of the noise, at those of the recording in bands `(band,)`; none by default."""
        return ()

    @classmethod
    def forms(cls, data: Ratios, term: Term, company: Sequence[Term]) -> Iterable[Term]:
        """Other forms that one of its terms may have beside the company; none by default."""
        return ()


def levels(data: Ratios, passed: Tensor) -> Iterator[Term]:
    """Levels that a recording's noise may have beside what leaves some bands `(band,)` as they are."""
    for kind in declared(SpectralTerms):
        yield from kind.levels(data, passed)


def candidates(data: Ratios, company: Sequence[Term], *, beside_levels: bool = False) -> Iterator[Term]:
    """Terms of all mechanisms that declare any, to add to some; or of those beside which levels are seen."""
    for kind in declared(SpectralTerms):
        if not beside_levels or kind.leaves_levels or kind.made_of == "filter":
            yield from kind.starts(data, company)


def other_forms(data: Ratios, term: Term, company: Sequence[Term]) -> Iterator[Term]:
    """Other forms that a term may have, by the mechanism that declares it."""
    for kind in declared(SpectralTerms):
        yield from kind.forms(data, term, company)


def best_start(data: Ratios, beside: Pieces, family: Term) -> tuple[Term, float]:
    """Of starts `local` `(start, number, sensor or 1)` the likeliest in each sensor, and its gain, nats.

    Args:
        data: What is to be explained.
        beside: What other terms do.
        family: The starts.
    """
    values = family.values(data.ground, family.local, family.shared)  # (start, sensor, node)
    gains = power_gains(data, beside.with_term(family.acts, values).power(data)).sum(-2)
    best, local = gains.argmax(0), family.local.expand(-1, -1, data.n_sensors)
    local = local.gather(0, best[None, None].expand(1, *local.shape[1:]))[0]
    return replace(family, local=local), float(gains.amax(0).clamp(min=0).sum())


def best_of_families(data: Ratios, beside: Pieces, families: Term) -> Term:
    """Of families of starts the one that is likeliest in all sensors together, each at its likeliest start.

    Args:
        data: What is to be explained.
        beside: What other terms do.
        families: Starts `local` `(start, number, 1)`, and `shared` numbers of each family, `(family, 1, number)`.
    """
    values = families.values(data.ground, families.local, families.shared)  # (family, start, sensor or 1, node)
    gains = power_gains(data, beside.with_term(families.acts, values).power(data)).sum(-2)  # (family, start, sensor)
    most, best = gains.max(1)
    chosen = int(most.clamp(min=0).sum(-1).argmax())
    local = families.local[best[chosen], :, 0].mT  # (number, sensor)
    return replace(families, local=local, shared=families.shared[chosen, 0])


def closest_starts(data: Ratios, beside: Pieces, families: Sequence[Term]) -> list[Term]:
    """Of families on even grids of one local number the likeliest starts, each sensor's by itself, the likeliest first.

    In ever finer grids, of which a family that is far behind in a coarser one gets none: the misfit of a step falls
    with its square.
    """
    finer, beside_it = (len(families), 8, 5), torch.linspace(-1, 1, 9, dtype=torch.float64)[:, None, None]
    steps = [float(family.local[:2, 0, 0].diff()) for family in families]
    found = [(best_start(data, beside, family), step) for family, step in zip(families, steps, strict=True)]
    for n_kept in finer:
        found.sort(key=lambda entry: -entry[0][1])
        for k, ((start, _), step) in enumerate(found[:n_kept]):
            closer = replace(start, local=start.local + step * beside_it)
            found[k] = best_start(data, beside, closer), step * float(beside_it[1] - beside_it[0])
    return [start for (start, _), _ in sorted(found, key=lambda entry: -entry[0][1])]


def common_starts(data: Ratios, company: Sequence[Term]) -> Iterator[Common]:
    """Sources of white noise, walks and AR1s that sensors may share, of AR1s the likeliest corner.

    Those of all sensors, and where some share nothing with others those of each group alone: the strongest direction of
    two sources together is one of neither.
    """
    excess = data.observed - data_model(data, company)
    yield from _common_starts(data, company, excess)
    for group in _groups(data, excess):
        alone = excess * (group[:, None] & group)
        for start in _common_starts(data, company, alone):
            yield start.only(start.free & group)


def _groups(data: Ratios, excess: Tensor) -> list[Tensor]:
    """Sensors that hang together by what they share, `(sensor,)` each, where that is not all of them.

    Args:
        data: What is to be explained.
        excess: Cross-spectra beyond a model, over the noise's densities, `(band, sensor, sensor)`.
    """
    surely = 5.0  # standard deviations of a sum of squared coherences
    p, power = data.n_sensors, data.observed.diagonal(dim1=-2, dim2=-1).real.clamp(min=1e-300)
    squared = excess.abs().square() / (power[:, :, None] * power[:, None, :])
    dof = data.pair_dof[:, None, None]
    bands = (data.pair_dof > 0).sum().clamp(min=1)
    z = ((dof * squared).sum(0) - bands) / bands.sqrt()  # squared coherences of ordinates of chance are exponential
    groups = {tuple(row.tolist()) for row in connected(z > surely) if 1 < int(row.sum()) < p}
    return [torch.tensor(group) for group in sorted(groups, reverse=True)]


def _common_starts(data: Ratios, company: Sequence[Term], excess: Tensor) -> Iterator[Common]:
    ground = data.ground
    for kind in ("white", "walk"):
        yield from Common.starts(ground, excess, data.information, kind, torch.zeros(0, dtype=torch.float64))
    lowest, n_corners = 8 * float(ground.bands.frequency[0]), 8
    corners = torch.logspace(math.log10(lowest), math.log10(0.3), n_corners, dtype=torch.float64).log()
    starts_at = [Common.starts(ground, excess, data.information, "ar1", c[None]) for c in corners]
    yield from max(starts_at, key=lambda s: float(log_gain(data, data_model(data, [*company, s[0]])).sum()))


def peak_starts(data: Ratios, company: Sequence[Term]) -> Iterator[Term]:
    """The peak that is likeliest, each sensor's own and of one source."""
    peak = best_bump(data, company, _peaks(data))
    if peak is None:
        return
    yield peak
    if data.n_sensors > 1:
        excess = data.observed - data_model(data, company)
        yield from CommonBump.starts(data.ground, excess, data.information, "oscillation", peak.shared)


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
    shown = ground.bands.mean_of(profile[:, None] * filters) / ground.whole  # (peak, sensor, band)
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
