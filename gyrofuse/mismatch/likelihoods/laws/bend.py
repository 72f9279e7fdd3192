"""Likelihood of noise behind a bent response: a curve takes what was put out back to what was felt.

With `y` put out, the curve `h` has slopes `b_k > 0` at knots, linear in between and constant beyond them: it is
`sum_k b_k B_k(y)` with the integrals `B_k` of hat functions. With `e_k` their whitened courses, Gaussian noise of a
known spectrum and of any level has the log likelihood

    -n/2 log(b' G b) + sum_t log(b' D_t),   G = sum_t e_t e_t',   D_t the hat functions at y_t,

which does not depend on the scale of `b`. Everything is linear in `b` but the logarithms: one transform a knot.

References:
    Box and Cox, An analysis of transformations, JRSS B 26 (1964), 211.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import optimize
from torch import Tensor

from gyrofuse.mismatch.signals.lines import whitened
from gyrofuse.mismatch.signals.noise_spectrum import NoiseSpectrum

Array = NDArray[np.float64]


class Curve(NamedTuple):
    """A rising curve through zero, of piecewise linear slope.

    Attributes:
        knots: Where its slope is given, rising, `(knot,)`.
        slopes: There, and beyond the first and the last, `(knot,)`.
    """

    knots: Array
    slopes: Array

    def slope(self, y: Array) -> Array:
        return np.interp(y, self.knots, self.slopes)

    def at(self, y: Array) -> Array:
        """Its values: the integral of the slope from zero on."""
        return self._integral(y) - self._integral(np.zeros(1))

    def inverse(self, x: Array) -> Array:
        """Where it has some values."""
        at_knots, start = self._integral(self.knots), self._integral(np.zeros(1))
        x = x + start
        k = np.clip(np.searchsorted(at_knots, x, side="right") - 1, 0, len(self.knots) - 2)
        rise, low = x - at_knots[k], self.slopes[k]
        bend = (self.slopes[k + 1] - low) / (self.knots[k + 1] - self.knots[k])
        # Of b d + c d^2 / 2 = r, in the form that holds without a bend as well.
        within = 2 * rise / (low + np.sqrt(np.clip(low**2 + 2 * bend * rise, 0, None)))
        last = self.knots[-1] + (x - at_knots[-1]) / self.slopes[-1]
        found = np.where(x < at_knots[0], self.knots[0] + rise / self.slopes[0], self.knots[k] + within)
        return np.where(x > at_knots[-1], last, found)

    def coefficients(self, mean: float, sd: float) -> Array:
        """Quadratic and cubic coefficient of its inverse, over the linear one, where it has normal values.

        Those of the regression on Hermite polynomials, of values of a mean and a standard deviation.
        """
        u = np.linspace(-8, 8, 801)
        y, weight = self.inverse(mean + sd * u), np.exp(-(u**2) / 2)
        rise, square, cube = ((weight * y * he).sum() for he in (u, (u**2 - 1) / 2, (u**3 - 3 * u) / 6))
        return np.array([square / sd, cube / sd**2]) / rise

    def times(self, factor: float) -> Curve:
        return self._replace(slopes=factor * self.slopes)

    def _integral(self, y: Array) -> Array:
        """From the first knot on."""
        wide, means = np.diff(self.knots), (self.slopes[1:] + self.slopes[:-1]) / 2
        whole = np.concatenate([[0.0], np.cumsum(wide * means)])
        k = np.clip(np.searchsorted(self.knots, y, side="right") - 1, 0, len(self.knots) - 2)
        inside = np.clip(y, self.knots[0], self.knots[-1]) - self.knots[k]
        bend = (self.slopes[k + 1] - self.slopes[k]) / wide[k]
        ends = np.minimum(y - self.knots[0], 0) * self.slopes[0] + np.maximum(y - self.knots[-1], 0) * self.slopes[-1]
        return np.asarray(whole[k] + self.slopes[k] * inside + bend * inside**2 / 2 + ends)


class BentNoise(NamedTuple):
    """What the likelihood of curves needs of one sensor.

    Attributes:
        y: Values without their mean, `(time,)`.
        knots: Of the curves, `(knot,)`.
        white: Whitened values of curves of slope one at one knot and zero at the others, `(knot, time)`.
        slopes: Slopes of these, `(knot, time)`.
    """

    y: Array
    knots: Array
    white: Array
    slopes: Array

    @classmethod
    def of(cls, values: Tensor, base: NoiseSpectrum | None, sensor: int, knots: Array) -> BentNoise:
        """Of values `(time,)` of a sensor without their mean; white ones without a base."""
        y = values.numpy()
        hats = [Curve(knots, one) for one in np.eye(len(knots))]
        rows = np.stack([hat.at(y) for hat in hats])
        if base is None:
            white = rows - rows.mean(-1, keepdims=True)
        else:
            own = replace(base, coefficients=base.coefficients[sensor : sensor + 1])
            white = whitened(torch.from_numpy(rows)[:, None], own)[:, 0].numpy()
        return cls(y, knots, white, np.stack([hat.slope(y) for hat in hats]))

    def error(self, curve: Curve) -> Array:
        """What was felt, whitened, `(time,)`."""
        return np.asarray(curve.slopes @ self.white)

    def gains(self, curve: Curve, keep: Array | slice = slice(None)) -> Array:
        """Log likelihood ratio of each sample to a straight response, `(time,)`, levels fitted where to keep."""
        scores = []
        for one in (curve, Curve(self.knots, np.ones(len(self.knots)))):
            error = self.error(one)
            variance = (error[keep] ** 2).mean()
            scores.append(np.log(one.slopes @ self.slopes) - np.log(variance) / 2 - error**2 / (2 * variance))
        return np.asarray(scores[0] - scores[1])

    def likeliest(self, keep: Array | slice = slice(None)) -> Curve:
        """The likeliest curve, of slope one at the knot in the middle."""
        white, slopes = self.white[:, keep], self.slopes[:, keep]
        products, n, middle = white @ white.T, white.shape[1], len(self.knots) // 2

        def curve_of(logs: Array) -> Array:
            return np.exp(np.insert(logs, middle, 0.0))

        def deviance(logs: Array) -> tuple[float, Array]:
            b = curve_of(logs)
            power, rises = b @ products @ b, b @ slopes
            gradient = n * (products @ b) / power - slopes @ (1 / rises)
            return float(n / 2 * np.log(power) - np.log(rises).sum()), np.delete(b * gradient, middle)

        steepest = 8.0  # logarithm of a slope over that in the middle
        start = np.zeros(len(self.knots) - 1)
        bounds = [(-steepest, steepest)] * len(start)
        run = optimize.minimize(deviance, start, jac=True, method="L-BFGS-B", bounds=bounds)
        return Curve(self.knots, curve_of(run.x))

    def covariance(self, curve: Curve) -> Array:
        """Of the logarithms of the slopes, that in the middle known, by the curvature of the likelihood."""
        b, products, n = curve.slopes, self.white @ self.white.T, len(self.y)
        power, ahead = b @ products @ b, products @ b
        each = self.slopes / (b @ self.slopes)
        hessian = n * products / power - 2 * n * np.outer(ahead, ahead) / power**2 + each @ each.T
        free = np.arange(len(b)) != len(b) // 2
        covariance = np.zeros_like(hessian)
        within = (b[:, None] * hessian * b)[np.ix_(free, free)]
        covariance[np.ix_(free, free)] = np.linalg.pinv(within, hermitian=True)
        return covariance
