"""Noise models of the demonstration: the model found for every sensor beside the true one."""

from __future__ import annotations

import itertools
import math
from textwrap import fill
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from gyrofuse._base.page import new_figure, number
from gyrofuse._base.units import SECONDS_PER_HOUR, angle_random_walk, correlation_time, per_sqrt_hour, rate_unit_factor
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.j_test import REJECTED
from gyrofuse.fitting.ranking.candidates import name_of
from gyrofuse.fitting.ranking.result import RankResult
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.processes import Model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Candidate models, without tones, which the array does not have; the default of `rank_models` has more.
CANDIDATES = ("WN", "WN + RW", "WN + AR1", "WN + AR1 + RW", "WN + 2*AR1", "WN + 2*AR1 + RW", "WN + 3*AR1")
# Number of averages in the recording at the averaging time of the table: with 100 the relative standard error of an
# Allan deviation is about 10 %, so that fitted and true values can be compared.
_N_AVERAGES = 100


def true_models(array: ArrayModel, weights: Tensor) -> list[Model]:
    """Noise of every sensor of an array, and of the virtual gyro that it makes with these weights.

    Args:
        array: White noise and AR1s with unit variances, and their covariances between the sensors.
        weights: Weights of the virtual gyro, `(sensor,)`.
    """
    each = torch.cat([torch.eye(len(weights), dtype=torch.float64), weights[None]])
    sizes = [torch.einsum("si,ik,sk->s", each, matrix, each).tolist() for _, matrix in array.components]
    model = Model([process for process, _ in array.components])
    params = []
    for own in zip(*sizes, strict=True):
        known = zip(model.processes, own, strict=True)
        params.append([value for process, size in known for value in (*process.params[:-1].tolist(), size)])
    return [model.with_params(row) for row in torch.tensor(params, dtype=torch.float64)]


def models_story(result: RankResult, truths: list[Model]) -> str:
    """Table of the models found beside the true ones, in datasheet units, and a paragraph on it.

    Args:
        result: Ranking of every sensor, with its fits.
        truths: True model of every sensor.
    """
    fits = [fit for fit in result.best if fit is not None]
    columns = "  ".join(f"{name:>9}" for name in ("fitted", "truth") * 2)
    at = f"{number(2.0 ** _level(fits[0]) / (fits[0].rate or 1.0), 3)} s (deg/h)"
    lines = [
        f"{'':>7}  {'':<22}  {'angle random walk':^20}  {'Allan deviation at':^20}",
        f"{'':>7}  {'':<22}  {'(deg/sqrt(h))':^20}  {at:^20}",
        f"{'sensor':>7}  {'noise model':<22}  {columns}  {'J test p':>8}",
    ]
    for fit, name, truth in zip(fits, result.names, truths, strict=True):
        found, true = (_quantities(model, fit) for model in (_model(fit), truth))
        numbers = [f"{number(value):>9}" for value in itertools.chain(*zip(found, true, strict=True))]
        p_value = number(_p_value(fit), 2)
        lines.append("  ".join([f"{fit.sensors[0]:>7}", f"{name:<22}", *numbers, f"{p_value:>8}"]))
    head = "Noise model of every gyro and of the virtual gyro, as the likelihood of their spectra ranks them:"
    return "\n".join([head, *(line.rstrip() for line in lines)]) + "\n\n" + fill(_comment(fits, result, truths[0]), 110)


def models_figure(result: RankResult, truths: list[Model]) -> Figure:
    """Allan deviation of every sensor: measured, of the fitted model, and of the true one.

    Args:
        result: Ranking of every sensor, with its fits.
        truths: True model of every sensor.
    """
    fits = [fit for fit in result.best if fit is not None]
    figure = new_figure(9, 2.7 * ((len(fits) + 1) // 2))
    figure.set_layout_engine("none")
    margins = {"left": 0.08, "right": 0.98, "bottom": 0.06, "top": 0.97, "hspace": 0.2, "wspace": 0.16}
    panels = figure.subplots((len(fits) + 1) // 2, 2, sharex=True, squeeze=False, gridspec_kw=margins).flatten()
    for n, (ax, fit, truth, name) in enumerate(zip(panels, fits, truths, result.names, strict=False)):
        fit.plot(ax)
        variance = truth.wavelet_variance(fit.wavelet_variance.shape[-2])
        times = torch.exp2(torch.arange(len(variance))) / (fit.rate or 1.0)
        lines = ax.plot(times, (2 * variance).sqrt(), "--", color="black", linewidth=1.2, zorder=6)
        known = ax.get_legend()
        labels = [text.get_text() for text in known.get_texts()]
        ax.legend([*known.legend_handles, *lines], [*labels, "truth"], fontsize=7, frameon=False, ncols=2)
        if n % 2:
            ax.set_ylabel("")
        if n < len(fits) - 2:
            ax.set_xlabel("")
        else:  # the last of its column
            ax.tick_params(labelbottom=True)
        ax.set_title(f"{fit.sensors[0]}: {name}", loc="left", fontsize=9)
    for ax in panels[len(fits) :]:
        ax.set_axis_off()
    return figure


def _model(fit: GMWMResult) -> Model:
    return fit.model.with_params(fit.params[0])


def _p_value(fit: GMWMResult) -> float | None:
    """p value of the J test; None where there is none, or the fit did not converge."""
    p_value = fit.p_value[0].item()
    return p_value if bool(fit.converged[0]) and p_value == p_value else None


def _level(fit: GMWMResult) -> int:
    """Level of the averaging time of the table, counted from 0."""
    return max(int(math.log2(fit.n_samples / _N_AVERAGES)), 0)


def _quantities(model: Model, fit: GMWMResult) -> list[float]:
    """Angle random walk, and the Allan deviation at the averaging time of the table."""
    rate, degrees = fit.rate or 1.0, rate_unit_factor(fit.unit or "deg/s")
    white = sum(process.params.item() for process in model.processes if process.white)
    slow = (2 * model.wavelet_variance(_level(fit) + 1)[-1]).sqrt().item()
    return [per_sqrt_hour(angle_random_walk(white, rate)) * degrees, slow * degrees * SECONDS_PER_HOUR]


def _comment(fits: list[GMWMResult], result: RankResult, truth: Model) -> str:
    """The true model, how many sensors it was found for, and which models the J test refuses."""
    slow = [process for process in truth.processes if process.has_memory()]
    times = [number(correlation_time(process.params[0].item(), fits[0].rate or 1.0), 3) for process in slow]
    name = name_of([type(process) for process in truth.processes])
    same = sum(found == name for found in result.names)
    tests = {fit.sensors[0]: _p_value(fit) for fit in fits}
    refused = [sensor for sensor, p_value in tests.items() if p_value is not None and p_value < REJECTED]
    untested = [sensor for sensor, p_value in tests.items() if p_value is None]
    doubts = f"The J test refuses the model of {', '.join(refused)}." if refused else "The J test refuses none of them."
    if untested:
        doubts += f" It says nothing of {', '.join(untested)}, whose wavelet moments were not fitted to the end."
    return (
        f"In truth all are {name}, with time constants of {', '.join(times)} s; {same} of {len(fits)} are found as "
        "that. A parameter has to gain more likelihood than its charge, and of processes slower than a good part of "
        f"the recording two look much like one. {doubts} At long averaging times the virtual gyro looks "
        "better than it is, as its weights are from this very recording."
    )
