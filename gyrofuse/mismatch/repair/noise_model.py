"""The noise of a simulation as a model: the one that was given, or one that describes its samples.

Samples are described by the simple spectra of each sensor (`base.py`), by what sensors share of their white noise, of
their AR1s and of their walks, and by the lines that they have.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.likelihoods.spectra.noise_parts import Parts
from gyrofuse.mismatch.repair.repaired_model import RepairedModel
from gyrofuse.mismatch.signals.comparison import Comparison
from gyrofuse.mismatch.signals.fitted_spectra import as_array
from gyrofuse.mismatch.signals.known_lines import line_parts
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.model import Model
from gyrofuse.noise.processes import Process, Sinusoid

_SHARED = 4.0  # standard deviations from which sensors share noise
_RIDGE = 1e-3  # of the information on what is shared
_SEEN = 3.0  # standard deviations from which a sensor has a line
_IN_PHASE = 0.2  # share of a line that may be a quarter of a cycle off


def noise_of(simulation: Recording | Tensor | Model | ArrayModel | RepairedModel, comparison: Comparison) -> ArrayModel:
    """The simulation's noise as a model: the one given, or one that describes its samples."""
    if isinstance(simulation, RepairedModel):
        return simulation.noise
    if isinstance(simulation, ArrayModel):
        return simulation
    if isinstance(simulation, Model):
        return as_array(simulation, comparison.n_sensors)
    lines = _lines(comparison)
    shared = _shared_parts(comparison)
    noise = comparison.base.model() if shared is None else _shared_model(comparison.base, shared)
    return ArrayModel([*noise.components, *lines]) if lines else noise


def noise_samples(simulation: Recording | Tensor | Model | ArrayModel | RepairedModel) -> int:
    """How many samples of each sensor tell of that noise; 0 where a model does."""
    if isinstance(simulation, RepairedModel):
        return simulation.noise_samples
    if isinstance(simulation, Model | ArrayModel):
        return 0
    return (simulation.signal if isinstance(simulation, Recording) else simulation).shape[-1]


def _shared_parts(comparison: Comparison) -> Tensor | None:
    """Correlations of the simulation's sensors in what is white, AR1s and walk; None where they share nothing.

    `(part, sensor, sensor)`, by least squares from the coherences of all bands, those in phase.
    """
    side, p = comparison.reference, comparison.n_sensors
    parts = Parts(side.base, side.bands.nodes)
    shares = side.bands.mean_of(parts.densities)  # (part, sensor, band)
    shares = (shares / shares.sum(0)).sqrt()
    weight = 2 * side.dof
    correlation = torch.eye(p, dtype=torch.float64).repeat(len(shares), 1, 1)
    for i in range(p):
        for j in range(i):
            design = shares[:, i] * shares[:, j]  # (part, band)
            information = (design * weight) @ design.mT
            if not bool(information.any()):  # what one of them has the other has not
                continue
            information = information + _RIDGE * information.diagonal().amax() * torch.eye(len(design))
            covariance = torch.linalg.inv(information)
            r = covariance @ (design * weight) @ side.coherence[:, i, j].real
            r = torch.where(r.abs() > _SHARED * covariance.diagonal().sqrt(), r.clamp(-1, 1), 0.0)
            correlation[:, i, j] = correlation[:, j, i] = r
    if not bool((correlation - torch.eye(p)).any()):
        return None
    values, vectors = torch.linalg.eigh(correlation)
    nearest = (vectors * values.clamp(min=0)[:, None]) @ vectors.mT
    size = nearest.diagonal(dim1=-2, dim2=-1).rsqrt()
    return nearest * size[:, :, None] * size[:, None, :]


def _shared_model(base: NoiseSpectrum, correlations: Tensor) -> ArrayModel:
    """A base whose parts are correlated."""
    parts = Parts(replace(base, coefficients=base.essential()), torch.zeros(1, dtype=torch.float64))
    root = torch.stack(parts.coefficients).sqrt().movedim(-1, 0)  # (atom, part, sensor)
    return base.shared_model((root[..., :, None] * root[..., None, :] * correlations).sum(1))


def _lines(comparison: Comparison) -> list[tuple[Process, Tensor]]:
    """Lines of the simulation: one source where sensors have it in phase, up to signs, else one for each."""
    side, found = comparison.reference, list[tuple[Process, Tensor]]()
    if not side.lines:
        return found
    parts = line_parts(side.signal, side.lines)  # (record, sensor, line)
    power = parts.abs().square().mean(0)
    frequencies = torch.tensor(side.lines, dtype=torch.float64)
    variance = 2 * side.base.spectrum(frequencies) / side.signal.shape[-1]  # of either part
    for k, f in enumerate(side.lines):
        amplitude = torch.where(power[:, k] > _SEEN**2 * variance[:, k], power[:, k] - 2 * variance[:, k], 0.0).sqrt()
        process = Sinusoid(1.0, 2 * math.pi * f)
        strongest = int(amplitude.argmax())
        turned = (parts[..., k] * parts[:, strongest : strongest + 1, k].conj().sgn()).mean(0)
        if float(turned.imag.norm()) < _IN_PHASE * float(turned.abs().norm()):
            found.append((process, amplitude * turned.real.sign()))
        else:
            found += [(process, row) for row in torch.diag(amplitude) if bool(row.any())]
    return found
