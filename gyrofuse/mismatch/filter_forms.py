"""Low-pass filters of first and second order, digital and analog ones as sampling leaves them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

FILTERS = ("pole", "poles", "bilinear", "sampled", "bilinear2", "sampled2")
_POLES = {"pole": 1.0, "poles": math.sqrt(2) - 1}
ORDERS = {"pole": 1, "poles": 2, "bilinear": 1, "sampled": 1, "bilinear2": 2, "sampled2": 2}


def filter_strength(kind: str, corner: Tensor) -> Tensor:
    """Number of a filter whose power is halved at `corner` cycles per sample: 0 is none."""
    if kind in _POLES:  # 2 q (1 - cos) = x (1 - q)^2 at the corner, where one pole lets 1 / (1 + x) pass
        b = 1 + (1 - torch.cos(2 * math.pi * corner)) / _POLES[kind]
        return b - (b.square() - 1).sqrt()
    if kind == "bilinear":
        return 1 / torch.tan(math.pi * corner).square()
    if kind == "sampled":
        return 1 / (2 * corner).square()
    if kind == "bilinear2":
        return 1 / torch.tan(math.pi * corner).pow(4)
    return 1 / (2 * corner).pow(4)


def filter_corner(kind: str, strength: Tensor) -> Tensor:
    """Cycles per sample at which a filter halves the power; infinite where it never does."""
    q = strength.clamp(min=1e-300)
    if kind in _POLES:
        cosine = 1 - _POLES[kind] * (1 - q).square() / (2 * q)
        return torch.where(cosine >= -1, cosine.clamp(-1, 1).acos() / (2 * math.pi), math.inf)
    order = 1 / 2 if kind in ("bilinear", "sampled") else 1 / 4
    if kind.startswith("bilinear"):
        return torch.atan(q.pow(-order)) / math.pi
    return q.pow(-order) / 2


def filter_power(kind: str, strength: Tensor, f: Tensor) -> Tensor:
    """Squared response `(..., frequency)` of filters of `strength` `(...,)`."""
    q = strength[..., None]
    if kind in _POLES:
        q = q.clamp(max=0.9999)
        power = (1 - q).square() / ((1 - q).square() + 4 * q * torch.sin(math.pi * f).square())
        return power if kind == "pole" else power.square()
    at = torch.tan(math.pi * f.clamp(max=0.49999999)) if kind.startswith("bilinear") else 2 * f
    return 1 / (1 + q * at.square()) if ORDERS[kind] == 1 else 1 / (1 + q * at.pow(4))


def filter_response(kind: str, strength: Tensor, f: Tensor) -> Tensor:
    """Complex response `(..., frequency)`, causal."""
    q = strength[..., None]
    turn = 2 * math.pi * f
    if kind in _POLES:
        q = q.clamp(max=0.9999)
        response = (1 - q) / (1 - q * torch.polar(torch.ones_like(turn), -turn))
        return response if kind == "pole" else response.square()
    at = torch.tan(math.pi * f.clamp(max=0.49999999)) if kind.startswith("bilinear") else 2 * f
    if ORDERS[kind] == 1:
        return 1 / (1 + 1j * q.sqrt() * at)
    s = q.pow(0.25) * at
    return 1 / torch.complex(1 - s.square(), math.sqrt(2) * s)
