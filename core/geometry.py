"""Cameras, poses and the frames of reference they live in.

World = local east-north-up metres, tangent to WGS84 at the mission's origin. Camera = x right, y down,
z forward. Pixel centres are integers. Adjacent names cancel: `xyz_world = world_R_cam @ xyz_cam + center`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Source = Literal["visual", "gnss", "vision-only"]

WGS84_A_M = 6378137.0
WGS84_E2 = 6.69437999014e-3


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole with radial distortion x_d = x (1 + k1 r² + k2 r⁴), shared by all frames of one body.

    Pixels are those of the original photo as the sensor wrote it (EXIF orientation ignored). `falloff`: none,
    or nine numbers: the logarithm of the light (`core.tone`) that the lens passes is a ρ² + b ρ⁴ + c ρ⁶ with
    (a, b, c) for red, then green, then blue; ρ = distance from (cx, cy) over half the picture's diagonal. Six
    more, (e, n) for each: ground seen along the unit ray (x, y, z) in the world sends e x + n y more of it.
    """

    width: int
    height: int
    f_px: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    falloff: tuple[float, ...] = ()

    def rays(self, uv: Array) -> Array:
        """Pixels (N, 2) → viewing rays (N, 3) in the camera's frame with z = 1."""
        distorted = (np.asarray(uv, float) - (self.cx, self.cy)) / self.f_px
        xy = distorted.copy()
        if self.k1 or self.k2:
            for _ in range(10):
                r2 = (xy**2).sum(1, keepdims=True)
                xy = distorted / (1 + self.k1 * r2 + self.k2 * r2**2)
        return np.column_stack((xy, np.ones(len(xy))))

    def project(self, xyz_cam: Array) -> Array:
        """Points (N, 3) in the camera's frame, metres, z > 0 → pixels (N, 2)."""
        xy = xyz_cam[:, :2] / xyz_cam[:, 2:]
        r2 = (xy**2).sum(1, keepdims=True)
        return np.asarray(xy * (1 + self.k1 * r2 + self.k2 * r2**2) * self.f_px + (self.cx, self.cy))

    def corners(self) -> Array:
        """The centres of the four corner pixels (4, 2), clockwise from the top left."""
        w, h = self.width - 1.0, self.height - 1.0
        return np.array([[0, 0], [w, 0], [w, h], [0, h]], float)

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera for a copy of the photo resized to (width, height) pixels, areas kept."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            f_px=self.f_px * sx,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )


@dataclass(frozen=True, slots=True)
class Pose:
    """Where one frame was taken and the height of the ground plane that it is drawn on.

    `world_R_cam`: (3, 3), columns are the camera's axes in the world. `center`: (3,) metres, world.
    `ground_h_m`: height of the local stitching plane, world z. `sigma_m`: (east, north, up) or None.
    """

    world_R_cam: Array
    center: Array
    ground_h_m: float
    source: Source = "visual"
    submap: int = 0
    sigma_m: tuple[float, float, float] | None = None

    def ground(self, camera: Camera, uv: Array) -> Array:
        """Pixels (N, 2) → the world points (N, 3) where their rays meet the frame's ground plane."""
        ray = camera.rays(uv) @ self.world_R_cam.T
        return np.asarray(self.center + ray * ((self.ground_h_m - self.center[2]) / ray[:, 2:]))

    def pixels(self, camera: Camera, xyz_world: Array) -> Array:
        """World points (N, 3), metres → pixels (N, 2)."""
        return camera.project((np.asarray(xyz_world, float) - self.center) @ self.world_R_cam)

    def footprint(self, camera: Camera) -> Array:
        """The frame's outline on its ground plane: (4, 2) world metres, corners in `Camera.corners` order."""
        return self.ground(camera, camera.corners())[:, :2]

    def gsd_m(self, camera: Camera) -> float:
        """Ground metres per pixel of the original photo at its centre."""
        return float((self.center[2] - self.ground_h_m) / camera.f_px)


@dataclass(frozen=True, slots=True)
class PosedFrame:
    """A frame that can be drawn: with the photo's bytes, all that a tile is a function of.

    `gain`: what each colour channel's (R, G, B) light (`core.tone`) is multiplied with to balance exposure.
    """

    frame_id: str
    camera: Camera
    pose: Pose
    gain: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class World:
    """The mission's local frame: east-north-up metres, tangent to WGS84 at this origin."""

    lat_deg: float
    lon_deg: float
    alt_m: float = 0.0

    def _enu_R_ecef(self) -> Array:
        lat, lon = np.radians((self.lat_deg, self.lon_deg))
        sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
        return np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])

    def from_geodetic(self, lon_lat_alt: Array) -> Array:
        """(N, 3) longitude and latitude in degrees, ellipsoidal metres → world (N, 3) metres."""
        origin = _ecef(np.array([[self.lon_deg, self.lat_deg, self.alt_m]]))
        return np.asarray((_ecef(np.asarray(lon_lat_alt, float)) - origin) @ self._enu_R_ecef().T)

    def to_geodetic(self, xyz_world: Array) -> Array:
        """World (N, 3) metres → (N, 3) longitude and latitude in degrees, ellipsoidal metres."""
        origin = _ecef(np.array([[self.lon_deg, self.lat_deg, self.alt_m]]))
        return _geodetic(np.asarray(xyz_world, float) @ self._enu_R_ecef() + origin)


def _ecef(lon_lat_alt: Array) -> Array:
    lon, lat = np.radians(lon_lat_alt[:, 0]), np.radians(lon_lat_alt[:, 1])
    alt = lon_lat_alt[:, 2]
    n = WGS84_A_M / np.sqrt(1 - WGS84_E2 * np.sin(lat) ** 2)
    return np.column_stack(
        (
            (n + alt) * np.cos(lat) * np.cos(lon),
            (n + alt) * np.cos(lat) * np.sin(lon),
            (n * (1 - WGS84_E2) + alt) * np.sin(lat),
        )
    )


def _geodetic(xyz: Array) -> Array:
    """ECEF metres (N, 3) → longitude, latitude (degrees) and height (metres), by Bowring to 1e-12 rad."""
    lon = np.arctan2(xyz[:, 1], xyz[:, 0])
    p = np.hypot(xyz[:, 0], xyz[:, 1])
    lat = np.arctan2(xyz[:, 2], p * (1 - WGS84_E2))
    for _ in range(6):
        n = WGS84_A_M / np.sqrt(1 - WGS84_E2 * np.sin(lat) ** 2)
        lat = np.arctan2(xyz[:, 2] + WGS84_E2 * n * np.sin(lat), p)
    n = WGS84_A_M / np.sqrt(1 - WGS84_E2 * np.sin(lat) ** 2)
    alt = p * np.cos(lat) + xyz[:, 2] * np.sin(lat) - n * (1 - WGS84_E2 * np.sin(lat) ** 2)
    return np.column_stack((np.degrees(lon), np.degrees(lat), alt))
