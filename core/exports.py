"""What leaves orthostream for other programs: poses, footprints, the route and (`core.cog`) the mosaic."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from io import StringIO
from typing import Any

import numpy as np
from pyproj import Transformer

from core.cog import MosaicParams as MosaicParams
from core.cog import flight_gsd_m as flight_gsd_m
from core.cog import write_mosaic as write_mosaic
from core.geometry import Array, Camera, Pose, PosedFrame, World
from core.grid import utm_epsg
from core.outline import ground_outline

_ROUTE_COLUMNS = (
    *("name", "time", "lon", "lat", "alt", "height_above_ground", "easting", "northing"),
    *("sigma_e", "sigma_n", "sigma_u", "source", "submap"),
)


@dataclass(frozen=True, slots=True)
class NamedFrame:
    """A posed frame with what people know it by: the photo's name and when it was taken (s since 1970)."""

    name: str
    posed: PosedFrame
    captured_s: float | None = None


@dataclass(frozen=True, slots=True)
class GridPose:
    """A pose in a projected CRS: axes east, north, up of its grid at the frame's own place; metres, WGS84."""

    grid_R_cam: Array
    center: Array
    ground_height: float


def in_capture_order(frames: Sequence[NamedFrame]) -> list[NamedFrame]:
    """The frames as they were taken, those without a time last, by name."""
    return sorted(frames, key=lambda f: (_time_or_inf(f.captured_s), f.name, f.posed.frame_id))


def grid_pose(world: World, frame: PosedFrame, to_crs: Transformer) -> GridPose:
    """A frame's pose in the CRS that `to_crs` leads to from longitude and latitude.

    Turned by the small angle between the tangent planes at the world's origin and here, and by the grid's
    convergence. `ground_height` is moved (by 4 cm per 100 m at most) so that rays meet the plane at the
    grid's scale, which is not quite 1: pixels come out at the coordinates where the mosaic shows them.
    """
    pose = frame.pose
    lon, lat, alt = world.to_geodetic(pose.center[None])[0]
    foot = world.to_geodetic(np.array([[*pose.center[:2], pose.ground_h_m]]))[0]
    here = World(float(lat), float(lon), float(alt))
    # Both frames are Cartesian: the images of three points 1 km along the axes are the rotation itself.
    here_R_world = here.from_geodetic(world.to_geodetic(pose.center + 1e3 * np.eye(3))).T / 1e3
    there = World(float(lat), float(lon), float(foot[2]))
    meridian = there.to_geodetic(np.array([[0.0, 50.0, 0.0], [0.0, -50.0, 0.0]]))
    east, north = to_crs.transform(meridian[:, 0], meridian[:, 1])
    vx, vy = (east[0] - east[1]) / 100, (north[0] - north[1]) / 100
    scale = math.hypot(vx, vy)
    grid_R_here = np.array([[vy / scale, vx / scale, 0.0], [-vx / scale, vy / scale, 0.0], [0.0, 0.0, 1.0]])
    center = np.array([*to_crs.transform(lon, lat), alt])
    rotation = np.asarray(grid_R_here @ here_R_world @ pose.world_R_cam, float)
    return GridPose(rotation, center, float(alt - scale * (alt - foot[2])))


@dataclass(frozen=True, slots=True)
class WaitingFrame:
    """A frame that waits for a tie, with its pose in metres of its own island; None: it is alone."""

    name: str
    frame_id: str
    camera: Camera
    pose: Pose | None
    captured_s: float | None = None


LOCAL_NOTE = (
    "Not georeferenced: no photo has GPS. Shape and relative heights are right, place and north are assumed, "
    "and so is the scale unless a first height or a marker was given."
)


def is_local(frames: Sequence[NamedFrame]) -> bool:
    """Whether the map lies where nobody knows: vision alone has made it."""
    return any(f.posed.pose.source == "vision-only" for f in frames)


def poses_document(
    world: World,
    frames: Sequence[NamedFrame],
    waiting: Sequence[WaitingFrame] = (),
    graph: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The content of poses.json, in the UTM zone of the world's origin, frames in capture order.

    A map that is not georeferenced says so; `waiting` frames come apart, in metres of their own islands.
    `graph`: as `core.submaps.SubmapGraph.to_json` tells submaps and ties.
    """
    epsg = utm_epsg(world.lat_deg, world.lon_deg)
    to_crs = Transformer.from_crs(4326, epsg, always_xy=True)
    ordered = in_capture_order(frames)
    late = sorted(waiting, key=lambda w: (_time_or_inf(w.captured_s), w.name, w.frame_id))
    cameras = list(dict.fromkeys([*(f.posed.camera for f in ordered), *(w.camera for w in late)]))
    index = {camera: i for i, camera in enumerate(cameras)}
    return {
        "crs": f"EPSG:{epsg}",
        "georeferenced": not is_local(frames),
        **({"note": LOCAL_NOTE} if is_local(frames) else {}),
        "cameras": [_camera_entry(camera) for camera in cameras],
        "frames": [_pose_entry(world, f, index[f.posed.camera], to_crs) for f in ordered],
        "waiting": [_waiting_entry(w, index[w.camera]) for w in late],
        "submaps": (graph or {}).get("submaps", []),
        "ties": (graph or {}).get("ties", []),
    }


def _waiting_entry(frame: WaitingFrame, camera: int) -> dict[str, Any]:
    pose = frame.pose
    if pose is None:
        return {"name": frame.name, "camera": camera, "submap": None}
    return {
        "name": frame.name,
        "camera": camera,
        "source": pose.source,
        "center": [round(float(v), 4) for v in pose.center],
        "R": [[round(float(v), 12) for v in row] for row in pose.world_R_cam],
        "ground_height": round(pose.ground_h_m, 4),
        "submap": pose.submap,
        "sigma_m": [round(float(s), 4) for s in pose.sigma_m] if pose.sigma_m else None,
    }


def _camera_entry(camera: Camera) -> dict[str, Any]:
    """A pinhole with two radial terms is what COLMAP calls RADIAL."""
    return {
        "model": "RADIAL",
        "width": camera.width,
        "height": camera.height,
        "f_px": round(camera.f_px, 6),
        "cx": round(camera.cx, 6),
        "cy": round(camera.cy, 6),
        "k1": round(camera.k1, 12),
        "k2": round(camera.k2, 12),
    }


def _pose_entry(world: World, frame: NamedFrame, camera: int, to_crs: Transformer) -> dict[str, Any]:
    pose, placed = frame.posed.pose, grid_pose(world, frame.posed, to_crs)
    return {
        "name": frame.name,
        "camera": camera,
        "source": pose.source,
        "center": [round(float(v), 4) for v in placed.center],
        "R": [[round(float(v), 12) for v in row] for row in placed.grid_R_cam],
        "ground_height": round(placed.ground_height, 4),
        "submap": pose.submap,
        "sigma_m": [round(float(s), 4) for s in pose.sigma_m] if pose.sigma_m else None,
    }


def footprints_geojson(world: World, frames: Sequence[NamedFrame]) -> dict[str, Any]:
    """A GeoJSON FeatureCollection (RFC 7946) of what each frame shows of the ground, in capture order."""
    features = []
    for frame in in_capture_order(frames):
        outline = ground_outline(frame.posed)
        if outline is None:
            continue
        points = np.column_stack((outline, np.full(len(outline), frame.posed.pose.ground_h_m)))
        features.append(
            {
                "type": "Feature",
                "properties": {
                    "name": frame.name,
                    "time": _iso(frame.captured_s),
                    "source": frame.posed.pose.source,
                    "submap": frame.posed.pose.submap,
                    "gsd_m": round(frame.posed.pose.gsd_m(frame.posed.camera), 4),
                },
                "geometry": {"type": "Polygon", "coordinates": [_ring(world.to_geodetic(points)[:, :2])]},
            }
        )
    local = {"georeferenced": False, "note": LOCAL_NOTE} if is_local(frames) else {}
    return {"type": "FeatureCollection", **local, "features": features}


def _ring(lon_lat: Array) -> list[list[float]]:
    """Closed and counter-clockwise, as the standard wants outer rings."""
    x, y = (lon_lat - lon_lat[0]).T
    if float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()) < 0:
        lon_lat = lon_lat[::-1]
    return [[round(float(lon), 8), round(float(lat), 8)] for lon, lat in (*lon_lat, lon_lat[0])]


def route_csv(world: World, frames: Sequence[NamedFrame]) -> str:
    """The flown route as CSV, in capture order: place (WGS84 and UTM), height, sigmas in metres, source.

    Where the map is not georeferenced there is no longitude and no latitude, and easting and northing are
    metres from the map's own origin.
    """
    to_crs = Transformer.from_crs(4326, utm_epsg(world.lat_deg, world.lon_deg), always_xy=True)
    local = is_local(frames)
    table = StringIO()
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(_ROUTE_COLUMNS)
    for frame in in_capture_order(frames):
        pose = frame.posed.pose
        lon, lat, alt = world.to_geodetic(pose.center[None])[0]
        east, north = pose.center[:2] if local else to_crs.transform(lon, lat)
        where = ("", "") if local else (f"{lon:.8f}", f"{lat:.8f}")
        sigmas = [f"{s:.3f}" for s in pose.sigma_m] if pose.sigma_m else ["", "", ""]
        height = pose.center[2] - pose.ground_h_m
        place = [*where, *(f"{v:.3f}" for v in (alt, height, east, north))]
        rows.writerow([frame.name, _iso(frame.captured_s) or "", *place, *sigmas, pose.source, pose.submap])
    return table.getvalue()


def json_bytes(document: dict[str, Any]) -> bytes:
    """A document as UTF-8 JSON, one line per list entry of its top level, the same bytes every time."""
    lines = []
    for key, value in document.items():
        if isinstance(value, list):
            entries = ",\n".join(json.dumps(v, ensure_ascii=False, allow_nan=False) for v in value)
            lines.append(f"{json.dumps(key)}: [\n{entries}\n]")
        else:
            lines.append(f"{json.dumps(key)}: {json.dumps(value, ensure_ascii=False, allow_nan=False)}")
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode()


def _time_or_inf(captured_s: float | None) -> float:
    return math.inf if captured_s is None else captured_s


def _iso(captured_s: float | None) -> str | None:
    if captured_s is None:
        return None
    return datetime.fromtimestamp(captured_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
