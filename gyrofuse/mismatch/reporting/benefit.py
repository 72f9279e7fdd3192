"""What taking the findings off a recording does for its virtual gyro."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.results import cleaned
from gyrofuse.fusion.weights.svo import ScaleWeights, resolve_scale_weights, svo_weights
from gyrofuse.wavelets.covariance import wavelet_cross_covariance


@dataclass(frozen=True, eq=False)
class Benefit:
    """Weights and wavelet variances of the virtual gyro, as recorded and with the findings taken off.

    Either has the weights that are best for it, so that both are fitted alike to this very recording.

    Attributes:
        scale_weights: `(level,)`.
        before: Weights for the recording, `(sensor,)`.
        after: Weights for the corrected recording, `(sensor,)`.
        variance_before: Wavelet variance of the virtual gyro of the recording, `(level,)`, signal^2.
        variance_after: The same of the corrected recording with its own weights.
    """

    scale_weights: Tensor
    before: Tensor
    after: Tensor
    variance_before: Tensor
    variance_after: Tensor

    @property
    def factor(self) -> float:
        """How many times smaller the wavelet variance is, summed with the scale weights."""
        before, after = (float(self.scale_weights @ v) for v in (self.variance_before, self.variance_after))
        return before / after

    @property
    def level_factor(self) -> Tensor:
        """The same level by level, `(level,)`."""
        return self.variance_before / self.variance_after

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, ready for JSON."""
        tensors = {
            "scale_weights": self.scale_weights,
            "before": self.before,
            "after": self.after,
            "level_factor": self.level_factor,
        }
        return cleaned({name: value.tolist() for name, value in tensors.items()} | {"factor": self.factor})


def benefit(recording: Tensor, corrected: Tensor, scale_weights: ScaleWeights) -> Benefit:
    """Fuse a recording `(sensor, time)` before and after correction.

    Args:
        recording: As it came.
        corrected: Without what can be taken off it.
        scale_weights: `"flat"`, `"short"`, `"long"`, or one number >= 0 per level.
    """
    moments = [wavelet_cross_covariance(signal) for signal in (recording, corrected)]
    omega = resolve_scale_weights(scale_weights, len(moments[0]))
    weights = [svo_weights(wccv, omega) for wccv in moments]
    variances = [torch.einsum("i,jik,k->j", w, wccv, w) for w, wccv in zip(weights, moments, strict=True)]
    return Benefit(omega, *weights, *variances)
