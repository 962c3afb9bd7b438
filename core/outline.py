"""What a frame shows of the ground, also when part of it looks at the horizon."""

from __future__ import annotations

import math

import numpy as np

from core.geometry import Array, PosedFrame

MAX_VIEW_RAD = math.radians(75)


def ground_outline(frame: PosedFrame, max_view_rad: float = MAX_VIEW_RAD) -> Array | None:
    """The frame's four corners on its ground plane, (4, 2) world metres in `Camera.corners` order.

    A corner that looks further from straight down than `max_view_rad` (or above the horizon) is pulled in to
    that angle, so that no outline is endless. None where nothing is seen: a frame that looks upwards, or
    whose ground lies above it.
    """
    pose = frame.pose
    height = float(pose.center[2] - pose.ground_h_m)
    if height <= 0 or pose.world_R_cam[2, 2] >= 0:
        return None
    rays = frame.camera.rays(frame.camera.corners()) @ pose.world_R_cam.T
    across = np.hypot(rays[:, 0], rays[:, 1])
    off_nadir = np.minimum(np.arctan2(across, -rays[:, 2]), max_view_rad)
    reach = height * np.tan(off_nadir) / np.maximum(across, 1e-12)
    return np.asarray(pose.center[:2] + rays[:, :2] * reach[:, None])
