"""Rotations from headings and gimbal angles."""

from __future__ import annotations

import numpy as np

from core.geometry import Array


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


def circular_mean(angle: Array) -> tuple[float, float]:
    """Mean direction of angles (N,), radians, and how well they agree (0 … 1)."""
    total = np.exp(1j * angle).mean()
    return float(np.angle(total)), float(np.abs(total))
