"""The frames of a mission as arrays in one local world, in an order that does not depend on arrival."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from core.frame import GpsFix
from core.geometry import Array, Camera, World
from core.pose_graph.model import GraphFrame, PoseParams
from core.pose_graph.residuals import IntArray

# Between two fixes further apart in time the drone may have turned.
MAX_GAP_S = 20.0


@dataclass(frozen=True, slots=True)
class Survey:
    """N frames sorted by frame id. Absent values are NaN.

    `gps`: (N, 3) world metres; xy NaN without a fix, z NaN without its altitude. `velocity`: (N, 2) m/s over
    ground from the drone's GPS track, 0 where unknown. `attitude`: (N, 3) yaw, pitch, roll in radians.
    `relative_alt_m`: (N,). `camera`, `drone`: (N,) indices into `cameras` and `drones`. `far`: (N,) whose GPS
    lies on another continent, their fix is left out of `gps`.
    """

    frames: tuple[GraphFrame, ...]
    world: World
    cameras: tuple[Camera, ...]
    camera_keys: tuple[str, ...]
    focal_known: NDArray[np.bool_]
    drones: tuple[str, ...]
    camera: IntArray
    drone: IntArray
    gps: Array
    gps_sigma: Array
    altitude_sigma: Array
    velocity: Array
    attitude: Array
    relative_alt_m: Array
    far: NDArray[np.bool_]

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.frames)

    @property
    def has_gps(self) -> NDArray[np.bool_]:
        """(N,) whether a frame has a fix that counts."""
        return np.asarray(np.isfinite(self.gps[:, 0]))

    def take(self, rows: IntArray) -> Survey:
        """The survey of some of its frames, in the order of `rows`."""
        picked = {name: getattr(self, name)[rows] for name in _PER_FRAME}
        return replace(self, frames=tuple(self.frames[k] for k in rows), **picked)

    def without_fixes(self, bad: NDArray[np.bool_]) -> Survey:
        """The survey as if the frames `bad` (N,) had no fix, nor any speed that comes from it."""
        if not bad.any():
            return self
        gps = np.where(bad[:, None], np.nan, self.gps)
        return replace(self, gps=gps, velocity=_velocities(self.frames, self.drone, gps))


_PER_FRAME = (
    "camera", "drone", "gps", "gps_sigma", "altitude_sigma", "velocity", "attitude", "relative_alt_m", "far",
)  # fmt: skip


def usable_fix(fix: GpsFix | None) -> GpsFix | None:
    """`fix` unless it is one of those that receivers write when they know nothing."""
    if fix is None or not (np.isfinite(fix.lat_deg) and np.isfinite(fix.lon_deg)):
        return None
    if abs(fix.lat_deg) > 90 or abs(fix.lon_deg) > 180 or (fix.lat_deg == 0 and fix.lon_deg == 0):
        return None
    return fix


def capture_order(frame: GraphFrame) -> tuple[float, str, str]:
    """Sorts frames by the time of capture; what has none comes last."""
    time = frame.meta.captured_s
    return (np.inf if time is None or not np.isfinite(time) else time, frame.name, frame.frame_id)


def survey(frames: Sequence[GraphFrame], params: PoseParams, world: World | None = None) -> Survey:
    """The frames as arrays; `world` keeps an earlier origin, None chooses one from the set of frames."""
    ordered = tuple(sorted({f.frame_id: f for f in frames}.values(), key=lambda f: f.frame_id))
    fixes = [usable_fix(f.meta.gps) for f in ordered]
    lonlat = np.array([(g.lon_deg, g.lat_deg) if g else (np.nan, np.nan) for g in fixes]).reshape(-1, 2)
    altitude = np.array([_number(g.alt_m if g else None) for g in fixes])
    far = _far_frames(lonlat, params.far_m, world)
    lonlat[far], altitude[far] = np.nan, np.nan
    world = world or _origin(lonlat, altitude)
    gps = np.full((len(ordered), 3), np.nan)
    known = np.isfinite(lonlat[:, 0])
    if known.any():
        height = np.where(np.isfinite(altitude), altitude, world.alt_m)
        gps[known] = world.from_geodetic(np.column_stack((lonlat, height))[known])
        gps[~np.isfinite(altitude), 2] = np.nan
    keys = [f.meta.camera_key for f in ordered]
    camera_keys, drones = tuple(sorted(set(keys))), tuple(sorted({f.meta.drone for f in ordered}))
    first = {k: f.meta for k, f in zip(reversed(keys), reversed(ordered), strict=True)}
    drone = np.array([drones.index(f.meta.drone) for f in ordered], np.int64)
    sigma_h = np.array([_number(g.sigma_h_m if g else None) for g in fixes])
    sigma_v = np.array([_number(g.sigma_v_m if g else None) for g in fixes])
    angles = [(f.meta.attitude.yaw_rad, f.meta.attitude.pitch_rad, f.meta.attitude.roll_rad) for f in ordered]
    return Survey(
        frames=ordered,
        world=world,
        cameras=tuple(first[k].camera() for k in camera_keys),
        camera_keys=camera_keys,
        focal_known=np.array([first[k].f_px is not None for k in camera_keys]),
        drones=drones,
        camera=np.array([camera_keys.index(k) for k in keys], np.int64),
        drone=drone,
        gps=gps,
        gps_sigma=np.where(sigma_h > 0, np.maximum(sigma_h, params.gps_floor_m), params.gps_sigma_m),
        altitude_sigma=np.where(sigma_v > 0, np.maximum(sigma_v, 0.5), params.altitude_sigma_m),
        velocity=_velocities(ordered, drone, gps),
        attitude=np.array([[_number(a) for a in triple] for triple in angles]).reshape(-1, 3),
        relative_alt_m=np.array([_number(f.meta.relative_alt_m) for f in ordered]),
        far=far,
    )


def _number(value: float | None) -> float:
    return np.nan if value is None or not np.isfinite(value) else float(value)


def _origin(lonlat: Array, altitude: Array) -> World:
    """Near the middle of the mission; rounded, so that it seldom moves while frames come in."""
    known = np.isfinite(lonlat[:, 0])
    if not known.any():
        return World(0.0, 0.0, 0.0)
    lon, lat = np.median(lonlat[known], axis=0)
    alt = altitude[np.isfinite(altitude)]
    return World(
        round(float(lat), 3), round(float(lon), 3), round(float(np.median(alt)), -1) if len(alt) else 0.0
    )


def _far_frames(lonlat: Array, far_m: float, world: World | None) -> NDArray[np.bool_]:
    """(N,) whose fix lies further than `far_m` from the crowd's middle (or from a given origin)."""
    far, known = np.zeros(len(lonlat), bool), np.isfinite(lonlat[:, 0])
    if not known.any():
        return far
    lon, lat = np.radians(lonlat[known]).T
    xyz = 6.371e6 * np.column_stack((np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)))
    if world is not None:
        lo, la = np.radians((world.lon_deg, world.lat_deg))
        middle = 6.371e6 * np.array([np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)])
    else:
        middle = np.median(xyz, axis=0)
        if (np.linalg.norm(xyz - middle, axis=1) > far_m).any():
            crowd = np.asarray(cKDTree(xyz).query_ball_point(xyz, far_m, return_length=True))
            centre = xyz[np.lexsort((*xyz.T, -crowd))[0]]
            middle = np.median(xyz[np.linalg.norm(xyz - centre, axis=1) <= far_m], axis=0)
    far[known] = np.linalg.norm(xyz - middle, axis=1) > far_m
    return far


def _velocities(frames: tuple[GraphFrame, ...], drone: IntArray, gps: Array) -> Array:
    """Speed over ground (N, 2) m/s by central differences along each drone's track; 0 where it has gaps."""
    velocity = np.zeros((len(frames), 2))
    time = np.array([_number(f.meta.captured_s) for f in frames])
    for d in np.unique(drone):
        usable = (drone == d) & np.isfinite(time) & np.isfinite(gps[:, 0])
        order = sorted(
            np.flatnonzero(usable).tolist(), key=lambda k: (time[k], frames[k].name, frames[k].frame_id)
        )
        for a, k, b in zip([*order[:1], *order[:-1]], order, [*order[1:], *order[-1:]], strict=True):
            span = time[b] - time[a]
            if 0 < span <= MAX_GAP_S:
                velocity[k] = (gps[b, :2] - gps[a, :2]) / span
    velocity[np.linalg.norm(velocity, axis=1) > 60.0] = 0.0
    return velocity
