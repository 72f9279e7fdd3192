"""A virtual gyro with weights of its own at every time scale: beyond [Z], whose one vector of weights is a compromise.

Every sensor is split causally into dyadic bands, which add up to it exactly and without delay,

    s_k,t = mean of the last 2**k samples,   d_k = s_{k-1} - s_k,   x = sum_{k=1..K} d_k + s_K,

and each band is fused with its own weights, `y = sum_k c_k' d_k + c_{K+1}' s_K` with `1'c_k = 1`: a rate common to all
sensors passes with a transfer function of exactly 1, whatever the weights. They minimise the wavelet variance of `y`,
each level relative to the smallest that it can have on its own:

    minimise sum_j omega_j nu_j(y) / nu*_j,   nu*_j = 1 / (1' Gamma_j^-1 1).

That is one quadratic programme in the stacked weights `c`, with a closed form,

    c = G^-1 C' (C G^-1 C')^-1 1,   G = sum_j (omega_j / nu*_j) sum_l g_jl (x) D_l,   C = I (x) 1',

where `g_jl` `(band, band)` is the part of `int |H_j|^2 b b* df` that falls into octave `l` of frequency, `b` being the
responses of the bands, and `D_l` is what that octave, `[2**-(l+1), 2**-l]` cycles per sample, holds:

    D_l = Gamma_l - Gamma_{l+1} / 4,   |H_l|^2 - |H_{l+1}|^2 / 4 = |H_l|^2 (1 - cos^4(pi f tau_l / 2)) >= 0.

A Haar filter also passes slower noise, a quarter of the power that the next level's filter passes. With that
subtracted, the covariance between bands follows from the wavelet cross-covariance alone, without a model.

The last levels hold fewer observations than sensors. Cross-covariances of neighbouring levels are similar up to their
size, so each level is shrunk towards the level below it, with the weight of 6 further observations per sensor.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gyrofuse._base.checks import check_floating, check_positive_integer, check_signal
from gyrofuse._base.deprecation import warn_deprecated
from gyrofuse._base.linalg import check_positive_definite
from gyrofuse.fusion.layer import FittedLayer
from gyrofuse.fusion.multiscale_result import MultiScaleResult, fuse_bands
from gyrofuse.fusion.svo import fit_svo
from gyrofuse.fusion.uncertainty.cross_fitting import CrossFit, Fusion, cross_fit
from gyrofuse.fusion.weights.svo import ScaleWeights
from gyrofuse.io.recording import Recording
from gyrofuse.io.signals import as_recording
from gyrofuse.wavelets.intervals import equivalent_dof
from gyrofuse.wavelets.long_run_variance import bin_length
from gyrofuse.wavelets.moments import Moments
from gyrofuse.wavelets.pilot import fit_pilot

# Weight of the level below when a level is shrunk towards it, in observations per sensor. Wavelet variances out of
# sample are within 2 % of each other for 4 to 10.
_POOLING = 6.0
# Fraction of a level's noise that is of its own octave, at least: 7/8 for white noise, 1/2 for a random walk, 0 for a
# drift, and below 0 only by chance.
_LEAST_OWN = 0.05
# Relative importance of a level without scale weight, small enough not to move the others: it determines the weights of
# bands that no other level depends on.
_IDLE = 1e-6


def fit_multiscale(
    signal: Tensor | Recording,
    scale_weights: ScaleWeights = "flat",
    *,
    n_bands: int | None = None,
    n_levels: int | None = None,
    confidence_level: float = 0.95,
) -> MultiScaleResult:
    """Fuse an array of gyros into one virtual gyro that is near the best at every time scale.

    The array has to be at rest or to turn at a constant rate while it is fitted, as for `fit_svo`.

    Args:
        signal: `(..., sensor, time)` of at least two sensors, or a `Recording`; NaN = missing sample.
        scale_weights: How much each level counts, relative to its optimum: `"flat"`, `"short"`, `"long"`, or
            one number >= 0 per level.
        n_bands: Number of bands K + 1; the filter then remembers `2**K` samples. By default one
            for each level with at least 30 observations, and one for all that is slower.
        n_levels: Number of levels J, as for `fit_svo`.
        confidence_level: Confidence level of every interval in the result.

    Returns:
        The weights of every band, and the wavelet variances before and after.

    Raises:
        TypeError: `signal` is neither a floating point tensor nor a `Recording`.
        ValueError: Fewer than two sensors, too few samples, more bands than levels, or bad options.
        SingularCovarianceError: A dead, duplicated or linearly dependent sensor.

    Example:
        >>> result = fit_multiscale(calibration)
        >>> virtual = result.virtual(signal)  # (..., time)
    """
    if n_bands is not None:
        n_bands = check_positive_integer("n_bands", n_bands)
    single = fit_svo(signal, scale_weights, n_levels=n_levels, confidence_level=confidence_level, covariance="none")
    values, dof = as_recording(signal).values, single.dof
    if n_bands is None:
        # The weights of p sensors need several observations each.
        n_bands = 1 + int((dof >= 30).reshape(-1, single.n_levels).all(0).sum())
    if n_bands > single.n_levels + 1:
        raise ValueError(
            f"`n_bands`: expected at most {single.n_levels + 1} for {single.n_levels} levels, got {n_bands}; "
            "ask for fewer bands or record longer"
        )
    wccv = single.wavelet_cross_covariance.double()
    check_positive_definite(
        "the wavelet cross-covariance of level 1", wccv[..., 0, :, :], single.sensors, dtype=values.dtype
    )
    omega = single.scale_weights.double()
    weights, optimum = _fitted(wccv, dof, omega, n_bands)
    with torch.no_grad():
        fit, in_sample = _cross_fitted(weights, values, wccv, omega, confidence_level)
    return MultiScaleResult(
        weights=weights.to(values.dtype),
        fused_wavelet_variance=in_sample.to(values.dtype),
        cross_fit=fit,
        optimal_wavelet_variance=optimum.to(values.dtype),
        single=single,
    )


class MultiScaleSVO(FittedLayer):
    """A multi-scale virtual gyro as a layer: `fit` chooses the weights of every band, `forward` fuses.

    The weights are a buffer: they are saved in `state_dict`, follow `.to(...)`, and are not trained. `forward` starts
    anew with every call: until `2**k` samples have come, the mean over them is that of the samples so far. A stream in
    chunks of any length goes through `stream`, which carries a state from chunk to chunk and gives the same output as
    the whole stream at once.

    Args:
        n_bands: Number of bands K + 1; from the recording by default, see `fit_multiscale`.
        scale_weights: How much each level counts, see `fit_multiscale`.
        n_levels: Number of levels J.
        confidence_level: Confidence level of the intervals in the result of `fit`.

    Raises:
        TypeError, ValueError: Bad scale weights, or a number of bands that is not a whole number of at least 1.

    Example:
        >>> svo = MultiScaleSVO()
        >>> result = svo.fit(calibration)  # (..., sensor, time)
        >>> virtual = svo(signal)  # (..., time)
        >>> state = svo.start(signal)
        >>> for chunk in signal.split(100, dim=-1):
        ...     virtual, state = svo.stream(chunk, state)
    """

    def __init__(
        self,
        n_bands: int | None = None,
        scale_weights: ScaleWeights = "flat",
        *,
        n_levels: int | None = None,
        confidence_level: float = 0.95,
    ) -> None:
        super().__init__(scale_weights, n_levels=n_levels, confidence_level=confidence_level)
        self.n_bands = None if n_bands is None else check_positive_integer("n_bands", n_bands)

    def fit(
        self, signal: Tensor | Recording, scale_weights: ScaleWeights | None = None, **options: Any
    ) -> MultiScaleResult:
        """Choose the weights from a recording at rest and keep them.

        Args:
            signal: `(..., sensor, time)` or a `Recording`.
            scale_weights: Scale weights of the constructor; deprecated here.
            **options: Options of the constructor; deprecated here.

        Returns:
            The result of `fit_multiscale`.

        Raises:
            TypeError, ValueError, SingularCovarianceError: As `fit_multiscale`; the weights then stay as they were.
        """
        if scale_weights is not None or options:
            warn_deprecated("MultiScaleSVO.fit with options", "MultiScaleSVO(n_bands, scale_weights, ...)")
        chosen = self.scale_weights if scale_weights is None else scale_weights
        result = fit_multiscale(signal, chosen, n_bands=self.n_bands, **(self.options | options))
        self.keep(result.weights)
        return result

    def start(self, signal: Tensor) -> Tensor:
        """State of a stream before its first sample, `(..., sensor, 2**(bands - 1) - 1)`.

        Args:
            signal: `(..., sensor, time)`, of the dimensions, dtype and device of the chunks to come.

        Raises:
            RuntimeError: No weights yet.
            TypeError: `signal` is not a floating point tensor.
            ValueError: It has fewer than two dimensions.
        """
        self.check_fitted()
        check_signal("signal", signal)
        return signal.new_zeros(*signal.shape[:-1], 2 ** (self.weights.shape[-2] - 1) - 1)

    def stream(self, signal: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Fuse the next chunk of a stream.

        Args:
            signal: `(..., sensor, time)`, right after the chunk before.
            state: State of the stream, from `start` or from the call before.

        Returns:
            The virtual signal `(..., time)`, as `forward`, and the state after it.

        Raises:
            RuntimeError: No weights yet.
            TypeError: `signal` is not a floating point tensor, or `state` not one of its dtype.
            ValueError: `signal` or `state` does not fit the weights.
        """
        self.check_fitted()
        check_signal("signal", signal)
        if check_floating("state", state).dtype != signal.dtype:
            raise TypeError(
                f"`state`: expected {signal.dtype} as the signal has, got {state.dtype}; give chunks of one dtype, or "
                f"convert with state.to({signal.dtype})"
            )
        return fuse_bands(self.weights, signal, state)

    def forward(self, signal: Tensor, state: Tensor | None = None) -> Tensor:
        """Fuse a signal.

        A time at which any sensor lacks its sample gives NaN, and is left out of all later means.

        Args:
            signal: `(..., sensor, time)`.
            state: State of a stream; deprecated, use `stream`.

        Returns:
            `(..., time)`.

        Raises:
            RuntimeError: No weights yet.
            TypeError: `signal` is not a floating point tensor.
            ValueError: `signal` does not fit the weights.
        """
        if state is not None:
            warn_deprecated("MultiScaleSVO(...)(signal, state)", "MultiScaleSVO(...).stream(signal, state)", 4)
            return self.stream(signal, state)  # type: ignore[return-value]
        self.check_fitted()
        return fuse_bands(self.weights, signal)[0]

    def extra_repr(self) -> str:
        """Show the number of bands."""
        return f"n_bands={self.n_bands}"


def _fitted(wccv: Tensor, dof: Tensor, omega: Tensor, n_bands: int) -> tuple[Tensor, Tensor]:
    """Weights `(..., band, sensor)` and the optimum `1 / (1' S_j^-1 1)` of every level, `(..., level)`."""
    shrunk = _shrink(wccv, dof)
    optimum = torch.linalg.solve(shrunk, _ones(shrunk)).sum(-1).reciprocal()
    return _stacked_weights(shrunk, omega.clamp(min=_IDLE * omega.max()) / optimum, n_bands), optimum


def _cross_fitted(
    weights: Tensor, values: Tensor, wccv: Tensor, omega: Tensor, confidence_level: float
) -> tuple[CrossFit, Tensor]:
    """Cross-fit of the weights, and their wavelet variance `(..., level)` in this recording."""
    n_levels, n_sensors = wccv.shape[-3:-1]
    n_samples, batch = values.shape[-1], values.shape[:-2]
    known = wccv.isfinite().all(-1).all(-1).reshape(-1, n_levels).all(0)
    n_known = int(known.int().cumprod(0).sum())  # the result is NaN at the other levels
    items = values.detach().reshape(-1, *values.shape[-2:])
    length = bin_length(n_samples, n_sensors)
    parts, variances = [], []
    for own, item in zip(weights.reshape(-1, *weights.shape[-2:]).split(1), items.split(1), strict=True):
        moments = Moments.of(item, n_known, length)
        pilot = fit_pilot(moments.wccv, n_samples)
        fusion = _fusion(item, length, omega[:n_known], own.shape[-2])
        # Degrees of freedom matter at the last levels, where the slowest band dominates.
        dof = pilot.dof(own[:, -1:])[..., 0]
        parts.append(cross_fit(fusion, own, moments, pilot, dof, confidence_level))
        squares, number = fusion.squares_of(own, 0, moments.sums.shape[1], n_known)
        variances.append(pad(squares.sum(1) / number.sum(1), (0, n_levels - n_known), value=torch.nan))
    return CrossFit.cat(parts).padded(n_levels).reshape(*batch), torch.cat(variances).reshape(*batch, n_levels)


def _fusion(items: Tensor, length: int, omega: Tensor, n_bands: int) -> Fusion:
    """Weights of bands, as they are fitted to arrays `(item, sensor, time)` whose bins hold `length` samples."""
    n_levels = len(omega)
    gains = _octave_gains(n_levels, n_bands).to(omega)

    def weights_of(wccv: Tensor, windows: Tensor) -> Tensor:
        some = zip(wccv.split(25, 1), equivalent_dof(windows).split(25, 1), strict=True)  # draws that fit into memory
        return torch.cat([_fitted(drawn, dof, omega, n_bands)[0] for drawn, dof in some], 1)

    def variance_of(weights: Tensor, wccv: Tensor) -> Tensor:
        own = torch.cat([wccv[..., :-1, :, :] - wccv[..., 1:, :, :] / 4, wccv[..., -1:, :, :]], -3)
        between = weights.unsqueeze(-3) @ own @ weights.unsqueeze(-3).mT  # (..., octave, band, band)
        return torch.einsum("...lkm,ljkm->...j", between, gains)

    def squares_of(weights: Tensor, first: int, last: int, levels: int) -> tuple[Tensor, Tensor]:
        memory = 2 ** (n_bands - 1) + 2**levels  # of the filter, and of the coefficients of its output
        start = max(0, first - -(-memory // length))
        fused, _ = fuse_bands(weights, items[..., start * length : last * length])
        moments = Moments.of(fused.unsqueeze(-2), levels, length)
        return moments.sums[:, first - start :, :, 0, 0], moments.counts[:, first - start :, :, 0, 0]

    return Fusion(weights_of, variance_of, squares_of)


def _shrink(wccv: Tensor, dof: Tensor) -> Tensor:
    """Each level's cross-covariance `(..., level, sensor, sensor)`, shrunk towards the shape of the level below.

    `S_j = (eta_j Gamma_j + m s_j S_{j-1}) / (eta_j + m)`, with `s_j = tr(S_{j-1}^-1 Gamma_j) / p` the size of level j
    in units of the level below: the mean of an inverse Wishart law given `eta_j` observations.
    """
    pooling = _POOLING * wccv.shape[-1]  # m
    shrunk = [wccv[..., 0, :, :]]
    for level, eta in zip(wccv.unbind(-3)[1:], dof.unbind(-1)[1:], strict=True):
        # An unknown level, whose scale weight is 0, is replaced by the level below.
        known = torch.where(level.isfinite().all(-1, keepdim=True).all(-2, keepdim=True), level, shrunk[-1])
        root, sizes = _in_units_of(shrunk[-1], known)
        sizes = sizes.clamp(min=0)  # gaps can make a level indefinite
        common = sizes.mean(-1, keepdim=True)
        sizes = (eta[..., None] * sizes + pooling * common) / (eta[..., None] + pooling)
        shrunk.append((root * sizes[..., None, :]) @ root.mT)
    return torch.stack(shrunk, dim=-3)


def _own_octaves(wccv: Tensor) -> Tensor:
    """`D_l = Gamma_l - Gamma_{l+1} / 4`, kept positive definite; `Gamma_l` at the last level."""
    below, above = wccv[..., :-1, :, :], wccv[..., 1:, :, :]
    root, sizes = _in_units_of(below, above)
    own = (root * (1 - sizes / 4).clamp(min=_LEAST_OWN)[..., None, :]) @ root.mT
    return torch.cat([own, wccv[..., -1:, :, :]], dim=-3)


def _in_units_of(unit: Tensor, matrix: Tensor) -> tuple[Tensor, Tensor]:
    """`R` and `v` with `unit = R R'` and `matrix = R diag(v) R'`."""
    factor = torch.linalg.cholesky(unit)
    half = torch.linalg.solve_triangular(factor, matrix, upper=False)
    relative = torch.linalg.solve_triangular(factor, half.mT, upper=False)
    sizes, vectors = torch.linalg.eigh((relative + relative.mT) / 2)
    return factor @ vectors, sizes


def _stacked_weights(wccv: Tensor, importance: Tensor, n_bands: int) -> Tensor:
    """Weights `(..., band, sensor)` that minimise `sum_j importance_j nu_j(y)`."""
    n_levels, n_sensors = wccv.shape[-3:-1]
    gains = _octave_gains(n_levels, n_bands).to(wccv)
    weighted = torch.einsum("...j,ljkm->...lkm", importance, gains)
    stacked = torch.einsum("...lkm,...lab->...kamb", weighted, _own_octaves(wccv))  # (..., band, sensor, band, sensor)
    size = n_bands * n_sensors
    stacked = stacked.reshape(*stacked.shape[:-4], size, size)
    constraint = torch.eye(n_bands).to(wccv).repeat_interleave(n_sensors, dim=0)  # C': (band x sensor, band)
    solved = torch.linalg.solve(stacked, constraint.expand(*stacked.shape[:-1], n_bands))  # G^-1 C'
    levelled = solved.unflatten(-2, (n_bands, n_sensors)).sum(-2)  # C G^-1 C': (..., band, band)
    multipliers = torch.linalg.solve(levelled, _ones(levelled))
    return (solved @ multipliers[..., None]).squeeze(-1).unflatten(-1, (n_bands, n_sensors))


@functools.lru_cache(maxsize=8)
def _octave_gains(n_levels: int, n_bands: int) -> Tensor:
    """Cross-band wavelet covariance `(octave, level, band, band)` of unit noise in each octave, float64.

    `g_jl = Re int |H_j|^2 b b* df` over the octave `[2**-(l+1), 2**-l]` and its mirror image, over its width. Means of
    many samples oscillate fast at high frequencies, where they are next to nothing: 64 nodes are enough.
    """
    nodes, shares = (torch.from_numpy(values) for values in np.polynomial.legendre.leggauss(64))
    octave = torch.arange(1, n_levels + 1, dtype=torch.float64)
    phase = torch.pi * torch.exp2(-octave)[:, None] * (3 + nodes) / 4  # pi f: (octave, node)
    length = torch.exp2(torch.arange(n_bands, dtype=torch.float64))[:, None]
    halved = phase[:, None]
    means = torch.polar((halved * length).sin() / (halved.sin() * length), halved * (1 - length))  # of 2**k samples
    bands = torch.cat([means[:, :-1] - means[:, 1:], means[:, -1:]], dim=1)  # (octave, band, node)
    tau = torch.exp2(octave)[:, None]
    haar = (2 * (halved * tau / 2).sin().square() / (tau * halved.sin())).square()  # |H_j|^2: (octave, level, node)
    weighted = (shares / 2 * haar).unsqueeze(-2) * bands.unsqueeze(1)  # (octave, level, band, node)
    return (weighted @ bands.conj().mT.unsqueeze(1)).real


def _ones(matrix: Tensor) -> Tensor:
    return matrix.new_ones(matrix.shape[-1]).expand(matrix.shape[:-1])
