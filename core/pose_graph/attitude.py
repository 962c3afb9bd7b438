"""Rotations from headings and gimbal angles."""

from __future__ import annotations

import numpy as np

from core.geometry import Array

CANDIDATES = 200
AROUND_RAD = 0.35


def rotation_of(yaw: Array, pitch: Array, roll: Array) -> Array:
    """world_R_cam (N, 3, 3) of gimbal angles (N,), radians; pitch −π/2 looks straight down."""
    sy, cy, sp, cp = np.sin(yaw), np.cos(yaw), np.sin(pitch), np.cos(pitch)
    forward = np.stack((cp * sy, cp * cy, sp), -1)
    right = np.stack((cy, -sy, np.zeros_like(cy)), -1)
    down = np.cross(forward, right)
    sr, cr = np.sin(roll)[:, None], np.cos(roll)[:, None]
    return np.stack((right * cr + down * sr, down * cr - right * sr, forward), -1)


def level_to_world(yaw: Array) -> Array:
    """world_R_cam (N, 3, 3) of cameras that look straight down."""
    return rotation_of(yaw, np.full_like(yaw, -np.pi / 2), np.zeros_like(yaw))


def levelling(down: Array) -> Array:
    """The smallest rotations (N, 3, 3) that turn unit vectors `down` (N, 3) onto the z axis."""
    x, y, z = down[:, 0], down[:, 1], np.maximum(down[:, 2], -0.999)
    k = 1 / (1 + z)
    rows = (
        np.stack((1 - k * x * x, -k * x * y, -x), -1),
        np.stack((-k * x * y, 1 - k * y * y, -y), -1),
        np.stack((x, y, z), -1),
    )
    return np.stack(rows, 1)


def circular_median(angle: Array) -> tuple[float, float]:
    """The direction with the least absolute differences to angles (N,), radians, refined by the mean of those
    around it; and the share of them that are around it. Half a turn in less than half of them does nothing.
    """
    tried = angle[np.unique(np.linspace(0, len(angle) - 1, min(len(angle), CANDIDATES)).astype(int))]
    off = np.abs(np.angle(np.exp(1j * (angle[None] - tried[:, None]))))
    best = int(np.argmin(off.sum(1)))
    near = off[best] < AROUND_RAD
    return float(np.angle(np.exp(1j * angle[near]).sum())), float(near.mean())
