"""Naive twins of the multi-scale virtual gyro: the split by its definition, the weights by Lagrange's equations."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def means(signal: Array, n_bands: int) -> Array:
    """`s_0` to `s_K`, means of what is complete of the newest `2**k` slots: `(K + 1, sensor, time)`."""
    complete = np.isfinite(signal).all(0)
    out = np.full((n_bands, *signal.shape), np.nan)
    for k in range(n_bands):
        for t in range(signal.shape[1]):
            window = slice(max(0, t + 1 - 2**k), t + 1)
            if complete[t]:
                out[k, :, t] = signal[:, window][:, complete[window]].mean(-1)
    return out


def bands(signal: Array, n_bands: int) -> Array:
    """`d_1` to `d_K` and `s_K`: `(band, sensor, time)`."""
    s = means(signal, n_bands)
    return np.concatenate([s[:-1] - s[1:], s[-1:]])


def fuse(weights: Array, signal: Array) -> Array:
    """`sum_k c_k' d_k + c_K' s_K` of weights `(band, sensor)`: `(time,)`."""
    return np.asarray(np.einsum("ki,kit->t", weights, bands(signal, len(weights))))


def responses(f: Array, n_bands: int) -> Complex:
    """Frequency responses of the bands, from their impulse responses: `(band, frequency)`."""
    s = np.array([np.exp(-2j * np.pi * np.outer(f, np.arange(2**k))).mean(-1) for k in range(n_bands)])
    return np.concatenate([s[:-1] - s[1:], s[-1:]])


def haar_gain(f: Array, level: int) -> Array:
    """Squared gain of the Haar wavelet filter of a level."""
    half = 2 ** (level - 1)
    taps = np.r_[np.ones(half), -np.ones(half)] / (2 * half)
    return np.abs(np.exp(-2j * np.pi * np.outer(f, np.arange(2 * half))) @ taps) ** 2


def octave_gains(n_levels: int, n_bands: int, n_nodes: int = 2000) -> Array:
    """Mean of `|H_j|^2 Re b b*` over each octave, by the midpoint rule: `(octave, level, band, band)`."""
    out = np.empty((n_levels, n_levels, n_bands, n_bands))
    for octave in range(1, n_levels + 1):
        f = 2.0 ** -(octave + 1) * (1 + (np.arange(n_nodes) + 0.5) / n_nodes)
        b = responses(f, n_bands)
        for level in range(1, n_levels + 1):
            out[octave - 1, level - 1] = np.real((b * haar_gain(f, level)) @ b.conj().T) / n_nodes
    return out


def shrunk(wccv: Array, degrees: Array, pooling: float) -> Array:
    """Each level shrunk towards the shape of the level below, worth `pooling` observations per sensor."""
    n_sensors = wccv.shape[-1]
    out = [wccv[0]]
    for gamma, eta in zip(wccv[1:], degrees[1:], strict=True):
        size = np.trace(np.linalg.inv(out[-1]) @ gamma) / n_sensors
        worth = pooling * n_sensors
        out.append((eta * gamma + worth * size * out[-1]) / (eta + worth))
    return np.array(out)


def weights(wccv: Array, importance: Array, n_bands: int) -> Array:
    """Minimiser of `sum_j importance_j nu_j(y)` under `1'c_k = 1`, from `[[G, C'], [C, 0]] [c, m] = [0, 1]`."""
    n_levels, n_sensors = wccv.shape[:2]
    own = wccv.copy()
    own[:-1] -= wccv[1:] / 4
    gains = octave_gains(n_levels, n_bands)
    size = n_bands * n_sensors
    quadratic = sum(
        importance[j] * np.kron(gains[octave, j], own[octave]) for octave in range(n_levels) for j in range(n_levels)
    )
    constraint = np.kron(np.eye(n_bands), np.ones(n_sensors))
    system = np.block([[quadratic, constraint.T], [constraint, np.zeros((n_bands, n_bands))]])
    solved = np.linalg.solve(system, np.r_[np.zeros(size), np.ones(n_bands)])
    return np.asarray(solved[:size].reshape(n_bands, n_sensors))


def fused_wavelet_variance(weights: Array, spectra: Array, f: Array, shares: Array, n_levels: int) -> Array:
    """Wavelet variance `(level,)` of the fused signal under cross-spectra `(frequency, sensor, sensor)`.

    `f` in `(0, 1/2)` with `shares` that sum to 1 over both signs; closed forms of the responses, for long filters.
    """
    length = 2.0 ** np.arange(len(weights))[:, None]
    phase = np.pi * f
    s = np.exp(-1j * phase * (length - 1)) * np.sin(phase * length) / (length * np.sin(phase))
    response = np.einsum("kf,ki->fi", np.concatenate([s[:-1] - s[1:], s[-1:]]), weights)
    power = np.einsum("fi,fik,fk->f", response, spectra, response.conj()).real * shares
    tau = 2.0 ** np.arange(1, n_levels + 1)[:, None]
    return np.asarray((4 * np.sin(phase * tau / 2) ** 4 / (tau * np.sin(phase)) ** 2) @ power)


def frequencies(n_octaves: int, n_nodes: int = 200) -> tuple[Array, Array]:
    """Nodes in `(0, 1/2)`, as many in every octave, and their shares of both signs of frequency."""
    x, w = np.polynomial.legendre.leggauss(n_nodes)
    edges = 2.0 ** -np.arange(1, n_octaves + 2)
    f = [low + (high - low) * (x + 1) / 2 for high, low in itertools.pairwise(edges)]
    shares = [w * (high - low) for high, low in itertools.pairwise(edges)]
    return np.concatenate(f), np.concatenate(shares)
