"""Choice between methods by held-out risk: the variance that weights leave in data that they were not fitted to.

The levels that long scale weights depend on do not fit into a part of the recording. So time is compressed: with the
recording cut into `2^s` blocks, weights are fitted to one block with the scale weights moved `s` levels down, where a
level holds as many observations in a block as `s` levels higher in the recording, and judged by the other blocks,
`c' A c` with their covariance `A`. Where blocks hold the levels of the scale weights, these are not moved, and more
blocks are fitted to than left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gyrofuse._base.checks import check_signal, largest_level
from gyrofuse._base.results import Result
from gyrofuse.fusion.weights.methods import ESTIMATORS
from gyrofuse.wavelets.covariance import wavelet_products
from gyrofuse.wavelets.moments import combined_covariance

# The smoothest first: it is kept unless another one is clearly better.
CANDIDATES = ("model_assisted", "shrinkage", "svo")


@dataclass(frozen=True, eq=False)
class Selection(Result):
    """Held-out risks of several methods, and the method chosen. Batched as the signal.

    Attributes:
        candidates: Names of the methods; the first is preferred unless another is better.
        risk: `(..., candidate)`, held-out `c' A c` over that of the first candidate, geometric mean over the folds;
            NaN where the record is too short for folds.
        standard_error: `(..., candidate)`, of the logarithm of `risk`.
        chosen: `(...)`, index of the candidate chosen: the first, or the best of those whose risk is lower by more than
            three standard errors; the last where the recording is too short for folds.
        n_folds: `(...)`, folds that could be used.
        n_blocks: Blocks that the record was cut into.
        levels_down: How many levels down the scale weights were moved.
    """

    candidates: tuple[str, ...]
    risk: Tensor
    standard_error: Tensor
    chosen: Tensor
    n_folds: Tensor
    n_blocks: int
    levels_down: int

    _batched = ("risk", "standard_error", "chosen", "n_folds")
    _contents = tuple("candidates risk standard_error chosen n_folds n_blocks levels_down sentence".split())

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Leading dimensions; `()` for a single array."""
        return tuple(self.chosen.shape)

    def reshape(self, batch: Sequence[int]) -> Selection:
        """The same items in other batch dimensions.

        Args:
            batch: Dimensions of the new batch.
        """
        n = self.chosen.ndim
        values = {name: getattr(self, name) for name in self._batched}
        return replace(self, **{name: v.reshape((*batch, *v.shape[n:])) for name, v in values.items()})

    @property
    def sentence(self) -> str:
        """What was chosen and why, in one sentence."""
        chosen = self.chosen.flatten()
        if len(chosen) > 1:
            shares = ", ".join(
                f"{name} for {int((chosen == i).sum())}"
                for i, name in enumerate(self.candidates)
                if bool((chosen == i).any())
            )
            return f"Chosen by held-out data: {shares} of {len(chosen)} arrays."
        name, first = self.candidates[int(chosen)], self.candidates[0]
        if not bool(self.risk.isfinite().all()):
            return f"Chosen: {name}, for the record is too short to hold data out."
        if int(chosen):
            lower = self._change(int(chosen)).lstrip("-")
            return f"Chosen: {name}, whose risk on held-out data is {lower} lower than that of {first}."
        others = ", ".join(f"{other} {self._change(i)}" for i, other in enumerate(self.candidates[1:], 1))
        return f"Chosen: {name}, for no other has a clearly lower risk on held-out data ({others})."

    def summary(self) -> str:
        """Held-out risks and the choice as text; of a batch the choices alone."""
        if self.chosen.numel() != 1:
            return self.sentence
        down = f", scale weights {self.levels_down} levels down" if self.levels_down else ""
        lines = [f"Held-out risk over {int(self.n_folds)} folds of {self.n_blocks} blocks{down}"]
        for i, name in enumerate(self.candidates):
            mark = "  chosen" if i == int(self.chosen) else ""
            lines.append(f"  {name:<17}{self._change(i) if i else 'the measure':>18}{mark}")
        return "\n".join([*lines, self.sentence])

    def _change(self, candidate: int) -> str:
        risk, error = (v.flatten()[candidate].item() for v in (self.risk, self.standard_error))
        return f"{100 * (risk - 1):+.3g} +- {100 * risk * error:.2g} %"


def select_estimator(
    signal: Tensor, scale_weights: Tensor, candidates: Sequence[str] = CANDIDATES, *, n_blocks: int = 8
) -> Selection:
    """Choose between methods by their risk on held-out blocks of time.

    Args:
        signal: `(..., sensor, time)`; NaN = missing sample.
        scale_weights: `(level,)`, sum 1, of the levels of the whole record.
        candidates: Names in `gyrofuse.fusion.weights.methods.ESTIMATORS`, the preferred one first.
        n_blocks: Blocks of time, a power of two. Eight move long scale weights three levels down at most.

    Returns:
        Risks, choice and reason.

    Raises:
        TypeError: `signal` is not a floating point tensor.
        ValueError: Bad shape, no or unknown candidates, or a number of blocks that is no power of two above 1.
    """
    check_signal("signal", signal)
    unknown = [name for name in candidates if name not in ESTIMATORS]
    if unknown or not candidates:
        raise ValueError(f"`candidates`: expected names among {', '.join(ESTIMATORS)}, got {list(candidates)}")
    if n_blocks < 2 or n_blocks & (n_blocks - 1):
        raise ValueError(f"`n_blocks`: expected a power of two, at least 2, got {n_blocks}")
    batch, length = signal.shape[:-2], signal.shape[-1] // n_blocks
    omega = scale_weights.double()
    down = _levels_down(omega, largest_level(length), n_blocks.bit_length() - 1)
    omega = omega[down : down + largest_level(length)]
    if not bool(omega.sum() > 0):
        nothing = torch.full((*batch, len(candidates)), torch.nan, dtype=torch.float64, device=signal.device)
        none = torch.zeros(batch, dtype=torch.int64, device=signal.device)
        return Selection(tuple(candidates), nothing, nothing, none + len(candidates) - 1, none, n_blocks, down)

    blocks = signal.detach()[..., : n_blocks * length].unflatten(-1, (n_blocks, length)).movedim(-2, -3)
    sums, counts = wavelet_products(blocks, len(omega))  # (..., block, level, sensor, sensor)
    omega = omega.to(sums) / omega.sum()
    # Each fold fits to as many blocks as hold what the record holds at the levels moved from, one after another.
    n_fitted = min(n_blocks >> down, n_blocks - 1)
    block = torch.arange(n_blocks, device=sums.device)
    fitted = ((block - block[:, None]) % n_blocks < n_fitted).to(sums)  # (fold, block)
    train, n_products = _pool(fitted, sums, counts)
    test, _ = _pool(1 - fitted, sums, counts)
    held_out = combined_covariance(test, omega)
    usable = _positive_definite(combined_covariance(train, omega)) & _positive_definite(held_out)  # (..., fold)
    train = torch.where(usable[..., None, None, None], train, torch.eye(train.shape[-1]).to(train))
    n_products = torch.where(usable[..., None], n_products, 1.0)
    risks = []
    for name in candidates:
        weights = ESTIMATORS[name](train, n_products, omega)
        risks.append(torch.einsum("...i,...ik,...k->...", weights, held_out, weights))
    relative = (torch.stack(risks, -1) / risks[0][..., None]).log()  # (..., fold, candidate)
    return _choose(relative, usable, tuple(candidates), n_blocks, down)


def _choose(relative: Tensor, usable: Tensor, candidates: tuple[str, ...], n_blocks: int, down: int) -> Selection:
    """The first candidate, unless others are clearly better; then the best of these.

    Clearly is by three standard errors. One is common in cross-validation, but folds share their blocks, and the levels
    moved to are not those of the scale weights: with one, a tone or rare jumps at a single level decide.
    """
    n_folds = usable.sum(-1)
    counted = torch.where(usable[..., None], relative, 0.0)
    mean = counted.sum(-2) / n_folds[..., None]
    squares = torch.where(usable[..., None], (relative - mean[..., None, :]).square(), 0.0).sum(-2)
    error = (squares / ((n_folds - 1) * n_folds)[..., None]).sqrt()
    enough = n_folds >= 3  # the standard error of fewer folds is hardly known
    mean, error = (torch.where(enough[..., None], v, torch.nan) for v in (mean, error))
    better = torch.where(mean < -3.0 * error, mean, torch.inf)
    better[..., 0] = 0.0
    chosen = torch.where(enough, better.argmin(-1), len(candidates) - 1)
    return Selection(candidates, mean.exp(), error, chosen, n_folds, n_blocks, down)


def _levels_down(omega: Tensor, n_block_levels: int, most: int) -> int:
    """The least move after which less than 5 % of the scale weights fall on the last two levels of a block or beyond.

    A block holds hardly an observation at its last two levels.
    """
    for down in range(most):
        if omega[max(n_block_levels - 2, 0) + down :].sum() < 0.05:
            return down
    return most


def _pool(which: Tensor, sums: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Cross-covariance over the blocks of each fold and how many products the pair of fewest has, `(..., level)`.

    A level at which some pair has no product is zero.
    """
    total = torch.einsum("fb,...bjik->...fjik", which, sums)
    number = torch.einsum("fb,...bjik->...fjik", which, counts)
    fewest = number.amin((-1, -2))
    return torch.where((fewest > 0)[..., None, None], total / number, 0.0), fewest


def _positive_definite(matrix: Tensor) -> Tensor:
    return torch.linalg.cholesky_ex(matrix).info == 0
