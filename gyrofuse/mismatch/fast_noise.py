"""What a noise level is of: the part of signals that is faster than a few dozen samples."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import avg_pool1d, pad

_SLOWER = 65  # samples: what varies more slowly is not louder


def with_level(signal: Tensor, level: Tensor) -> Tensor:
    """Signals `(..., sensor, time)` whose fast part has so many times its variance, `(sensor, time)`."""
    reach = min(_SLOWER, signal.shape[-1] // 2 * 2 - 1)
    padded = pad(signal.flatten(0, -2)[:, None], (reach // 2, reach // 2), mode="reflect")
    fast = signal - avg_pool1d(padded, reach, 1)[:, 0].reshape(signal.shape)
    return signal + (level.sqrt() - 1) * fast
