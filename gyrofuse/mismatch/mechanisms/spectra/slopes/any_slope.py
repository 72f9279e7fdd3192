"""Whether noise on top falls by another power of frequency than flicker noise, or the simulation's own, does."""

from __future__ import annotations

from gyrofuse.mismatch.decisions import NATS_PER_NUMBER
from gyrofuse.mismatch.likelihoods.spectra.components import Term
from gyrofuse.mismatch.likelihoods.spectra.fit import Fit, fit
from gyrofuse.mismatch.likelihoods.spectra.ratios import Ratios


def with_its_slope(data: Ratios, chosen: Fit) -> Fit:
    """With noise of another power of frequency where what other noise was chosen for plainly falls by that.

    Flicker noise, or other numbers of the simulation's own. Its slope has to gain the nats of two numbers, and to be
    neither that of flicker noise nor that of a walk.
    """
    flicker, walk = (0.85, 1.15), 1.8  # slopes
    for i, term in enumerate(chosen.terms):
        bent = term.bent(data.ground)
        if bent is None:
            continue
        terms = [*chosen.others(i), bent]
        found = fit(data, terms)
        slope = float(found.terms[-1].shared)
        if found.gain <= chosen.gain + 2 * NATS_PER_NUMBER or flicker[0] < slope < flicker[1] or slope > walk:
            continue
        if not _only_bent(data, terms, slope):
            return _without_idle(data, found)
    return chosen


def _without_idle(data: Ratios, found: Fit) -> Fit:
    """Without the terms before the last that no longer pay for their numbers: they stood for what it is now."""
    for term in found.terms[:-1]:
        fewer = fit(data, [t for t in found.terms if t.name != term.name])
        if fewer.gain > found.gain - NATS_PER_NUMBER * term.n_free(data.ground):
            found = fewer
    return found


def _only_bent(data: Ratios, terms: list[Term], slope: float) -> bool:
    """Whether noise of a power law, the last term, falls as `1/f` well below the rate, and not by the slope of it all.

    Next to the rate any noise is bent by how it is sampled: means over samples lose some of it, and what lies above
    half the rate is folded onto it, by less than a fifth up to a tenth of the rate. Where it is far above the rest,
    that alone makes for another slope.
    """
    below = fit(data.without((data.ground.bands.frequency > 0.1)[:, None]), terms)
    of_slow, sd = float(below.terms[-1].shared), float(below.sd(-1)[1])
    return (slope - of_slow) ** 2 - (1 - of_slow) ** 2 > 2 * NATS_PER_NUMBER * sd**2
