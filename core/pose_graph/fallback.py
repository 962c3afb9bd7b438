"""Where a frame lies that ties to no other: position and heading only (the gnss mode of OpenREALM)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

from core.geometry import Array, Camera, Pose
from core.pose_graph.attitude import rotation_of
from core.pose_graph.model import PoseParams
from core.pose_graph.residuals import IntArray
from core.pose_graph.start import expected_down
from core.pose_graph.survey import Survey

NEAREST = 5


def gnss_poses(
    s: Survey, rows: IntArray, placed: Mapping[str, Pose], offset: Array, params: PoseParams
) -> dict[int, Pose]:
    """Poses of the frames `rows` that have GPS, from it, the heading and the ground below their `placed`
    neighbours; `offset` (D,) corrects the yaw by drone, NaN = unknown.
    """
    _, trusted = expected_down(s)
    visual = [(k, placed[f.frame_id]) for k, f in enumerate(s.frames) if f.frame_id in placed]
    visual = [(k, p) for k, p in visual if p.source == "visual"]
    at = np.array([p.center for _, p in visual]).reshape(-1, 3)
    ground = np.array([p.ground_h_m for _, p in visual])
    height = at[:, 2] - ground if len(at) else ground
    camera = s.camera[[k for k, _ in visual]] if visual else np.zeros(0, np.int64)
    out: dict[int, Pose] = {}
    for k in rows.tolist():
        if not s.has_gps[k]:
            continue
        if len(at):
            near = np.lexsort((np.hypot(*(at[:, :2] - s.gps[k, :2]).T), camera != s.camera[k]))[:NEAREST]
            h, above = float(np.median(ground[near])), float(np.median(height[near]))
        else:
            above = float(s.relative_alt_m[k]) if s.relative_alt_m[k] > 5.0 else params.assumed_height_m
            h = float(s.gps[k, 2]) - above if np.isfinite(s.gps[k, 2]) else 0.0
        yaw, pitch, roll = s.attitude[k]
        R = rotation_of(
            np.array([_yaw(s, k, float(yaw), offset)]),
            np.array([pitch if trusted[k] else -np.pi / 2]),
            np.array([roll if trusted[k] and np.isfinite(roll) else 0.0]),
        )[0]
        sigma = float(s.gps_sigma[k])
        out[k] = Pose(R, np.array([*s.gps[k, :2], h + above]), h, "gnss", 0, (sigma, sigma, 0.3 * above))
    return out


def _yaw(s: Survey, k: int, yaw: float, offset: Array) -> float:
    if np.isfinite(yaw):
        return yaw + float(np.nan_to_num(offset[s.drone[k]]))
    east, north = s.velocity[k]
    return float(np.arctan2(east, north))


def is_oblique(pose: Pose, camera: Camera, ratio: float) -> bool:
    """Whether a corner of the picture shows the sky, or ground further away than `ratio` times the height."""
    ray = _corner_rays(camera) @ pose.world_R_cam.T
    return bool((ray[:, 2] >= 0).any() or (np.hypot(ray[:, 0], ray[:, 1]) > -ratio * ray[:, 2]).any())


@lru_cache(maxsize=64)
def _corner_rays(camera: Camera) -> Array:
    return camera.rays(camera.corners())
