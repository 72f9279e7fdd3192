"""Filter between an auxiliary channel and the sensors that all of them share.

`x_i(t) = sum_k g_ik (m * a_k)(t)` with one causal response `m` for all sensors `i` and rows `k`: a mount, a lag,
another converter. It is a sum of the channel itself and Laguerre's filters of one pole `p`, a low-pass and all-passes
after it,

    m = w_0 + sum_b w_b L(z) A(z)^(b - 1),   L = (1 - p) / (1 - p / z),   A = (1 / z - p) / (1 - p / z),

all of gain one at frequency 0. A motion that sensors and channel both feel, each in its own way, is no such product.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from scipy.signal import lfilter
from torch import Tensor

from gyrofuse.mismatch.detectors.slow.channels import ChannelFit, regress
from gyrofuse.mismatch.signals.comparison import Comparison

_COARSE, _ORDER = 4, 9  # terms of a response, the channel itself included: to find the pole, and at most in the end


@dataclass(frozen=True, eq=False)
class Transfer:
    """A response that sensors share.

    Attributes:
        pole: `p`, from 0 to 1.
        weights: `w`, `(term,)`; of a plain gain a single one.
    """

    pole: float
    weights: Tensor

    def applied(self, rows: Tensor) -> Tensor:
        """Rows `(row, time)` through it, from rest at zero."""
        return torch.tensordot(self.weights, terms(rows, self.pole, len(self.weights)), 1)

    def response(self, f: Tensor) -> Tensor:
        """Complex gain at `f` cycles per sample, `(frequency,)`."""
        late = torch.polar(torch.ones_like(f), -2 * math.pi * f)
        low, turn = (1 - self.pole) / (1 - self.pole * late), (late - self.pole) / (1 - self.pole * late)
        made = [torch.ones_like(low), *(low * turn**b for b in range(len(self.weights) - 1))]
        return torch.tensordot(self.weights.to(low.dtype), torch.stack(made), 1)

    def scaled(self, comparison: Comparison, rows: Tensor, gains: Tensor) -> tuple[Transfer, float, float]:
        """The same response, normalised to one where the gains have most of their information.

        Args:
            comparison: Recording and simulation.
            rows: Made of the channel, `(row, time)`.
            gains: Gains on the rows, `(sensor, row)`.

        Returns:
            The response, the mean frequency of the information in cycles per sample, and the delay there in cycles.
        """
        spectrum = torch.fft.rfft(rows)[:, 1:]
        f = torch.arange(1, spectrum.shape[-1] + 1, dtype=torch.float64) / rows.shape[-1]
        information = ((gains.to(spectrum.dtype) @ spectrum).abs().square() / comparison.base.spectrum(f)).sum(0)
        information = information / information.sum()
        response = self.response(f)
        mean = (information * response).sum()
        size = float((information * response.abs().square()).sum().sqrt()) * (1.0 if float(mean.real) > 0 else -1.0)
        turn = float((mean / size).angle()) / (2 * math.pi)
        return Transfer(self.pole, self.weights / size), float(information @ f), -turn


def terms(rows: Tensor, pole: float, count: int) -> Tensor:
    """Rows `(row, time)` and what Laguerre's filters make of them, `(term, row, time)`."""
    made = [rows]
    for b in range(1, count):
        numerator = [1 - pole] if b == 1 else [-pole, 1.0]
        made.append(torch.from_numpy(lfilter(numerator, [1.0, -pole], made[-1].numpy(), axis=-1)))
    return torch.stack(made)


def likeliest_transfer(comparison: Comparison, rows: Tensor, fit: ChannelFit) -> Transfer | None:
    """The response through which sensors follow rows `(row, time)`; None where a plain gain does as well.

    Of those that the sensors which follow most share, the likeliest beside what its numbers cost (Schwarz). None where
    each sensor and row has a response of its own.

    Args:
        comparison: Recording and simulation.
        rows: Made of the channel, without means.
        fit: Of plain gains.
    """
    if fit.excess + fit.quadrature - fit.gains.numel() < 60:  # statistic that leaves something to a response's numbers
        return None
    which = fit.squares.topk(min(4, len(fit.squares))).indices.sort().values  # the sensors that show most of it
    # Corners from half the Nyquist frequency to eight cycles in the record.
    corners = torch.logspace(math.log10(0.25), math.log10(8 / comparison.n_samples), 12).tolist()
    poles = [math.exp(-2 * math.pi * corner) for corner in corners]
    coarse = [_through(comparison, rows, pole, _COARSE, which)[0] for pole in poles]
    best = max(range(len(poles)), key=lambda k: coarse[k])
    fine = [_through(comparison, rows, pole, _ORDER, which) for pole in poles[max(best - 1, 0) : best + 2]]
    net, transfer = max(fine, key=lambda entry: entry[0])
    return transfer if net > 0 else None


def _through(comparison: Comparison, rows: Tensor, pole: float, order: int, which: Tensor) -> tuple[float, Transfer]:
    """Nats of the best response of a pole over a plain gain, less the cost of its numbers, and the response.

    Minus infinity where responses that each sensor and row has for itself explain more than twice as much.

    Args:
        comparison: Recording and simulation.
        rows: Made of the channel, `(row, time)`.
        pole: Pole of the response.
        order: Terms of the response at most.
        which: Positions of the sensors that determine it.
    """
    plain = Transfer(pole, torch.ones(1, dtype=torch.float64))
    full = regress(comparison, terms(rows, pole, order).flatten(0, 1), which=which, late_as_well=False)
    if full is None:
        return -math.inf, plain
    shape = (len(which), order, len(rows))
    matrix = torch.linalg.inv(full.covariance.flatten(2).flatten(0, 1))
    moment = (matrix @ full.gains.flatten()).view(shape)
    matrix = matrix.view(*shape, *shape)
    found = [_explained(matrix[:, :count, :, :, :count], moment[:, :count]) for count in range(1, order + 1)]
    least, cost = max(found[0][0], 0.0), math.log(comparison.n_samples) / 2
    nets = [gain - least - len(weights) * cost for gain, weights in found[1:]]
    best = max(range(len(nets)), key=lambda k: nets[k])
    gain, weights = found[best + 1]
    shared = gain > full.statistic / 4
    return (nets[best] if shared else -math.inf), Transfer(pole, weights)


def _explained(matrix: Tensor, moment: Tensor) -> tuple[float, Tensor]:
    """Nats of the best product of gains `(sensor, row)` and weights `(term,)`, by turns, and the weights.

    Args:
        matrix: Information of all numbers, `(sensor, term, row, sensor, term, row)`.
        moment: `(sensor, term, row)`.
    """
    n_sensors, count, n_rows = moment.shape
    weights = torch.zeros(count, dtype=torch.float64)
    weights[0] = 1.0
    nats = 0.0
    for _ in range(40 if count > 1 else 1):
        own = torch.einsum("b,ibkjcl,c->ikjl", weights, matrix, weights).reshape(n_sensors * n_rows, -1)
        gains = torch.linalg.solve(own, torch.einsum("b,ibk->ik", weights, moment).flatten()).view(n_sensors, n_rows)
        shared = torch.einsum("ik,ibkjcl,jl->bc", gains, matrix, gains)
        score = torch.einsum("ik,ibk->b", gains, moment)
        weights = torch.linalg.lstsq(shared, score[:, None], driver="gelsd").solution[:, 0]
        last, nats = nats, float(score @ weights) / 2
        if nats - last < 0.01:  # far below what a decision hangs on
            break
    return nats, weights
