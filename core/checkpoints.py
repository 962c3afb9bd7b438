"""Surveyed points seen in the photos, used only to measure how true the map is."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

from core.errors import BadCheckpoints
from core.geometry import Array, PosedFrame, World


@dataclass(frozen=True, slots=True)
class Sighting:
    """One point seen in one photo: `xyz` in the file's CRS, `uv` in pixels of the original photo."""

    point: str
    xyz: tuple[float, float, float]
    image: str
    uv: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Checkpoints:
    """A gcp_list.txt: its CRS and every row."""

    crs: CRS
    sightings: tuple[Sighting, ...]


@dataclass(frozen=True, slots=True)
class PointError:
    """How far one point lies off in the mean of its photos, metres east and north."""

    point: str
    sightings: int
    east_m: float
    north_m: float


@dataclass(frozen=True, slots=True)
class CheckpointErrors:
    """Horizontal RMS errors of all sightings, metres.

    `raw`: against the survey; `debiased`: after the mean shift; `similarity`: after the best shift, turn and
    scale, which leaves the bending of the map; `spread`: between the photos of one point. Rays meet the
    point's own height; in `plane_*` the frame's ground plane, which is where the mosaic puts the pixel.
    """

    points: int
    sightings: int
    raw_m: float
    debiased_m: float
    similarity_m: float
    spread_m: float
    plane_raw_m: float
    plane_debiased_m: float
    plane_similarity_m: float
    each: tuple[PointError, ...]

    def to_json(self) -> dict[str, Any]:
        """A JSON object for the report."""
        return asdict(self)


def parse_gcp_list(content: str) -> Checkpoints:
    """ODM's gcp_list.txt: first line the CRS, then rows `X Y Z px py image [name]`; `#` starts a comment.

    The CRS is "WGS84 UTM 32N", "EPSG:32632" or a proj string. Points without a name are told apart by their
    place. Raises BadCheckpoints with the line.
    """
    lines = [
        (n, line.partition("#")[0].split()) for n, line in enumerate(content.lstrip("\ufeff").splitlines(), 1)
    ]
    lines = [(n, fields) for n, fields in lines if fields]
    if not lines:
        raise BadCheckpoints("The checkpoint file is empty.")
    crs = _crs(" ".join(lines[0][1]))
    return Checkpoints(crs, tuple(_sighting(n, fields) for n, fields in lines[1:]))


def _crs(header: str) -> CRS:
    utm = re.fullmatch(r"WGS\s?84 UTM\s*(?:zone)?\s*(\d{1,2})\s*([NS])?", header, re.IGNORECASE)
    try:
        if utm:
            return CRS.from_epsg((32700 if (utm[2] or "N").upper() == "S" else 32600) + int(utm[1]))
        return CRS.from_user_input(header)
    except CRSError as error:
        raise BadCheckpoints(
            f"The checkpoint file's first line is {header!r:.80}, not a CRS such as EPSG:32632."
        ) from error


def _sighting(line: int, fields: list[str]) -> Sighting:
    try:
        x, y, z, u, v = (float(field) for field in fields[:5])
        image = fields[5]
    except (ValueError, IndexError) as error:
        raise BadCheckpoints(
            f"Line {line} of the checkpoint file is not X Y Z px py image [name]."
        ) from error
    if not np.isfinite([x, y, z, u, v]).all():
        raise BadCheckpoints(f"Line {line} of the checkpoint file holds a number that is not finite.")
    return Sighting(fields[6] if len(fields) > 6 else f"{x:.2f},{y:.2f}", (x, y, z), image, (u, v))


def checkpoint_errors(
    checkpoints: Checkpoints, world: World, frames: Mapping[str, PosedFrame]
) -> CheckpointErrors | None:
    """The errors of all points seen in visually posed frames (by photo name); None below three sightings."""
    seen = [
        (s, f) for s in checkpoints.sightings if (f := _frame(s.image, frames)) and f.pose.source != "gnss"
    ]
    if len(seen) < 3:
        return None
    to_wgs84 = Transformer.from_crs(checkpoints.crs, 4326, always_xy=True)
    xyz = np.array([s.xyz for s, _ in seen])
    lon, lat = to_wgs84.transform(xyz[:, 0], xyz[:, 1])
    truth = world.from_geodetic(np.column_stack((lon, lat, xyz[:, 2])))
    own = np.array([_meet(f, s.uv, h) for (s, f), h in zip(seen, truth[:, 2], strict=True)])
    plane = np.array([_meet(f, s.uv, f.pose.ground_h_m) for s, f in seen])
    # A plumb line leans in the tangent plane: compare at the height where the ray was met.
    heights = np.array([f.pose.ground_h_m for _, f in seen])
    at_plane = world.from_geodetic(np.column_stack((lon, lat, xyz[:, 2] + heights - truth[:, 2])))
    return _summary([s.point for s, _ in seen], own - truth[:, :2], plane - at_plane[:, :2], truth[:, :2])


def _frame(image: str, frames: Mapping[str, PosedFrame]) -> PosedFrame | None:
    """By name, or by the file name alone where frames carry folders or the list does."""
    if image in frames:
        return frames[image]
    short = PurePosixPath(image).name.lower()
    return next((frames[n] for n in sorted(frames) if PurePosixPath(n).name.lower() == short), None)


def _meet(frame: PosedFrame, uv: tuple[float, float], h_m: float) -> Array:
    """World x, y where a pixel's ray meets the plane at world height `h_m`."""
    ray = (frame.camera.rays(np.array([uv])) @ frame.pose.world_R_cam.T)[0]
    return np.asarray(frame.pose.center[:2] + ray[:2] * ((h_m - frame.pose.center[2]) / ray[2]))


def _summary(names: Sequence[str], own: Array, plane: Array, truth: Array) -> CheckpointErrors:
    points = sorted(set(names))
    groups = [np.array([name == point for name in names]) for point in points]
    spread = np.concatenate([own[g] - own[g].mean(0) for g in groups if g.sum() > 1] or [np.zeros((1, 2))])
    return CheckpointErrors(
        points=len(points),
        sightings=len(names),
        raw_m=_rms(own),
        debiased_m=_rms(own - own.mean(0)),
        similarity_m=_rms(_bending(own, truth)),
        spread_m=_rms(spread),
        plane_raw_m=_rms(plane),
        plane_debiased_m=_rms(plane - plane.mean(0)),
        plane_similarity_m=_rms(_bending(plane, truth)),
        each=tuple(
            PointError(p, int(g.sum()), *(round(float(v), 4) for v in own[g].mean(0)))
            for p, g in zip(points, groups, strict=True)
        ),
    )


def _rms(errors: Array) -> float:
    return round(float(np.sqrt((errors**2).sum(1).mean())), 4)


def _bending(errors: Array, truth: Array) -> Array:
    """What is left of errors (N, 2) at places (N, 2) after the best similarity, as complex numbers."""
    place, goal = (truth + errors) @ (1, 1j), truth @ (1, 1j)
    a, b = place - place.mean(), goal - goal.mean()
    span = float((np.abs(a) ** 2).sum())
    left = b - (np.vdot(a, b) / span if span > 0 else 1.0) * a
    return np.column_stack((left.real, left.imag))
