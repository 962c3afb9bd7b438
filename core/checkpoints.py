"""Surveyed points seen in the photos, used only to measure how true the map is."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
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
    """A gcp_list.txt: its CRS and every row. `used`: names of the points that hold the map in place.

    The points that are not used check it.
    """

    crs: CRS
    sightings: tuple[Sighting, ...]
    used: frozenset[str] = frozenset()

    @property
    def points(self) -> list[str]:
        """The names of all points, in order."""
        return sorted({s.point for s in self.sightings})

    @property
    def heights_tell(self) -> bool:
        """Whether the surveyed heights are more than one placeholder for all points."""
        return len({s.xyz[2] for s in self.sightings}) > 1

    def using(self, names: Iterable[str]) -> Checkpoints:
        """The same points, these of them used. Raises BadCheckpoints for a name that is not in the file."""
        used = frozenset(names)
        unknown = sorted(used - set(self.points))
        if unknown:
            raise BadCheckpoints(
                f"The checkpoint file has no point {unknown[0]!r:.80}. It has {', '.join(self.points):.200}."
            )
        return replace(self, used=used)


@dataclass(frozen=True, slots=True)
class Observation:
    """A point seen in a posed photo. World metres, x and y.

    `own`: where its pixel's ray meets the point's own height, `truth`: the point there (x, y, z). `plane`:
    where the ray meets the frame's ground plane, which is where the mosaic puts it; `at_plane`: the point's
    plumb line there.
    """

    sighting: Sighting
    frame: PosedFrame
    own: Array
    truth: Array
    plane: Array
    at_plane: Array


@dataclass(frozen=True, slots=True)
class PointError:
    """How far one point lies off in the mean of its photos, metres east and north.

    At the point's own height, and in the ground planes (`plane_…`), see CheckpointErrors.
    """

    point: str
    sightings: int
    east_m: float
    north_m: float
    plane_east_m: float
    plane_north_m: float


@dataclass(frozen=True, slots=True)
class CheckpointErrors:
    """Horizontal RMS errors of the sightings of the points that check, metres.

    `raw`: against the survey; `debiased`: after the mean shift; `similarity`: after the best shift, turn and
    scale, which leaves the bending of the map; `spread`: between the photos of one point. Rays meet the
    point's own height; in `plane_*` the frame's ground plane, which is where the mosaic puts the pixel.
    None where there are too few points to tell: two for `debiased`, three for `similarity`.
    """

    points: int
    sightings: int
    raw_m: float
    debiased_m: float | None
    similarity_m: float | None
    spread_m: float
    plane_raw_m: float
    plane_debiased_m: float | None
    plane_similarity_m: float | None

    def to_json(self) -> dict[str, Any]:
        """A JSON object for the report."""
        return asdict(self)


def parse_gcp_list(content: str) -> Checkpoints:
    """ODM's gcp_list.txt: first line the CRS, then rows `X Y Z px py image [name]`; `#` starts a comment.

    The CRS is "WGS84 UTM 32N", "EPSG:32632" or a proj string. Points without a name are told apart by their
    place. Fields are parted by blanks, or by tabs, commas or semicolons (then names may hold blanks). Raises
    BadCheckpoints with the line.
    """
    if "\0" in content:
        raise BadCheckpoints("The checkpoint file is no text.")
    lines = [(n, line.partition("#")[0]) for n, line in enumerate(content.lstrip("\ufeff").splitlines(), 1)]
    lines = [(n, line) for n, line in lines if line.strip()]
    if not lines:
        raise BadCheckpoints("The checkpoint file is empty.")
    crs = _crs(lines[0][1].strip())
    rows = [(n, _sighting(n, _fields(line))) for n, line in lines[1:]]
    if not rows:
        raise BadCheckpoints("The checkpoint file holds a CRS and no point.")
    _on_earth(crs, rows)
    return Checkpoints(crs, tuple(row for _, row in rows))


def _crs(header: str) -> CRS:
    utm = re.fullmatch(r"WGS\s?84 UTM\s*(?:zone)?\s*(\d{1,2})\s*([NS])?", header, re.IGNORECASE)
    try:
        if utm:
            return CRS.from_epsg((32700 if (utm[2] or "N").upper() == "S" else 32600) + int(utm[1]))
        crs = CRS.from_user_input(header)
        if crs.is_projected or crs.is_geographic:
            return crs
    except CRSError:
        pass
    raise BadCheckpoints(f"The checkpoint file's first line is {header!r:.80}, not a CRS such as EPSG:32632.")


def _fields(line: str) -> list[str]:
    for mark in "\t;,":
        fields = [field.strip() for field in line.strip().split(mark)]
        if len(fields) >= 6:
            return fields
    return line.split()


def _on_earth(crs: CRS, rows: Sequence[tuple[int, Sighting]]) -> None:
    xy = np.array([row.xyz[:2] for _, row in rows])
    places = np.column_stack(Transformer.from_crs(crs, 4326, always_xy=True).transform(xy[:, 0], xy[:, 1]))
    lost = np.flatnonzero(~np.isfinite(places).all(1) | (np.abs(places) > (360, 90)).any(1))
    if len(lost):
        raise BadCheckpoints(
            f"Line {rows[lost[0]][0]} of the checkpoint file names a place out of {crs.name:.40}'s reach."
        )


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
    return Sighting(
        fields[6] if len(fields) > 6 and fields[6] else f"{x:.2f},{y:.2f}", (x, y, z), image, (u, v)
    )


def observations(
    checkpoints: Checkpoints, world: World, frames: Mapping[str, PosedFrame]
) -> list[Observation]:
    """Every sighting in a visually posed frame (by photo name), in the order of the file."""
    index = PhotoNames(frames)
    shot = [(s, frames[name]) for s in checkpoints.sightings if (name := index.find(s.image))]
    seen = [(s, f) for s, f in shot if f.pose.source != "gnss"]
    if not seen:
        return []
    to_wgs84 = Transformer.from_crs(checkpoints.crs, 4326, always_xy=True)
    xyz = np.array([s.xyz for s, _ in seen])
    lon, lat = to_wgs84.transform(xyz[:, 0], xyz[:, 1])
    truth = world.from_geodetic(np.column_stack((lon, lat, xyz[:, 2])))
    # A plumb line leans in the tangent plane: compare at the height where the ray was met.
    heights = np.array([f.pose.ground_h_m for _, f in seen])
    at_plane = world.from_geodetic(np.column_stack((lon, lat, xyz[:, 2] + heights - truth[:, 2])))
    return [
        Observation(s, f, _meet(f, s.uv, t[2]), t, _meet(f, s.uv, f.pose.ground_h_m), p[:2])
        for (s, f), t, p in zip(seen, truth, at_plane, strict=True)
    ]


def checkpoint_errors(
    checkpoints: Checkpoints, world: World, frames: Mapping[str, PosedFrame]
) -> CheckpointErrors | None:
    """The errors of the points that check, seen in visually posed frames; None without any."""
    seen = observations(checkpoints, world, frames)
    checks = [o for o in seen if o.sighting.point not in checkpoints.used]
    return _summary(checks) if checks else None


def point_errors(seen: Sequence[Observation]) -> dict[str, PointError]:
    """Every point that was seen, used or not, by name."""
    groups: dict[str, list[Array]] = {}
    for o in seen:
        off = np.concatenate((o.own - o.truth[:2], o.plane - o.at_plane))
        groups.setdefault(o.sighting.point, []).append(off)
    return {
        point: PointError(
            point, len(groups[point]), *(round(float(v), 4) for v in np.mean(groups[point], axis=0))
        )
        for point in sorted(groups)
    }


def by_name(named: Iterable[tuple[str, PosedFrame]]) -> dict[str, PosedFrame]:
    """Frames by photo name, less those that share one: a guess would be measured as an error of the map."""
    groups: dict[str, list[PosedFrame]] = {}
    for name, frame in named:
        groups.setdefault(name, []).append(frame)
    return {name: group[0] for name, group in groups.items() if len(group) == 1}


def checkpoints_document(
    checkpoints: Checkpoints,
    world: World | None,
    frames: Mapping[str, PosedFrame],
    here: Collection[str],
    shown: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """What a report says of the points: through the posed `frames` (by photo name), and in the mosaic.

    `here`: the names of all photos of the mission; `shown`: `core.mosaic_points.mosaic_document`, None before
    anybody looked. A point that no pose shows says why in `unseen`: "no_photo" (none of its photos is here)
    or "not_posed" (none of them is on the map by its picture).
    """
    seen = observations(checkpoints, world, frames) if world else []
    checks = [o for o in seen if o.sighting.point not in checkpoints.used]
    through_poses, in_mosaic = point_errors(seen), (shown or {}).get("points", {})
    names = PhotoNames(here)
    near = {s.point for s in checkpoints.sightings if names.find(s.image)}

    def entry(point: str) -> dict[str, Any]:
        known = through_poses.get(point)
        poses = None if known is None else {k: v for k, v in asdict(known).items() if k != "point"}
        why = None if known else "not_posed" if point in near else "no_photo"
        used = point in checkpoints.used
        return {"point": point, "used": used, "poses": poses, "mosaic": in_mosaic.get(point), "unseen": why}

    return {
        "poses": asdict(_summary(checks)) if checks else None,
        "mosaic": (shown or {}).get("mosaic"),
        "points": [entry(point) for point in checkpoints.points],
    }


class PhotoNames:
    """Photos by name, or by the file name alone where photos carry folders or the list does."""

    def __init__(self, names: Collection[str]) -> None:
        self._names = frozenset(names)
        self._short: dict[str, list[str]] = {}
        for name in sorted(names):
            self._short.setdefault(PurePosixPath(name).name.lower(), []).append(name)

    def find(self, image: str) -> str | None:
        """None also where two photos in different folders share the name."""
        if image in self._names:
            return image
        names = self._short.get(PurePosixPath(image.replace("\\", "/")).name.lower(), [])
        return names[0] if len(names) == 1 else None


def _meet(frame: PosedFrame, uv: tuple[float, float], h_m: float) -> Array:
    """World x, y where a pixel's ray meets the plane at world height `h_m`."""
    ray = (frame.camera.rays(np.array([uv])) @ frame.pose.world_R_cam.T)[0]
    return np.asarray(frame.pose.center[:2] + ray[:2] * ((h_m - frame.pose.center[2]) / ray[2]))


def _summary(seen: Sequence[Observation]) -> CheckpointErrors:
    names = [o.sighting.point for o in seen]
    points = sorted(set(names))
    truth = np.array([o.truth[:2] for o in seen])
    own = np.array([o.own for o in seen]) - truth
    plane = np.array([o.plane - o.at_plane for o in seen])
    groups = [np.array([name == point for name in names]) for point in points]
    spread = np.concatenate([own[g] - own[g].mean(0) for g in groups if g.sum() > 1] or [np.zeros((1, 2))])
    raw_m, debiased_m, similarity_m = rms_levels(own, truth, len(points))
    plane_m = rms_levels(plane, truth, len(points))
    return CheckpointErrors(len(points), len(names), raw_m, debiased_m, similarity_m, _rms(spread), *plane_m)


def rms_levels(errors: Array, truth: Array, points: int) -> tuple[float, float | None, float | None]:
    """RMS of errors (N, 2) at places (N, 2) of so many points: raw, debiased, after the best similarity."""
    debiased_m = _rms(errors - errors.mean(0)) if points >= 2 else None
    return _rms(errors), debiased_m, _rms(_bending(errors, truth)) if points >= 3 else None


def _rms(errors: Array) -> float:
    return round(float(np.sqrt((errors**2).sum(1).mean())), 4)


def _bending(errors: Array, truth: Array) -> Array:
    """What is left of errors (N, 2) at places (N, 2) after the best similarity, as complex numbers."""
    place, goal = (truth + errors) @ (1, 1j), truth @ (1, 1j)
    a, b = place - place.mean(), goal - goal.mean()
    span = float((np.abs(a) ** 2).sum())
    left = b - (np.vdot(a, b) / span if span > 0 else 1.0) * a
    return np.column_stack((left.real, left.imag))
