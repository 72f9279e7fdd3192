"""A path that is known up to its amplitudes, on top of what a sensor has of its own: of channels, or in turns."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from gyrofuse.mismatch.mechanisms.mechanism import Mechanism
from gyrofuse.mismatch.signals.comparison import Comparison, RecordingInfo


class KnownPath(Mechanism):
    """`x_i(t) = path_i(t)`, known where the channels are that it follows."""

    likelihood: ClassVar[str] = "known paths"
    known_path: ClassVar[bool] = True
    additive: ClassVar[bool] = True

    def _path(self, info: RecordingInfo, n_samples: int) -> Tensor:
        """In every sensor, `(sensor, time)`."""
        raise NotImplementedError

    def apply(self, signal: Tensor, info: RecordingInfo, generator: torch.Generator) -> Tensor:
        return signal + self._path(info, signal.shape[-1])

    def remove(self, signal: Tensor, info: RecordingInfo) -> Tensor:
        return signal - self._path(info, signal.shape[-1])

    def repair(self, comparison: Comparison, generator: torch.Generator) -> Comparison:
        return comparison.subtract(self._path(comparison.info, comparison.n_samples))
