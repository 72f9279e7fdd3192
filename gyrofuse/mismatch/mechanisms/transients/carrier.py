"""Amplitudes of a tone whose phase is known but for a slow course: complex ones at knots, on straight lines between."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Carrier(NamedTuple):
    """`x_i(t) = Re A_i(t) e(t)` with `|e| = 1`, and `A` on straight lines between knots.

    Attributes:
        first: Sample at which it begins.
        inside: Knot before each of its samples, `(time,)`.
        weights: Of that knot and of the next, two of `(time,)`.
        turn: `e`, `(time,)`.
        n_knots: Number of knots.
    """

    first: int
    inside: Tensor
    weights: tuple[Tensor, Tensor]
    turn: Tensor
    n_knots: int

    @classmethod
    def even(cls, turn: Tensor, n_knots: int) -> Carrier:
        """With knots evenly over a record, at its ends the first and the last; a single one stands for all."""
        n = len(turn)
        place = torch.linspace(0, max(n_knots - 1, 0), n, dtype=torch.float64)
        inside = place.long().clamp(max=max(n_knots - 2, 0))
        return cls(0, inside, (1 - (place - inside), place - inside), turn, n_knots)

    def amplitudes(
        self, signal: Tensor, scale: Tensor, keep: Tensor | None = None, grown: Tensor | None = None
    ) -> Tensor:
        """Those of one source in signals `(sensor, time)` of a mean of zero, complex `(knot, sensor)`.

        Args:
            signal: Of the whole record.
            scale: Standard deviations of the noise, `(sensor,)`.
            keep: Samples that count, `(time,)`; by default all.
            grown: What amplitudes are multiplied with, `(time,)`; by default one.
        """
        here = slice(self.first, self.first + len(self.turn))
        kept, own = self._kept(keep), self._kept(grown)
        seen = torch.zeros(self.n_knots, len(signal), dtype=torch.complex128)
        turned = 2 * (signal[:, here] * kept * own * self.turn.conj()).mT  # (time, sensor)
        for side, weight in enumerate(self.weights[: self.n_knots]):
            seen.index_add_(0, self.inside + side, weight[:, None] * turned)
        amplitude = torch.linalg.solve(self._gram(kept * own.square()).to(seen.dtype), seen)
        if len(scale) == 1:
            return amplitude
        u, s, v = torch.linalg.svd(amplitude / scale, full_matrices=False)
        return s[0] * u[:, :1] * v[:1] * scale

    def _gram(self, kept: Tensor) -> Tensor:
        """Of the normal equations, `(knot, knot)`; a knot beyond the record has next to nothing."""
        k = self.n_knots
        gram = torch.zeros(k, k, dtype=torch.float64)
        for side, weight in enumerate(self.weights[:k]):
            for other, its in enumerate(self.weights[:k]):
                gram.index_put_((self.inside + side, self.inside + other), weight * its * kept, accumulate=True)
        return gram + 1e-2 * gram.diagonal().max() * torch.eye(k, dtype=torch.float64)

    def by_noise(self) -> Tensor:
        """Squared amplitude that noise makes of one course at each knot, in units of its density, `(knot,)`."""
        return 4 * torch.linalg.inv(self._gram(self._kept(None))).diagonal()

    def path(self, amplitude: Tensor, n_samples: int) -> Tensor:
        """Of amplitudes `(knot, sensor)`, `(sensor, time)`."""
        here = sum(
            weight[:, None] * amplitude[self.inside + k] for k, weight in enumerate(self.weights[: self.n_knots])
        )
        path = torch.zeros(amplitude.shape[-1], n_samples, dtype=torch.float64)
        path[:, self.first : self.first + len(self.turn)] = (here * self.turn[:, None]).real.mT
        return path

    def _kept(self, keep: Tensor | None) -> Tensor:
        """Factors of its own samples."""
        if keep is None:
            return torch.ones(len(self.turn), dtype=torch.float64)
        return keep[self.first : self.first + len(self.turn)].to(torch.float64)
