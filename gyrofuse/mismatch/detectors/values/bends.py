"""Whether the values of noise lie on a bent scale: test of a response that is no straight line.

Statistics: the whitened record times the whitened second and third Hermite polynomial of its standardised values,
which is the score of a bend of either kind; values are cut at 3 sd, since of a scale that expands they have heavy
tails. Both have mean zero for Gaussian noise of any spectrum, whatever it is whitened by. Null law: Student's t of the
means of 64 blocks, against those of the simulation: what is not there all the time, as pulses and louder episodes are
not, has a wide scatter.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy import stats
from torch import Tensor

from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.derived import derived
from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.mismatch.stats.kurtosis import clipped_sd
from gyrofuse.mismatch.stats.multiplicity import sidak


class Bends(NamedTuple):
    """Scores of bends.

    Attributes:
        score: Student's t of the quadratic and the cubic one, `(sensor, 2)`.
        p_values: Of the larger one, corrected for both and for all sensors, `(sensor,)`.
    """

    score: Tensor
    p_values: Tensor


@derived
def bends(comparison: Comparison) -> Bends:
    """Those of the recording, against the simulation's."""
    own = _blocks(comparison.recording, comparison.base)
    simulated = torch.cat([_blocks(record, comparison.base) for record in comparison.reference.signal], -1)
    off = own.mean(-1) - simulated.mean(-1)
    score = off / (own.var(-1) / own.shape[-1] + simulated.var(-1) / simulated.shape[-1]).clamp(min=1e-300).sqrt()
    tails = 2 * stats.t.sf(score.abs().amax(-1).numpy(), own.shape[-1] - 1)
    return Bends(score, torch.tensor([sidak(float(p), score.numel()) for p in tails], dtype=torch.float64))


def _blocks(signal: Tensor, base: NoiseSpectrum) -> Tensor:
    """Means of the scores over blocks of `(sensor, time)`, `(sensor, bend, block)`."""
    cut, cut_error = 3.0, 4.0  # sd
    z = signal - signal.mean(-1, keepdim=True)
    z = z / clipped_sd(z)[:, None].clamp(min=math.ulp(0.0))
    inner = z.clamp(-cut, cut)
    error = whitened(z, base)
    error = (error / clipped_sd(error)[:, None].clamp(min=math.ulp(0.0))).clamp(-cut_error, cut_error)
    # Of a cut cubic polynomial the linear part that it has of normal values is taken off.
    bent = inner.square(), inner**3 - 3 * inner - _linear_part(cut) * z
    scores = torch.stack([error * whitened(one, base) for one in bent], 1)
    n_blocks = 64
    return scores[..., : scores.shape[-1] // n_blocks * n_blocks].unflatten(-1, (n_blocks, -1)).mean(-1)


def _linear_part(cut: float) -> float:
    """`E z He_3(min(max(z, -cut), cut))` of a standard normal `z`, which by parts is that of the slope."""
    return -6 * cut * math.exp(-cut * cut / 2) / math.sqrt(2 * math.pi)
