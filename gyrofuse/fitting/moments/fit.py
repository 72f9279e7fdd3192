"""The search of a moment fit, from starting points to weights `V^-1`, for many records at once."""

from __future__ import annotations

import torch
from torch import Tensor

from gyrofuse.fitting.moments import search
from gyrofuse.fitting.moments.inference import Fit
from gyrofuse.fitting.moments.records import Records
from gyrofuse.fitting.structure import Composition
from gyrofuse.noise.parsing import parse_model
from gyrofuse.noise.processes import Model, Process, Sinusoid

_REWEIGHTINGS, _UPDATES, _DISTINCT = 3, 3, 3
# Steps that the best start may take to its minimum; flat valleys need some hundreds.
_POLISHING = 500
# Where whole steps do not come to rest, as each is -1 to -7 times the last: a part of them; how many, with how many
# steps of the search in each, and the relative move of wavelet variances below which they are at rest.
_PART, _DAMPED, _STEPS_EACH, _AT_REST = 0.25, 60, 5, 1e-2


def fit_items(
    nu: Tensor, frequencies: tuple[Tensor, Tensor] | None, records: Records, made_of: Composition, omega: str | Tensor
) -> Fit:
    """Fit all items at once.

    Args:
        nu: Wavelet variances `(item, level)`.
        frequencies: `beta` of the sinusoids and its spread where the moments need not find it, `(item, sinusoid)`,
            from high to low.
        records: What was measured.
        made_of: Structure of the model.
        omega: Weights `(level,)` or `(level, level)`, or `"optimal"` or `"diagonal"`.
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
    start = search.starting_points(nu, weight, tau, made_of, held, n_starts_for(made_of))  # (item, start, shaped)
    n_starts = start.shape[1]

    def each(value: Tensor, n: int) -> Tensor:
        return value[:, None].expand(-1, n, *value.shape[1:]).flatten(0, 1)

    root = weight.sqrt() if own is None or own.ndim == 1 else torch.linalg.cholesky(own).mT.expand(n_items, -1, -1)
    linear, x, objective, _ = search.minimise(
        each(nu, n_starts), each(root, n_starts), tau, made_of, start.flatten(0, 1)
    )
    for _ in range(_REWEIGHTINGS if own is None else 0):
        fitted = made_of.wavelet_variance(tau, linear, x)
        root = (observations.sqrt() / fitted.clamp(min=1e-30)).clamp(max=1e15)
        linear, x, objective, _ = search.minimise(each(nu, n_starts), root, tau, made_of, x)
        # Distances with different weights: the likelihood of independent normal variances makes them comparable.
        objective = objective - 2 * root.log().sum(-1)
    kept = search.distinct(objective.view(n_items, -1), x.view(n_items, n_starts, -1), _DISTINCT)
    n_kept = kept.shape[1]
    chosen = (torch.arange(n_items, device=nu.device)[:, None] * n_starts + kept).flatten()
    linear, x, objective = linear[chosen], x[chosen], objective[chosen]
    passed = []
    if own is None:
        for _ in range(_UPDATES):
            root = _root(records.covariance(made_of.model(linear, x)), omega)
            passed.append(misfit(each(nu, n_kept), root, tau, made_of, linear, x))
            linear, x, distance, _ = search.minimise(each(nu, n_kept), root, tau, made_of, x)
        objective = distance - _log_det(root)
    best = objective.view(n_items, n_kept).nan_to_num(nan=torch.inf).argmin(-1)
    best = best + n_kept * torch.arange(n_items, device=nu.device)
    root = root[best] if own is None else root
    linear, x, _, reached = search.minimise(nu, root, tau, made_of, x[best], _POLISHING)
    if own is None:
        final = misfit(nu, _root(records.covariance(made_of.model(linear, x)), omega), tau, made_of, linear, x)
        least = torch.stack([value.view(n_items, n_kept).amin(-1) for value in passed]).amin(0)
        chasing = final > least + len(tau)
        if bool(chasing.any()):
            linear[chasing], x[chasing], reached[chasing] = damped(
                nu[chasing], records, made_of, omega, linear[chasing], x[chasing]
            )
    linear, x = made_of.ordered(linear, x)
    return Fit(
        variance=nu * size,
        linear=linear * size,
        shape=x,
        held_sd=held_sd.to(nu),
        converged=reached & linear.isfinite().all(-1),
        omega=omega,
        records=records,
    )


def damped(
    nu: Tensor, records: Records, made_of: Composition, omega: str | Tensor, linear: Tensor, x: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """A part of the way to the fit with the weights of the last one, again and again; whether that came to rest.

    Where no parameters fit, whole steps may lead from one bad fit to another and back.
    """
    tau = records.tau.to(nu)
    for _ in range(_DAMPED):
        before = made_of.wavelet_variance(tau, linear, x)
        root = _root(records.covariance(made_of.model(linear, x)), omega)
        whole_linear, whole_x, _, _ = search.minimise(nu, root, tau, made_of, x, _STEPS_EACH)
        moved = (made_of.wavelet_variance(tau, whole_linear, whole_x) / before - 1).abs().amax(-1)
        if bool((moved < _AT_REST).all()):
            break
        linear, x = linear.lerp(whole_linear, _PART), x.lerp(whole_x, _PART)
    return whole_linear, whole_x, moved < _AT_REST


def misfit(target: Tensor, root: Tensor, tau: Tensor, made_of: Composition, linear: Tensor, x: Tensor) -> Tensor:
    """`r' V^-1 r + ln det V`: a V too large would make its own fit look good."""
    residual = target - made_of.wavelet_variance(tau, linear, x)
    whitened = root * residual if root.ndim == 2 else (root @ residual[..., None])[..., 0]
    return whitened.square().sum(-1) - _log_det(root)


def _log_det(root: Tensor) -> Tensor:
    """`ln det V^-1` from its factor."""
    return 2 * (root if root.ndim == 2 else root.diagonal(dim1=-2, dim2=-1)).log().sum(-1)


def _root(covariance: Tensor, omega: str | Tensor) -> Tensor:
    return covariance.diagonal(dim1=-2, dim2=-1).rsqrt() if omega == "diagonal" else search.whitening(covariance)


def n_starts_for(made_of: Composition) -> int:
    """As many as found the lowest minimum of noisy copies every time."""
    tones = sum(made_of.processes[k].has_line for k in made_of.curved)
    return min(4 * 4 ** (len(made_of.curved) - 1) if tones else (1, 4, 6, 8)[min(len(made_of.curved), 3)], 32)


def composition_of(model: Model | str, held: bool) -> Composition:
    """Structure of a model without values; `held` as there."""
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
    return Composition(tuple(processes), held)
