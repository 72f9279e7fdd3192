"""Concealed effects of the demonstration: a recording with a tone and a drift that its simulation lacks."""

from __future__ import annotations

from dataclasses import dataclass
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

_MAX_SAMPLES = 65_536  # of the recording with the tone, 1.8 h at 10 Hz, which keeps the diagnosis short
_MODEL = "WN + AR1"  # model of the J test, which leaves the tone out


@dataclass(frozen=True)
class Tone:
    """A sinusoid that all sensors pick up with different amplitudes.

    Attributes:
        frequency_hz: Frequency, Hz.
        amplitude: Amplitude in standard deviations of the noise between samples: too weak for the J test and for
            single wavelet variances.
        shares: Share of the amplitude in each sensor; the last sensor is free of the tone.
    """

    frequency_hz: float = 2.137
    amplitude: float = 0.05
    shares: tuple[float, ...] = (1.0, 0.7, 0.2, 1.2, 0.5, 0.0)


@dataclass(frozen=True)
class Drift:
    """A bias that follows the temperature of the board, which comes along with the recording.

    Attributes:
        coefficient: Standard deviations of the noise between samples, per K.
        shares: Share of the coefficient in each sensor, with its sign.
    """

    coefficient: float = 0.1
    shares: tuple[float, ...] = (1.0, -0.6, 0.8, 0.3, -1.0, 0.5)

    @staticmethod
    def temperature(n_samples: int) -> Tensor:
        """Temperature of a board that warms up, while the room gets colder and warmer again, deg C, `(time,)`."""
        t = torch.linspace(0.0, 1.0, n_samples, dtype=torch.float64)
        return 24.0 + 6.0 * (1 - (-8 * t).exp()) - 3.0 * (3 * torch.pi * t).sin()


def concealed(array: ArrayModel, n_samples: int, rate: float, unit: str, generator: torch.Generator) -> Recording:
    """A recording of the array with a weak tone, and a bias that follows the temperature.

    Args:
        array: Noise model of the six sensors.
        n_samples: Number of samples; at most 65,536 are made.
        rate: Sampling rate, Hz.
        unit: Unit of the array's signals.
        generator: Source of randomness.
    """
    tone, drift, n_samples = Tone(), Drift(), min(n_samples, _MAX_SAMPLES)
    noise = array.simulate(n_samples, generator=generator)
    sd = noise.diff().std(-1) / 2**0.5
    amplitude = tone.amplitude * sd * torch.tensor(tone.shares, dtype=torch.float64)
    coefficient = drift.coefficient * sd * torch.tensor(drift.shares, dtype=torch.float64)
    phase = 2 * torch.pi * tone.frequency_hz / rate * torch.arange(n_samples, dtype=torch.float64)
    temperature = drift.temperature(n_samples)
    signal = noise + amplitude[:, None] * phase.cos() + coefficient[:, None] * temperature
    return Recording(signal, rate=rate, unit=unit, channels={"temperature": temperature})


def mismatch_story(recording: Recording, report: MismatchReport) -> str:
    """Text: results of the ordinary tests, which miss both effects, and of the diagnosis, which finds them.

    Args:
        recording: Recording with the tone and the drift.
        report: Diagnosis of the recording against the simulation without them.
    """
    tone, drift = Tone(), Drift()
    loudest = tone.shares.index(max(tone.shares))
    fit = fit_gmwm(recording.select(sensors=[loudest]), _MODEL)
    z = report.variances[0].z
    paragraphs = [
        f"Two concealed effects: another {number(recording.duration / 3600, 3)} h of the same array hold a tone at "
        f"{tone.frequency_hz:g} Hz with up to {tone.amplitude * max(tone.shares):g} of the noise's standard "
        f"deviation, and a bias that follows the temperature with up to {drift.coefficient:g} of it per K. The "
        "simulation of the array leaves both out.",
        f"The ordinary view: the J test of {_MODEL} for sensor {recording.sensors[loudest]}, which has most of it, "
        f"{_judged(fit.p_value)}. Of {int(z.isfinite().sum())} wavelet variances of recording and simulation none is "
        f"further apart than {number(float(z[z.isfinite()].abs().max()), 2)} standard deviations.",
    ]
    head = "The diagnosis, which knows nothing of them but the channel of the temperature:"
    return "\n\n".join([*(fill(text, 110) for text in paragraphs), f"{head}\n{report.summary()}"])


def _judged(p_value: Tensor) -> str:
    p = float(p_value[0])
    return f"{'sees nothing' if p > 0.05 else 'doubts the model'} (p = {number(p, 2)})" if p == p else "says nothing"
