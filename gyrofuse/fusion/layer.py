"""What layers whose weights are fitted to a recording share."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from gyrofuse.fusion.weights.svo import ScaleWeights, check_scale_weights


class FittedLayer(nn.Module):
    """Base of layers whose `fit` chooses weights and whose `forward` applies them.

    The weights are a buffer: they are saved in `state_dict`, follow `.to(...)`, and are not trained.

    Args:
        scale_weights: How much each level counts when the weights are fitted: `"flat"`, `"short"`, `"long"`, or one
            number >= 0 per level.
        **options: Options of the fit.
    """

    weights: Tensor

    def __init__(self, scale_weights: ScaleWeights, **options: Any) -> None:
        super().__init__()
        check_scale_weights(scale_weights)  # a wrong name is an error here, not when it is used
        self.scale_weights = scale_weights
        self.options = options
        self.register_buffer("weights", torch.empty(0, dtype=torch.float64))

    def keep(self, weights: Tensor) -> None:
        """Take over fitted weights.

        Args:
            weights: As fitted; a copy is kept.
        """
        with torch.inference_mode(False):  # so that they can be used in training later
            self.weights = weights.detach().clone()

    def check_fitted(self) -> None:
        """Raise where there are no weights yet.

        Raises:
            RuntimeError: Neither fitted nor loaded.
        """
        if self.weights.numel() == 0:
            raise RuntimeError(f"{type(self).__name__} has no weights yet: call fit(signal), or load a state_dict")

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        # The shape of the weights is known only from what is loaded.
        loaded = state_dict.get(prefix + "weights")
        if loaded is not None:
            self.weights = torch.empty_like(loaded, device=self.weights.device)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
