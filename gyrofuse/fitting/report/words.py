"""What a fitted noise model comes to, in sentences: whether it is complete, what rules at which scale, what is weak."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

import torch
from torch import Tensor

from gyrofuse._base.page import number
from gyrofuse._base.results import p_words
from gyrofuse.fitting.gmwm_result import GMWMResult
from gyrofuse.fitting.j_test import DOUBTED, REJECTED
from gyrofuse.noise.processes import Model

_WEIGHTS = {
    "optimal": "weighted by the inverse of their covariance under the fitted model",
    "diagonal": "weighted by the reciprocals of their variances under the fitted model",
    "identity": "all levels weighted alike",
    "given": "with weights that were given",
}


def model_verdict(result: GMWMResult, index: tuple[int, ...]) -> list[str]:
    """Say in sentences how well the model of one sensor fits and what it consists of.

    Args:
        result: Result of a fit.
        index: Index of the sensor among the leading dimensions.
    """
    if not bool(result.params[index].isfinite().all()):
        return ["Nothing could be fitted: its wavelet variance is missing or zero at some level."]
    return [*_completeness(result, index), *_rulers(result, index), *_tones(result, index), *_weak(result, index)]


def model_method(result: GMWMResult) -> str:
    """Say in sentences how a model was fitted.

    Args:
        result: Result of a fit.
    """
    weights = _WEIGHTS[result.weighting]
    sentences = [
        f"Generalised Method of Wavelet Moments: the parameters bring the model's Haar wavelet variances closest to "
        f"those measured, {weights} (Voirol et al., Accounting for Vibration Noise in Stochastic Measurement Errors; "
        "Guerrier, Skaloud, Stebler and Victoria-Feser, JASA 108, 2013)."
    ]
    if result.efficiency < 1:
        sentences.append(
            f"Wavelet variances are robust, of efficiency {result.efficiency:g}: outliers, up to one in "
            "two thousand, hardly move them; their covariance is their own, and intervals are those of clean noise."
        )
    if result.refined:
        sentences.append(
            "From there the spectral (Whittle) likelihood was maximised. Parameters, residuals and J test are those of "
            "its maximum."
        )
    sentences.append(
        "Frequencies of tones are those of the spectrum. Intervals rest on the model: where the J test refuses it they "
        "are too narrow."
    )
    return " ".join(sentences)


def residuals(result: GMWMResult, index: tuple[int, ...]) -> Tensor:
    """Measured less fitted wavelet variances over their standard deviation in the model, `(level,)`."""
    measured, fitted = result.wavelet_variance.mT[index], result.fitted_wavelet_variance.mT[index]
    return (measured - fitted) / result.records.covariance(_model(result, index)).diagonal().sqrt()


def _model(result: GMWMResult, index: tuple[int, ...]) -> Model:
    return result.model.with_params(result.params[index])


def _completeness(result: GMWMResult, index: tuple[int, ...]) -> Iterator[str]:
    p_value = result.p_value[index].item()
    if not bool(result.converged[index]):
        yield "Beware: the search for the best fit to the wavelet variances did not end; what it found is shown."
        if p_value < DOUBTED:
            return  # the best may fit
    if p_value != p_value:
        if result.weighting != "optimal":
            yield "Whether the model is complete was not tested: the J test asks for optimal weighting."
        else:
            yield "Whether the model is complete cannot be tested: it has as many parameters as there are levels."
        return
    test_text = f"J test: {p_words(p_value)}"
    if p_value >= DOUBTED:
        yield f"The model explains the wavelet variances at all scales within what chance allows ({test_text})."
        return
    off = residuals(result, index)
    worst = int(off.abs().argmax())
    size = f"{abs(off[worst].item()):.1f} standard deviations {'above' if off[worst] > 0 else 'below'} the model's"
    where = f"at {_time(result, worst)} the measured wavelet variance is {size}"
    if p_value >= REJECTED:
        yield f"The model is in doubt ({test_text}): {where}."
    else:
        remedy = "add a process or look for a disturbance"
        if result.efficiency < 1:
            remedy = "add a process; where more than one sample in a thousand is an outlier, slow levels have them too"
        limits = "Intervals hold only for what the model knows"
        yield f"The model is not complete ({test_text}): {where}. {limits}; {remedy}."


def _rulers(result: GMWMResult, index: tuple[int, ...]) -> Iterator[str]:
    """Which process rules from which averaging time to which."""
    processes = _model(result, index).processes
    n_levels = result.wavelet_variance.shape[-2]
    shares = torch.stack([process.wavelet_variance(n_levels) for process in processes])  # (process, level)
    names = [process.with_article("the") for process in processes]
    labels, seen = [], dict.fromkeys(names, 0)
    for name in names:
        seen[name] += 1
        labels.append(name + (f" {seen[name]}" if names.count(name) > 1 else ""))
    runs = [(k, list(levels)) for k, levels in groupby(range(n_levels), lambda j: int(shares[:, j].argmax()))]
    parts = []
    for k, levels in runs:
        first, last = _time(result, levels[0]), _time(result, levels[-1])
        parts.append(f"{labels[k]} " + (f"at {first}" if len(levels) == 1 else f"from {first} to {last}"))
    yield "Largest by averaging time: " + ", then ".join(parts) + "."


def _tones(result: GMWMResult, index: tuple[int, ...]) -> Iterator[str]:
    for process in _model(result, index).processes:
        if process.has_line and bool((process.params[0] > 0).all()):
            amplitude, beta = process.params.tolist()
            cycles = beta / (2 * torch.pi)
            place = f"{number(cycles * result.rate, 6)} Hz" if result.rate else f"{number(cycles, 6)} cycles per sample"
            unit = f" {result.unit}" if result.unit else ""
            yield f"A tone at {place} with an amplitude of {number(amplitude, 3)}{unit}."


def _weak(result: GMWMResult, index: tuple[int, ...]) -> Iterator[str]:
    values = result.params[index]
    names = [
        name for name, known in zip(result.param_names, result.determined[index].tolist(), strict=True) if not known
    ]
    zero = [name for name, value in zip(result.param_names, values.tolist(), strict=True) if value == 0]
    if zero:
        yield f"Not seen, with an upper limit only: {', '.join(zero)}."
    weak = [name for name in names if name not in zero]
    if weak:
        yield f"Hardly known beyond the order of magnitude: {', '.join(weak)}."
    item = sum(i * step for i, step in zip(index, result.identified.stride(), strict=True))
    for note in result.notes[item]:
        names_of, _, what = note.partition(": ")
        yield f"Not identified: {names_of} ({what})."


def _time(result: GMWMResult, level: int) -> str:
    """Averaging time of a level, counted from 0."""
    samples = 2.0**level
    return f"{number(samples / result.rate, 3)} s" if result.rate else f"{samples:g} samples"
