"""What layers whose weights are fitted to a recording share."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from gyrofuse.fusion.weights.svo import ScaleWeights, check_scale_weights


class FittedModule(nn.Module):
    """Base of modules whose buffers get their shapes from a fit, or from the `state_dict` that is loaded.

    A subclass names those buffers in `_fitted`; all are empty before, and the first stays so until then.
    """

    _fitted: ClassVar[tuple[str, ...]]

    def check_fitted(self) -> None:
        """Raise where there are no weights yet.

        Raises:
            RuntimeError: Neither fitted nor loaded.
        """
        if getattr(self, self._fitted[0]).numel() == 0:
            raise RuntimeError(f"{type(self).__name__} has no weights yet: call fit(signal), or load a state_dict")

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        for name in self._fitted:
            loaded = state_dict.get(prefix + name)
            if loaded is not None:
                setattr(self, name, torch.empty_like(loaded, device=getattr(self, name).device))
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


class FittedLayer(FittedModule):
    """Base of layers whose `fit` chooses weights and whose `forward` applies them.

    The weights are a buffer: they are saved in `state_dict`, follow `.to(...)`, and are not trained.

    Args:
        scale_weights: How much each level counts when the weights are fitted: `"flat"`, `"short"`, `"long"`, or one
            number >= 0 per level.
        **options: Options of the fit.
    """

    _fitted = ("weights",)
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
