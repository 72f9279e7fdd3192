"""Non-negative least squares for many small problems at once."""

from __future__ import annotations

import torch
from torch import Tensor

_FULL_EXCHANGES = 3  # tries without progress before unknowns are exchanged one by one: Kim and Park's choice
_MOST_TURNS = 200  # of exchanges: 75,000 random problems of up to 20 unknowns took at most 10, more go in circles


def nonnegative_least_squares(gram: Tensor, moment: Tensor, start: Tensor | None = None) -> Tensor:
    """Minimise `c' G c / 2 - m' c` over `c >= 0`, by block principal pivoting.

    Of columns that are nearly dependent exchanges may go on for ever: what has not ended is left to active sets.

    Args:
        gram: `G`, `(..., unknown, unknown)`, positive semi-definite; `A' A` of a least-squares problem.
        moment: `m`, `(..., unknown)`; `A' b`.
        start: Which unknowns to begin with as free, `(..., unknown)`; all by default. It changes nothing but the time.

    Returns:
        `c`, `(..., unknown)`, with exact zeros.

    References:
        J. Kim, H. Park, SIAM Journal on Scientific Computing 33, 2011.
    """
    n = moment.shape[-1]
    size = gram.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(gram.dtype).tiny).sqrt()
    correlation = (gram / size[..., :, None] / size[..., None, :]).reshape(-1, n, n)
    target = (moment / size).reshape(-1, n)
    floor = 1e-12 * target.abs().amax(-1, keepdim=True)  # a slope below it is one of rounding
    eye = torch.eye(n, dtype=gram.dtype, device=gram.device)
    free = torch.ones_like(target, dtype=torch.bool) if start is None else start.reshape(-1, n).clone()
    fewest = torch.full_like(target[:, 0], n + 1)
    tries = torch.full_like(fewest, _FULL_EXCHANGES)
    order = torch.arange(n, device=gram.device)
    todo = torch.arange(len(target), device=gram.device)
    solution = torch.zeros_like(target)
    for _ in range(_MOST_TURNS):
        now = free[todo].to(gram.dtype)
        # Columns that two processes share to rounding: the smallest step off the edge keeps the system solvable.
        matrix = correlation[todo] * now[:, :, None] * now[:, None, :] + eye * (1 - now + 1e-14)[:, :, None]
        found = torch.linalg.solve_ex(matrix, target[todo] * now)[0]
        slope = (correlation[todo] @ found[..., None])[..., 0] - target[todo]
        solution[todo] = found * now
        wrong = torch.where(free[todo], found < 0, slope < -floor[todo])
        n_wrong = wrong.sum(-1).to(gram.dtype)
        fewer = n_wrong < fewest[todo]
        fewest[todo] = torch.where(fewer, n_wrong, fewest[todo])
        tries[todo] = torch.where(fewer, _FULL_EXCHANGES, tries[todo] - 1.0)
        # Without progress exchange one unknown only, the last: that ends (Murty).
        last = order == torch.where(wrong, order, -1).amax(-1, keepdim=True)
        swap = torch.where((tries[todo] >= 0)[:, None], wrong, wrong & last)
        free[todo] ^= swap
        todo = todo[n_wrong > 0]
        if not len(todo):
            break
    for item in todo.tolist():
        solution[item] = _by_active_sets(correlation[item], target[item], solution[item])
    return (solution.clamp(min=0) / size.reshape(-1, n)).view_as(moment)


def _by_active_sets(gram: Tensor, moment: Tensor, otherwise: Tensor) -> Tensor:
    """The same of one problem, by Lawson and Hanson's method, which ends whatever the columns, if numbers are finite.

    `otherwise` is the answer where they are not: one item does not stop a batch.
    """
    from scipy.optimize import nnls  # rarely needed, and slow to import

    if not bool(gram.isfinite().all() & moment.isfinite().all()):
        return otherwise
    values, vectors = torch.linalg.eigh(gram)
    kept = values > 500 * torch.finfo(gram.dtype).eps * values[-1]  # those below are lost in rounding
    root = values[kept].sqrt()
    design, wanted = root[:, None] * vectors[:, kept].mT, vectors[:, kept].mT @ moment / root
    try:
        found, _ = nnls(design.detach().cpu().numpy(), wanted.detach().cpu().numpy(), maxiter=_MOST_TURNS * len(moment))
    except RuntimeError:  # too many iterations
        return otherwise
    return torch.as_tensor(found, dtype=gram.dtype, device=gram.device)
