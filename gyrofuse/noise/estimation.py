"""What the numbers of a noise model were estimated from, and how far they may be off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gyrofuse._base.checks import check_positive_integer
from gyrofuse._base.results import listed


@dataclass(frozen=True, eq=False)
class EstimatedFrom:
    """Record behind a fitted model.

    Attributes:
        n_samples: Length of the record of each sensor, or of all records together.
        param_cov: Covariance of the model's parameters in their own order, `(..., parameter, parameter)` with the batch
            dimensions of the parameters; zero rows for variances that were estimated as zero. None where only the
            length of the record is known.
    """

    n_samples: int
    param_cov: Tensor | None = None

    def __post_init__(self) -> None:
        check_positive_integer("n_samples", self.n_samples)

    def scaled(self, scale: Tensor) -> EstimatedFrom:
        """The record behind the model whose parameters are multiplied by factors.

        Args:
            scale: Factors, `(parameter,)`.
        """
        if self.param_cov is None:
            return self
        return replace(self, param_cov=self.param_cov * (scale[:, None] * scale))

    def fits(self, shape: Sequence[int]) -> bool:
        """Whether the covariance is that of parameters of a shape.

        Args:
            shape: Shape of the parameters, `(..., parameter)`.
        """
        return self.param_cov is None or tuple(self.param_cov.shape) == (*shape, *shape[-1:])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists; entries of the covariance that are not known are None."""
        return {
            "n_samples": self.n_samples,
            "param_cov": None if self.param_cov is None else listed(self.param_cov),
        }

    @classmethod
    def from_dict(cls, description: Mapping[str, Any] | None) -> EstimatedFrom | None:
        """Read back what `to_dict` gave; None stays None.

        Args:
            description: Output of `to_dict`.

        Raises:
            ValueError: Without the entry `n_samples`, or it is no positive integer.
        """
        if description is None:
            return None
        if "n_samples" not in description:
            raise ValueError(
                f"`estimated_from`: expected the entries n_samples and param_cov, got {sorted(description)}; leave "
                "`estimated_from` out of a model whose numbers are known"
            )
        covariance = description.get("param_cov")
        return cls(description["n_samples"], None if covariance is None else _tensor(covariance))


def _tensor(values: Any) -> Tensor:
    """Nested lists as float64, NaN for None."""

    def filled(entry: Any) -> Any:
        if isinstance(entry, list):
            return [filled(part) for part in entry]
        return torch.nan if entry is None else entry

    return torch.tensor(filled(values), dtype=torch.float64)
