"""Attitude: quaternions `(..., 4)`, scalar first, that rotate vectors from the body to the navigation frame."""

from __future__ import annotations

import torch
from torch import Tensor

# Angle, rad, below which trigonometric quotients are replaced by series of two terms: the third term is then below
# 1e-17, the rounding of float64.
SMALL_ANGLE = 1e-4


def multiply(p: Tensor, q: Tensor) -> Tensor:
    """Hamilton product `p q`: the rotation `q`, then `p`."""
    pw, pv, qw, qv = p[..., :1], p[..., 1:], q[..., :1], q[..., 1:]
    scalar = pw * qw - (pv * qv).sum(-1, keepdim=True)
    return torch.cat([scalar, pw * qv + qw * pv + torch.linalg.cross(pv, qv)], -1)


def conjugate(q: Tensor) -> Tensor:
    """Conjugate, the inverse rotation of a unit quaternion."""
    return torch.cat([q[..., :1], -q[..., 1:]], -1)


def from_rotation_vector(phi: Tensor) -> Tensor:
    """Quaternion of the rotation about `phi` `(..., 3)` by its length in radians."""
    angle = phi.norm(dim=-1, keepdim=True)
    square = angle.square()
    half = torch.where(angle < SMALL_ANGLE, 0.5 - square / 48, torch.sin(angle / 2) / angle.clamp(min=SMALL_ANGLE))
    return torch.cat([torch.cos(angle / 2), half * phi], -1)


def rotation_vector(q: Tensor) -> Tensor:
    """Rotation vector `(..., 3)` of a unit quaternion, of length at most pi, rad."""
    q = torch.where(q[..., :1] < 0, -q, q)
    sine = q[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, q[..., :1])
    scale = torch.where(sine < SMALL_ANGLE, 2 / q[..., :1].clamp(min=0.5), angle / sine.clamp(min=SMALL_ANGLE))
    return scale * q[..., 1:]


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors `(..., 3)` rotated by unit quaternions."""
    twice = 2 * torch.linalg.cross(q[..., 1:].expand_as(v), v)
    return v + q[..., :1] * twice + torch.linalg.cross(q[..., 1:].expand_as(v), twice)


def matrix(q: Tensor) -> Tensor:
    """Direction cosine matrix `(..., 3, 3)`, body to navigation frame."""
    axes = torch.eye(3, dtype=q.dtype, device=q.device).expand(*q.shape[:-1], 3, 3)
    return rotate(q[..., None, :], axes).mT


def from_euler(angles: Tensor) -> Tensor:
    """Quaternion of roll, pitch and yaw `(..., 3)` in radians: yaw first, about the axis that points down.

    It corresponds to the transpose of the matrix of Groves, second edition, (2.22): from body to navigation frame.
    """
    half = angles / 2
    (cr, cp, cy), (sr, sp, sy) = torch.cos(half).unbind(-1), torch.sin(half).unbind(-1)
    return torch.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        -1,
    )


def skew(v: Tensor) -> Tensor:
    """Matrix `(..., 3, 3)` with `skew(v) x = v × x`."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
