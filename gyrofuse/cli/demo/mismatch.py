"""The demonstration's concealed effect: a recording with a tone that its simulation lacks."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gyrofuse._base.page import number
from gyrofuse.fitting.gmwm import fit_gmwm
from gyrofuse.io.recording import Recording
from gyrofuse.noise.array_model import ArrayModel

if TYPE_CHECKING:
    from gyrofuse.mismatch import MismatchReport

MOST_SAMPLES = 2**16
_TONE_HZ, _AMPLITUDE = 2.137, 0.05  # of the noise from sample to sample
_SHARES = (1.0, 0.7, 0.2, 1.2, 0.5, 0.0)  # of the amplitude, by sensor
_MODEL = "WN + AR1"


def concealed(array: ArrayModel, n_samples: int, rate: float, unit: str, generator: torch.Generator) -> Recording:
    """A recording of the array with a weak tone.

    Args:
        array: Six sensors.
        n_samples: Length.
        rate: Hz.
        unit: Of the array's signals.
        generator: Source of randomness.
    """
    noise = array.simulate(n_samples, generator=generator)
    size = _AMPLITUDE * noise.diff().std(-1) / 2**0.5 * torch.tensor(_SHARES, dtype=torch.float64)
    turn = 2 * torch.pi * _TONE_HZ / rate * torch.arange(n_samples, dtype=torch.float64)
    return Recording(noise + size[:, None] * turn.cos(), rate=rate, unit=unit)


def mismatch_story(recording: Recording, report: MismatchReport) -> str:
    """What the ordinary view shows of the tone, what the diagnosis finds, and what it is worth.

    Args:
        recording: With the tone.
        report: On the recording beside the simulation that lacks it.
    """
    loudest = _SHARES.index(max(_SHARES))
    fit = fit_gmwm(recording.select(sensors=[loudest]), _MODEL)
    z = report.variances[0].z
    paragraphs = [
        f"A concealed effect: another {number(recording.duration / 3600, 3)} h of the same array hold a tone at "
        f"{_TONE_HZ:g} Hz with up to {_AMPLITUDE * max(_SHARES):g} of the noise's standard deviation, which the "
        "simulation of the array leaves out.",
        f"The ordinary view: the J test of {_MODEL} for sensor {recording.sensors[loudest]}, which has most of it, "
        f"{_judged(fit.p_value)}. Of {int(z.isfinite().sum())} wavelet variances of recording and simulation none is "
        f"further apart than {number(float(z[z.isfinite()].abs().max()), 2)} standard deviations.",
    ]
    head = "The diagnosis, which is told nothing about it:"
    return "\n\n".join([*(fill(text, 110) for text in paragraphs), f"{head}\n{report.summary()}"])


def _judged(p_value: Tensor) -> str:
    p = float(p_value[0])
    return f"{'sees nothing' if p > 0.05 else 'doubts the model'} (p = {number(p, 2)})" if p == p else "says nothing"
