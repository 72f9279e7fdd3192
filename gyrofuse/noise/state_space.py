"""A noise model as a linear system with matrices `F`, `Q`, `H`, `R`, and its exact Gaussian likelihood."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.checks import check_floating, check_positive
from gyrofuse.noise.processes import Model

# Largest number of samples that one step of the likelihood takes together: their covariance is factored once.
_LARGEST_BLOCK = 256


@dataclass(frozen=True, eq=False)
class StateSpace:
    """A noise model as a linear system with independent noises, one step per sample.

        x_k = F x_{k-1} + w_k,  w_k ~ N(0, Q)
        y_k = H x_k + v_k,      v_k ~ N(0, R),  k = 1..T

    `x_0`, one step before the first sample, has mean `x0` and covariance `P0`: that of the stationary law where there
    is one, 0 for a random walk, which starts from 0 as in `Model.simulate`; to let a filter find an unknown turn-on
    bias, enlarge it. First and second moments of `y` are those of the model. A tone of random phase is not Gaussian:
    here it has a random amplitude too, with the same autocovariance.

    Attributes:
        F: `(..., state, state)`.
        Q: `(..., state, state)`, signal^2 (per sample^2 for the slope of a drift).
        H: `(..., 1, state)`.
        R: `(..., 1, 1)`, signal^2.
        x0: `(..., state)`; other than 0 for a drift only.
        P0: `(..., state, state)`.
        states: Names of the states, such as `ar1_1` and `sinusoid_1.sine`.
        rate: Steps per second, Hz.
    """

    F: Tensor
    Q: Tensor
    H: Tensor
    R: Tensor
    x0: Tensor
    P0: Tensor
    states: tuple[str, ...]
    rate: float

    def kalman_log_likelihood(self, signal: Tensor) -> Tensor:
        """Exact Gaussian log-likelihood of recordings, in nats, differentiable in the model and the signal.

        The Kalman filter takes many samples in one step: they are one observation of the state before them, whose
        noise has the same covariance in each step and is whitened once. This is exact whether or not the filter has a
        steady state, which tones keep it from.

        Args:
            signal: `(..., time)`, without missing samples; its leading dimensions broadcast with the model's.

        Returns:
            `(...)`, float64; NaN for a model with NaN parameters.

        Raises:
            TypeError: `signal` is not a floating point tensor.
            ValueError: `signal` is empty or has missing samples, or the model has no noise that would give it a
                density, as a tone alone.

        References:
            Anderson and Moore, Optimal Filtering, chapter 5.
        """
        check_floating("signal", signal)
        if signal.ndim == 0 or signal.shape[-1] == 0:
            raise ValueError(f"`signal`: expected (..., time) with samples, got shape {tuple(signal.shape)}")
        if not bool(signal.isfinite().all()):
            raise ValueError(
                "`signal`: expected finite samples, got some that are missing or infinite; fill or cut them out first"
            )
        n_samples = signal.shape[-1]
        # as many samples in a step as steps, while a step's covariance is cheap to factor
        length = min(math.isqrt(n_samples - 1) + 1, _LARGEST_BLOCK)
        block = self._block(length)
        y = pad(signal.double(), (0, -n_samples % length)).unflatten(-1, (-1, length))  # (..., block, time)
        # What comes after the end does not reach back: whitening is causal.
        whitened = torch.linalg.solve_triangular(block.root.mT, y, upper=True, left=False)
        log_root = block.root.diagonal(dim1=-2, dim2=-1).log()
        mean, covariance = self.x0[..., None], self.P0  # (..., state, 1), (..., state, state)
        eye = torch.eye(len(self.states), dtype=torch.float64, device=self.F.device)
        distances, determinants = [], []
        for start, z in zip(range(0, n_samples, length), whitened.unbind(-2), strict=True):
            rows = min(length, n_samples - start)
            observe = block.observe[..., :rows, :]
            innovation = z[..., :rows, None] - observe @ mean
            # Their covariance is I + O P O'; by the matrix inversion lemma only the state's dimension is inverted.
            score = observe.mT @ innovation
            ratio = eye + covariance @ (observe.mT @ observe)
            after = torch.linalg.solve(ratio, covariance)  # of x_0, given the block
            gained = after @ score
            distances.append((innovation.square().sum(-2) - (score * gained).sum(-2))[..., 0])
            determinants.append(ratio)
            if rows == length:
                mean = block.advance @ mean + block.decorrelated @ gained + block.shared @ innovation
                covariance = block.decorrelated @ after @ block.decorrelated.mT + block.rest
                covariance = (covariance + covariance.mT) / 2
        distance = torch.stack(distances, -1).sum(-1)
        log_det = torch.logdet(torch.stack(determinants, -3)).sum(-1)
        for rows in {length, n_samples % length} - {0}:
            times = n_samples // length if rows == length else 1
            log_det = log_det + 2 * times * log_root[..., :rows].sum(-1)
        return -(distance + log_det + n_samples * math.log(2 * math.pi)) / 2

    def _block(self, length: int) -> _Block:
        """`length` samples as one observation of the state before them."""
        F, Q, H, R = self.F, self.Q, self.H, self.R
        eye = torch.eye(len(self.states), dtype=F.dtype, device=F.device).expand_as(F)
        # F^i and the covariance of x_i given x_0, i = 1..length, twice as many at a time
        power, noise_cov = F[..., None, :, :], Q[..., None, :, :]
        while power.shape[-3] < length:
            noise_cov = torch.cat([noise_cov, noise_cov + power @ noise_cov[..., -1:, :, :] @ power.mT], -3)
            power = torch.cat([power, power @ power[..., -1:, :, :]], -3)
        power, noise_cov = power[..., :length, :, :], noise_cov[..., :length, :, :]
        before = torch.cat([eye[..., None, :, :], power[..., :-1, :, :]], -3)  # F^0 .. F^(length-1)
        output = H[..., None, :, :]
        seen, seen_before = (output @ power)[..., 0, :], (output @ before)[..., 0, :]  # H F^i: (..., length, state)
        reached = noise_cov @ output.mT  # Cov(x_i, y_i): (..., length, state, 1)
        # Cov(y_i, y_k) = H F^(k-i) Cov(x_i, y_i), k >= i. Row i of the product over i and lag moves right by i: in rows
        # that are one shorter, what follows begins one later in each.
        by_lag = pad(reached[..., 0] @ seen_before.mT, (0, length))  # (..., i, lag)
        moved = by_lag.flatten(-2)[..., : length * (2 * length - 1)].unflatten(-1, (length, 2 * length - 1))
        upper = moved[..., :length]
        noise = upper + upper.triu(1).mT + R * torch.eye(length, dtype=R.dtype, device=R.device)
        unknown = ~noise.isfinite().all(-1).all(-1)[..., None, None]
        root, failed = torch.linalg.cholesky_ex(torch.where(unknown, torch.eye(length).to(noise), noise))
        if bool(failed.any()):
            items = [tuple(item) for item in failed.nonzero().tolist()]
            where = f" at batch item(s) {', '.join(map(str, items[:5]))} ({len(items)} of {failed.numel()})"
            raise ValueError(
                "`model`: expected noise in every sample, got a model that leaves some without"
                f"{where if failed.ndim else ''}; add WhiteNoise with a variance > 0"
            )
        root = torch.where(unknown, torch.nan, root)
        observe = torch.linalg.solve_triangular(root, seen, upper=False)
        # Cov(x_length, y_i) = F^(length-i) Cov(x_i, y_i)
        shared = (before.flip(-3) @ reached)[..., 0].mT
        shared = torch.linalg.solve_triangular(root.mT, shared, upper=True, left=False)
        advance = power[..., -1, :, :]
        rest = noise_cov[..., -1, :, :] - shared @ shared.mT
        return _Block(root, observe, advance, shared, advance - shared @ observe, rest)


class _Block(NamedTuple):
    """Whitened samples `z = O x_0 + e` of one step and the state after them, `x = A x_0 + C z + r`.

    Attributes:
        root: Cholesky factor of the samples' covariance given the state, `(..., time, time)`.
        observe: `O`, `(..., time, state)`.
        advance: `A + C O`, the transition over the step, `(..., state, state)`.
        shared: `C`, covariance of the state's noise and `e`, `(..., state, time)`.
        decorrelated: `A`, `(..., state, state)`.
        rest: Covariance of `r`, `(..., state, state)`.
    """

    root: Tensor
    observe: Tensor
    advance: Tensor
    shared: Tensor
    decorrelated: Tensor
    rest: Tensor


def state_space(model: Model, rate: float) -> StateSpace:
    """Write a model as a linear system with one step per sample.

    A random walk and an AR(1) take one state, quantisation noise, a sinusoid, a drift and a second-order Gauss-Markov
    process two, white noise none. The parameters are those of samples, so that nothing is discretised. Flicker noise
    alone is approximated: by 12 AR1s and a random walk, with its spectrum within 0.4 % from 2e-6 cycles per sample on.

    Args:
        model: Parameters may have batch dimensions `(...)`; the matrices keep them and are differentiable.
        rate: Sampling rate, Hz.

    Raises:
        ValueError: A parameter is to be estimated.
    """
    rate = check_positive("rate", rate)
    params = model.params  # of the whole model, for a message with full names
    batch = params.shape[:-1]
    colored = [process for process in model.processes if not process.white]
    parts = [p._states(**dict(zip(p.parameters, p.params.unbind(-1), strict=True))) for p in colored]
    n_states = sum(len(part.names) for part in parts)
    F, Q, P0 = (params.new_zeros(*batch, n_states, n_states) for _ in range(3))
    H, x0 = params.new_zeros(*batch, 1, n_states), params.new_zeros(*batch, n_states)
    R = params.new_zeros(*batch, 1, 1)
    for process in model.processes:
        R = R + process.params[..., None] if process.white else R
    names: list[str] = []
    seen: Counter[str] = Counter()
    for process, part in zip(colored, parts, strict=True):
        seen[process.key] += 1
        own = slice(len(names), len(names) + len(part.names))
        F[..., own, own], Q[..., own, own], P0[..., own, own] = part.F, part.Q, part.P0
        H[..., 0, own] = H.new_tensor(part.output)
        if part.x0 is not None:
            x0[..., own] = part.x0
        prefix = f"{process.key}_{seen[process.key]}" if process.repeatable else process.key
        names += [f"{prefix}.{name}" if name else prefix for name in part.names]
    return StateSpace(F, Q, H, R, x0, P0, tuple(names), rate)
