"""Confidence limits."""

from __future__ import annotations

Z = 1.959963984540054  # standard deviations of a normal estimate from its 95 % limits: the 0.975 quantile
