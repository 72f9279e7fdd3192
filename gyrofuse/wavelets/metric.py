"""The wavelet cross-covariance as a streaming, distributed metric."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from gyrofuse._base.checks import check_positive_integer, check_signal
from gyrofuse.wavelets.covariance import mean_products
from gyrofuse.wavelets.tiles import WaveletProducts


class WaveletCrossCovariance(Metric):
    """Wavelet cross-covariance of a recording that arrives in chunks, over one process or many.

    `update` takes consecutive chunks of any length and carries what the wavelets need of the past, at most
    `2**n_levels` samples a sensor, so memory does not grow with the recording. Sums and counts of products are
    what processes add up: each takes a stretch of time, and `prime`s with the `2**n_levels - 1` samples before it
    so that no window across the seam is lost or counted twice.

    Args:
        n_sensors: Number of sensors p.
        n_levels: Number of levels J.
        dtype: Dtype of the arithmetic; sums and counts are always float64.
        **kwargs: Passed on to `torchmetrics.Metric` (`sync_on_compute`, `process_group`, ...).

    Raises:
        ValueError: `n_sensors` or `n_levels` is not a whole number of at least 1.

    References:
        [Z] section II, the estimator between equations (6) and (7).

    Example:
        >>> metric = WaveletCrossCovariance(n_sensors=6, n_levels=12)
        >>> for chunk in chunks:  # each (sensor, time)
        ...     metric.update(chunk)
        >>> wccv = metric.compute()  # (level, sensor, sensor)
    """

    is_differentiable = False
    higher_is_better = None
    full_state_update = False

    sums: Tensor
    counts: Tensor

    def __init__(self, n_sensors: int, n_levels: int, *, dtype: torch.dtype = torch.float64, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.n_sensors = check_positive_integer("n_sensors", n_sensors)
        self.n_levels = check_positive_integer("n_levels", n_levels)
        self.signal_dtype = dtype
        shape = (self.n_levels, self.n_sensors, self.n_sensors)
        self.add_state("sums", torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("counts", torch.zeros(shape, dtype=torch.float64), dist_reduce_fx="sum")
        self._products: WaveletProducts | None = None
        self._settled: tuple[Tensor, Tensor] | None = None
        self._updated = False

    @property
    def n_samples(self) -> int:
        """Samples that this process has taken in since the last reset, those of `prime` included."""
        return 0 if self._products is None else self._products.n_samples

    def update(self, chunk: Tensor) -> None:
        """Take in the next chunk.

        Args:
            chunk: `(sensor, time)`, right after the previous chunk; non-finite samples are missing.

        Raises:
            TypeError: `chunk` is not a floating point tensor.
            ValueError: Another number of sensors, or another device than the chunks before.
        """
        self._take("chunk", chunk)
        self._updated = True

    def prime(self, history: Tensor) -> None:
        """Take in the samples just before the first chunk, without counting their own windows.

        A long history may come in several calls, oldest first.

        Args:
            history: `(sensor, time)`, the `2**n_levels - 1` samples before the first chunk, or all there are.

        Raises:
            RuntimeError: Chunks were already taken in.
            TypeError: `history` is not a floating point tensor.
            ValueError: Another number of sensors.
        """
        if self._updated:
            raise RuntimeError("`prime` comes before the first `update`; call reset() to start again")
        self._take("history", history)
        self._settled = self._totals()

    def compute(self) -> Tensor:
        """Return the wavelet cross-covariance so far, `(level, sensor, sensor)`, unit of the signal squared."""
        self._settle()
        if not bool((self.counts > 0).any()):
            warnings.warn("fewer than two samples in a row taken in so far: every level is NaN", stacklevel=2)
            return torch.full_like(self.sums, torch.nan).to(self.signal_dtype)
        return mean_products(self.sums, self.counts).to(self.signal_dtype)

    def forward(self, chunk: Tensor) -> Tensor:
        """Update with a chunk and return the wavelet cross-covariance of everything so far."""
        self.update(chunk)
        return self.compute()

    def sync(self, *args: Any, **kwargs: Any) -> None:
        """Synchronise over processes, with the samples of the unfinished tile included."""
        self._settle()
        super().sync(*args, **kwargs)

    def merge_state(self, incoming_state: dict[str, Any] | Metric) -> None:
        """Add the sums and counts of another metric or state to this one's."""
        self._settle()
        if isinstance(incoming_state, WaveletCrossCovariance):
            incoming_state._settle()
        super().merge_state(incoming_state)
        self._computed = None

    def reset(self) -> None:
        """Forget everything, the carried past included."""
        super().reset()
        self._products = None
        self._settled = None
        self._updated = False

    def _take(self, name: str, chunk: Tensor) -> None:
        check_signal(name, chunk)
        if chunk.shape[:-1] != (self.n_sensors,):
            raise ValueError(
                f"`{name}`: expected (sensor, time) with {self.n_sensors} sensors, got shape {tuple(chunk.shape)}"
            )
        if self._products is None:
            self._products = WaveletProducts(
                1, self.n_sensors, self.n_levels, dtype=self.signal_dtype, device=chunk.device
            )
        elif chunk.device != self._products.device:
            raise ValueError(
                f"`{name}`: expected device {self._products.device} as before, got {chunk.device}; "
                "keep one device from reset() to reset()"
            )
        self._products.update(chunk.detach().unsqueeze(0))

    def _totals(self) -> tuple[Tensor, Tensor]:
        assert self._products is not None
        sums, counts = self._products.totals()
        return sums[:, 0, 0], counts[:, 0, 0]  # one item, one bin

    def _settle(self) -> None:
        """Bring the states up to date with the sums, which the chunks reach only tile by tile."""
        if self._products is None or self._is_synced:
            return
        sums, counts = self._totals()
        before_sums, before_counts = (0.0, 0.0) if self._settled is None else self._settled
        self.sums = self.sums + (sums - before_sums).to(self.sums.device)
        self.counts = self.counts + (counts - before_counts).to(self.counts.device)
        self._settled = (sums, counts)
