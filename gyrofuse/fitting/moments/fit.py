"""The search of a moment fit, from starting points to weights `V^-1`, for many records at once."""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.inference import Fit
from gyrofuse.fitting.moments.records import SampleDesign
from gyrofuse.fitting.structure import ModelStructure
from gyrofuse.noise.parsing import parse_model
from gyrofuse.noise.processes import Model, Process, Sinusoid

# Rounds of reweighting, of a fit with independent levels and again of one with the covariance of the fit. After three,
# nine of ten estimates of white noise, an AR1 and a random walk in 8192 samples are within 0.01 standard errors of
# those after eight.
N_REWEIGHTINGS = 3


def fit_batch(
    nu: Tensor,
    frequencies: tuple[Tensor, Tensor] | None,
    records: SampleDesign,
    structure: ModelStructure,
    omega: str | Tensor,
    *,
    n_distinct: int = 3,
    n_polishing: int = 500,
) -> Fit:
    """Fit all items at once.

    Args:
        nu: Wavelet variances `(item, level)`.
        frequencies: `beta` of the sinusoids and its standard error where the moments do not fit it, `(item, sinusoid)`,
            from high to low; None where they do.
        records: Lengths and levels of the records.
        structure: Structure of the model.
        omega: Weights `(level,)` or `(level, level)`, or `"optimal"` or `"diagonal"`.
        n_distinct: Number of distinct minima that are followed to the weights of the fit.
        n_polishing: Largest number of steps of the best of them; flat valleys need some hundreds.

    Returns:
        The fit, with AR1s from slow to fast and sinusoids from high to low frequency.
    """
    n_items = len(nu)
    tau, observations = records.tau.to(nu), records.observations.to(nu)
    # Scaled so that no record is small to rounding.
    size = nu.amax(-1, keepdim=True)
    nu = nu / size
    beta, held_sd = frequencies or (nu.new_empty(n_items, 0), nu.new_empty(n_items, 0))
    held = Sinusoid.to_unconstrained(beta.to(nu))
    own = omega.to(nu) if isinstance(omega, Tensor) else None
    weight = observations / nu.square() if own is None else (own if own.ndim == 1 else own.diagonal()).expand_as(nu)
    start = search.starting_points(nu, weight, tau, structure, held, n_starts_for(structure))  # (item, start, shaped)
    n_starts = start.shape[1]

    def each(value: Tensor, n: int) -> Tensor:
        return value[:, None].expand(-1, n, *value.shape[1:]).flatten(0, 1)

    root = weight.sqrt() if own is None or own.ndim == 1 else torch.linalg.cholesky(own).mT.expand(n_items, -1, -1)
    linear, x, objective, _ = search.minimise(
        each(nu, n_starts), each(root, n_starts), tau, structure, start.flatten(0, 1)
    )
    if own is None:
        linear, x, objective = reweighted(each(nu, n_starts), observations, tau, structure, linear, x)
    kept = search.distinct(objective.view(n_items, -1), x.view(n_items, n_starts, -1), n_distinct)
    n_kept = kept.shape[1]
    chosen = (torch.arange(n_items, device=nu.device)[:, None] * n_starts + kept).flatten()
    linear, x, objective = linear[chosen], x[chosen], objective[chosen]
    passed = []
    if own is None:
        for _ in range(N_REWEIGHTINGS):
            root = _root(records.covariance(structure.model(linear, x)), omega)
            passed.append(objective_of(each(nu, n_kept), root, tau, structure, linear, x))
            linear, x, distance, _ = search.minimise(each(nu, n_kept), root, tau, structure, x)
        objective = distance - _log_det(root)
    best = objective.view(n_items, n_kept).nan_to_num(nan=torch.inf).argmin(-1)
    best = best + n_kept * torch.arange(n_items, device=nu.device)
    root = root[best] if own is None else root
    linear, x, _, reached = search.minimise(nu, root, tau, structure, x[best], n_polishing)
    if own is None:
        final = objective_of(
            nu, _root(records.covariance(structure.model(linear, x)), omega), tau, structure, linear, x
        )
        least = torch.stack([value.view(n_items, n_kept).amin(-1) for value in passed]).amin(0)
        oscillating = final > least + len(tau)
        if bool(oscillating.any()):
            linear[oscillating], x[oscillating], reached[oscillating] = relaxed_gmm(
                nu[oscillating], records, structure, omega, linear[oscillating], x[oscillating]
            )
    linear, x = structure.ordered(linear, x)
    return Fit(
        variance=nu * size,
        linear=linear * size,
        shape=x,
        held_sd=held_sd.to(nu),
        converged=reached & linear.isfinite().all(-1),
        omega=omega,
        records=records,
    )


def reweighted(
    nu: Tensor, observations: Tensor, tau: Tensor, structure: ModelStructure, linear: Tensor, x: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Fits with independent levels, whose weights are those of the fit before.

    A fit to chance in the measured variances, such as one long scale that came out small, would have a `V` to match.

    Args:
        nu: Wavelet variances over the largest, `(problem, level)`.
        observations: Degrees of freedom of each level, `(level,)`.
        tau: Filter lengths, `(level,)`.
        structure: Structure of the model.
        linear: `p` of the first fit, `(problem, process)`.
        x: Its nonlinear parameters, `(problem, shaped)`.

    Returns:
        `p`, `x`, and the objective as minus twice the log likelihood of independent normal variances, which compares
        fits with different weights, `(problem,)`.
    """
    least, most_weight = 1e-30, 1e15  # of a fitted variance, and of a root weight: their squares stay in range
    for _ in range(N_REWEIGHTINGS):
        fitted = structure.wavelet_variance(tau, linear, x)
        root = (observations.sqrt() / fitted.clamp(min=least)).clamp(max=most_weight)
        linear, x, distance, _ = search.minimise(nu, root, tau, structure, x)
    return linear, x, distance - _log_det(root)


def relaxed_gmm(
    nu: Tensor,
    records: SampleDesign,
    structure: ModelStructure,
    omega: str | Tensor,
    linear: Tensor,
    x: Tensor,
    *,
    relaxation: float = 0.25,
    n_rounds: int = 60,
    at_rest: float = 1e-2,
) -> tuple[Tensor, Tensor, Tensor]:
    """Under-relaxation where iterated reweighting oscillates between bad fits, as where no parameters fit.

    Args:
        nu: Wavelet variances over the largest, `(item, level)`.
        records: Lengths and levels of the records.
        structure: Structure of the model.
        omega: `"optimal"` or `"diagonal"`.
        linear: `p` to start from, `(item, process)`.
        x: `x` to start from, `(item, shaped)`.
        relaxation: Part of every step that is taken: whole steps of -1 to -7 times the last do not come to rest, a
            quarter of them does.
        n_rounds: Largest number of reweightings.
        at_rest: Relative change of the fitted wavelet variances below which a fit has come to rest.

    Returns:
        `p`, `x` and whether they came to rest, `(item,)`.
    """
    tau = records.tau.to(nu)
    for _ in range(n_rounds):
        before = structure.wavelet_variance(tau, linear, x)
        root = _root(records.covariance(structure.model(linear, x)), omega)
        whole_linear, whole_x, _, _ = search.minimise(nu, root, tau, structure, x, n_steps=5)
        moved = (structure.wavelet_variance(tau, whole_linear, whole_x) / before - 1).abs().amax(-1)
        if bool((moved < at_rest).all()):
            break
        linear, x = linear.lerp(whole_linear, relaxation), x.lerp(whole_x, relaxation)
    return whole_linear, whole_x, moved < at_rest


def objective_of(
    target: Tensor, root: Tensor, tau: Tensor, structure: ModelStructure, linear: Tensor, x: Tensor
) -> Tensor:
    """`r' V^-1 r + ln det V`, `(problem,)`: a V too large would make its own fit look good.

    Args:
        target: Wavelet variances `(problem, level)`.
        root: `W` with `W' W = V^-1`, `(problem, level, level)`, or `(problem, level)` where it is diagonal.
        tau: Filter lengths, `(level,)`.
        structure: Structure of the model.
        linear: `p`, `(problem, process)`.
        x: `x`, `(problem, shaped)`.
    """
    residual = target - structure.wavelet_variance(tau, linear, x)
    whitened = root * residual if root.ndim == 2 else (root @ residual[..., None])[..., 0]
    return whitened.square().sum(-1) - _log_det(root)


def _log_det(root: Tensor) -> Tensor:
    """`ln det V^-1` from its factor."""
    return 2 * (root if root.ndim == 2 else root.diagonal(dim1=-2, dim2=-1)).log().sum(-1)


def _root(covariance: Tensor, omega: str | Tensor) -> Tensor:
    return covariance.diagonal(dim1=-2, dim2=-1).rsqrt() if omega == "diagonal" else search.whitening(covariance)


def n_starts_for(structure: ModelStructure) -> int:
    """Number of starting points: as many as found the lowest minimum of noisy copies every time."""
    tones = sum(structure.processes[k].has_line for k in structure.free_nonlinear)
    return min(
        4 * 4 ** (len(structure.free_nonlinear) - 1) if tones else (1, 4, 6, 8)[min(len(structure.free_nonlinear), 3)],
        32,
    )


def composition_of(model: Model | str, held: bool) -> ModelStructure:
    """Structure of a model without values.

    Args:
        model: Processes without values, or a formula.
        held: Whether frequencies of sinusoids are known from elsewhere.

    Raises:
        TypeError: Neither a model nor a formula.
        ValueError: A model with values.
    """
    model = parse_model(model) if isinstance(model, str) else model
    if not isinstance(model, Model):
        raise TypeError(f"`model`: expected a model or a formula such as 'WN + AR1 + RW', got {type(model).__name__}")
    given = [name for name, value in model._named() if value is not None]
    if given:
        raise ValueError(
            f"`model`: expected parameters to be estimated, got values of {', '.join(given)}; "
            "write the process without values, as in WhiteNoise() + AR1()"
        )
    # Processes of a kind side by side, in the order in which the kinds first appear.
    kinds = list(dict.fromkeys(map(type, model.processes)))
    processes: list[Process] = sorted(model.processes, key=lambda p: kinds.index(type(p)))
    return ModelStructure(tuple(processes), held)
