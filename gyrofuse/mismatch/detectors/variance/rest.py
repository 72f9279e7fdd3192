"""Whether a recording is at rest from its beginning to its end: a hand that starts or stops it moves all sensors."""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse.mismatch.signals.comparison import Comparison


def rest_words(comparison: Comparison) -> str:
    """A sentence on a start or an end in which gyroscopes and accelerometers move together; empty where there is none.

    Accelerations are looked for among the channels by their name, `acc..`.
    """
    rows = [
        values.reshape(-1, values.shape[-1])
        for name, values in comparison.info.channels.items()
        if name.lower().startswith("acc")
    ]
    if not rows:
        return ""
    rest = stretch_at_rest(comparison.recording, torch.cat(rows), comparison.reference.signal[0])
    if rest is None:
        return ""
    first, end = (sample / comparison.info.rate for sample in rest)
    return (
        f"The recording is at rest from {first:.4g} s to {end:.4g} s only: before or after, gyroscopes and "
        "accelerometers move together. Diagnose that part; what follows holds for all of it."
    )


def stretch_at_rest(recording: Tensor, acceleration: Tensor, simulation: Tensor) -> tuple[int, int] | None:
    """First sample at rest and the one after the last; None where all is, or where what moves is no start and no end.

    A window of samples moves where half of the gyroscopes and some axis of the accelerometers are 2.5 times as loud as
    in the middle one of all windows; by chance one of 20 Gaussian samples is in 10^-16.

    Args:
        recording: `(sensor, time)`.
        acceleration: `(axis, time)`.
        simulation: `(sensor, time)`; what moves there as well is no start of the recording's own.
    """
    factor, n = 2.5, recording.shape[-1]
    window = max(n // 200, 20)
    moves = (_loudness(recording, window).median(0).values > factor) & (
        _loudness(acceleration.to(torch.float64), window).amax(0) > factor
    )
    if simulation.shape[-1] == n:
        moves &= ~(_loudness(simulation, window).median(0).values > factor)
    restless = moves.tolist()
    first, end = _run(restless), len(restless) - _run(restless[::-1])
    if end - first < len(restless) / 2 or (first, end) == (0, len(restless)):
        return None
    return first * window, n if end == len(restless) else end * window


def _loudness(signal: Tensor, window: int) -> Tensor:
    """Standard deviation of each window over the median of all, `(row, window)`."""
    n = signal.shape[-1] // window * window
    sd = signal[:, :n].unflatten(-1, (-1, window)).std(-1)
    return sd / sd.median(-1, keepdim=True).values.clamp(min=1e-300)


def _run(restless: list[bool]) -> int:
    """Windows up to the last one that moves, from the first one on, with single quiet ones between them."""
    end = 0
    for k, moves in enumerate(restless):
        if moves:
            end = k + 1
        elif k > end:
            break
    return end
