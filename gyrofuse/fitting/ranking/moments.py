"""Structures fitted to the wavelet variances of records, each from where smaller ones ended.

Leaner than the fit of one model: without a search for several minima and without polishing, which many structures
too large for their record would spend on flat valleys.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gyrofuse._base.nnls import nonnegative_least_squares
from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.fit import N_REWEIGHTINGS, objective_of, relaxed_gmm, reweighted
from gyrofuse.fitting.moments.inference import Estimates, Fit, Inference, infer, infer_efficient
from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fitting.structure import ModelStructure, new_shape
from gyrofuse.noise.processes import Process


@dataclass(frozen=True, eq=False)
class MomentFit:
    """Minimum of `r' V^-1 r`, `V` that of the fit.

    Attributes:
        linear: `p`, `(item, process)`, signal^2.
        shape: `x`, `(item, shaped)`.
        objective: `r' V^-1 r`, `(item,)`.
        log_det: `ln det V`, of wavelet variances over the largest, `(item,)`.
        active: Parameters that are not at an edge, `(item,)`.
    """

    linear: Tensor
    shape: Tensor
    objective: Tensor
    log_det: Tensor
    active: Tensor


class Moments:
    """Wavelet variances of records.

    Args:
        variance: `(item, level)`, finite and > 0.
        n_samples: Length T of the records.
    """

    def __init__(self, variance: Tensor, n_samples: int) -> None:
        self.variance, self.n_samples = variance, n_samples
        self.size = variance.amax(-1, keepdim=True)
        self._target = variance / self.size
        levels = variance.shape[-1]
        self.records = SampleDesign((n_samples,), (levels,))
        self.tau, self.observations = self.records.tau.to(variance), self.records.observations.to(variance)
        self._diagonal = self.observations.sqrt() / self._target

    def fit(self, structure: ModelStructure, starts: list[Tensor]) -> MomentFit:
        """Climb down from each `x` `(item, shaped)` with weights of the fit: one by one, then its own `V`."""
        target, tau = self._target, self.tau
        ends = [self._climbed(structure, start) for start in starts]
        lowest = torch.stack([objective.nan_to_num(nan=torch.inf) for *_, objective in ends]).argmin(0)
        items = torch.arange(len(target), device=target.device)
        linear, x = (torch.stack(column)[lowest, items] for column in list(zip(*ends, strict=True))[:2])
        passed = []
        for _ in range(N_REWEIGHTINGS):
            root = self._whitening(structure, linear, x)
            passed.append(objective_of(target, root, tau, structure, linear, x))
            linear, x, _, _ = search.minimise(target, root, tau, structure, x)
        final = objective_of(target, self._whitening(structure, linear, x), tau, structure, linear, x)
        # An objective one half nat above the best one on the way: reweighting oscillates.
        oscillating = final > torch.stack(passed).amin(0) + 1.0
        if bool(oscillating.any()):
            linear[oscillating], x[oscillating], _ = relaxed_gmm(
                target[oscillating], self.records, structure, "optimal", linear[oscillating], x[oscillating]
            )
        return self._summed_up(structure, linear, x, self._whitening(structure, linear, x))

    def _climbed(self, structure: ModelStructure, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Fit with independent levels, whose weights are first the measured variances, then the fitted ones."""
        linear, x, _, _ = search.minimise(self._target, self._diagonal, self.tau, structure, start)
        return reweighted(self._target, self.observations, self.tau, structure, linear, x)

    def near(self, structure: ModelStructure, linear: Tensor, shape: Tensor) -> MomentFit:
        """Minimum next to a maximum of the likelihood, with the `V` of that."""
        root = self._whitening(structure, linear / self.size, shape)
        linear, x, _, _ = search.minimise(self._target, root, self.tau, structure, shape, n_steps=10)
        # The maximum is the better estimate, and so is its V.
        return self._summed_up(structure, linear, x, root)

    def part(self, items: Tensor) -> Moments:
        """Of some items."""
        return Moments(self.variance[items], self.n_samples)

    def _summed_up(self, structure: ModelStructure, linear: Tensor, x: Tensor, root: Tensor) -> MomentFit:
        target, tau = self._target, self.tau
        residual = target - structure.wavelet_variance(tau, linear, x)
        objective = (root @ residual[..., None]).square().sum((-2, -1))
        log_det = -2 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        present = linear > 0
        active = (present.sum(-1) + present[:, structure.free_nonlinear].sum(-1)).to(linear)
        linear, x = structure.ordered(linear * self.size, x)
        return MomentFit(linear, x, objective, log_det, active)

    def estimates(self, structure: ModelStructure, fit: MomentFit) -> Estimates:
        """Parameters with their uncertainty."""
        return infer(self._at(fit.linear, fit.shape), structure, 0.95).estimates

    def against(
        self, structure: ModelStructure, p: Tensor, x: Tensor, covariance: Tensor, edge_sd: Tensor
    ) -> Inference:
        """Efficient estimates from elsewhere, with their uncertainty as in `infer_efficient`, and their J test."""
        return infer_efficient(self._at(p, x), structure, covariance, edge_sd, 0.95)

    def _at(self, linear: Tensor, shape: Tensor) -> Fit:
        done = torch.ones(len(linear), dtype=torch.bool, device=linear.device)
        return Fit(self.variance, linear, shape, shape[:, :0], done, "optimal", self.records)

    def roots(self, structure: ModelStructure) -> list[Tensor]:
        """Starts of a structure with at most one shaped process: the best points of a grid."""
        weight = self._diagonal.square()
        held = self._target.new_empty(len(self._target), 0)
        found = search.starting_points(self._target, weight, self.tau, structure, held, 4)
        return list(found.unbind(1))

    def widened(self, parent: ModelStructure, fit: MomentFit, structure: ModelStructure) -> Tensor:
        """Start of a structure with one process more, a further shape where variances with it fit best."""
        at = new_shape(parent, structure)
        if at is None:
            return fit.shape
        grid = self._grid(type(structure.processes[structure.nonlinear[at]]))
        tried = fit.shape[:, None].expand(-1, len(grid), -1)
        new = grid[:, None].expand(len(fit.shape), -1, 1)
        tried = torch.cat([tried[..., :at], new, tried[..., at:]], -1)  # (item, point, shaped)
        columns = structure.columns(self.tau, tried) * self._diagonal[:, None, :, None]
        wanted = (self._target * self._diagonal)[:, None, :, None]
        linear = nonnegative_least_squares(columns.mT @ columns, (columns.mT @ wanted)[..., 0])
        misfit = (wanted - columns @ linear[..., None]).square().sum((-2, -1))
        return tried[torch.arange(len(tried), device=tried.device), misfit.argmin(-1)]

    def _grid(self, kind: type[Process], n_points: int = 48) -> Tensor:
        """`x` of a process on all scales of the record, some three points an octave."""
        longest, shortest = kind.time_scales(float(self.tau[-1]))
        steps = torch.linspace(0, 1, n_points, dtype=torch.float64, device=self.tau.device)
        return search.with_alternating(kind, kind.from_time_scale(longest * (shortest / longest) ** steps))

    def _whitening(self, structure: ModelStructure, linear: Tensor, x: Tensor) -> Tensor:
        return search.whitening(self.records.covariance(structure.model(linear, x)))
