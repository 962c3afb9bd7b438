"""Frames as a list, and as what the map draws of them: footprints, flight tracks, cameras."""

from __future__ import annotations

import gzip
import json
import math
import threading
from collections import OrderedDict, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from sqlalchemy.orm import Session

from core.frame import FrameMeta
from core.geometry import Array
from services.api.context import MissionId, Services, Use
from services.api.documents import FramePage, FrameState, frame_document
from services.catalog import frames, missions, poses
from services.catalog.frames import Seen
from services.catalog.poses import Poses

router = APIRouter(tags=["frames"])

_KEPT = 32  # missions
_GEOJSON = "application/geo+json"


@router.get("/missions/{mission_id}/frames")
def list_frames(
    mission_id: MissionId,
    services: Use,
    state: FrameState | None = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 200,
    after: Annotated[str | None, Query(pattern="^[0-9a-f]{32}$")] = None,
) -> FramePage:
    """Photos in the order of their arrival with their state; rejected ones say why."""
    with services.db.read() as tx:
        missions.get(tx, mission_id)
        rows = frames.list(tx, mission_id, state, limit + 1, after)
    shown = [frame_document(row) for row in rows[:limit]]
    return FramePage(frames=shown, next=shown[-1].frame_id if len(rows) > limit else None)


@router.get(
    "/missions/{mission_id}/frames.geojson",
    response_class=Response,
    responses={
        200: {"description": "A FeatureCollection", "content": {_GEOJSON: {"schema": {"type": "object"}}}},
        304: {"description": "Nothing has changed"},
    },
)
def get_frames_geojson(mission_id: MissionId, request: Request, services: Use) -> Response:
    """`footprint` polygons, one `track` line per drone, and `camera` points; `kind` tells which."""
    seq, packed = _cache.get(services, mission_id)
    headers = {"ETag": f'"{seq}"', "Cache-Control": "no-cache", "Vary": "Accept-Encoding"}
    if headers["ETag"] in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):
        return Response(packed, media_type=_GEOJSON, headers=headers | {"Content-Encoding": "gzip"})
    return Response(gzip.decompress(packed), media_type=_GEOJSON, headers=headers)


class _Cache:
    """The newest document of each mission: a hundred viewers who ask at once cost one computation."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[str, str], tuple[int, bytes]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, services: Services, mission_id: str) -> tuple[int, bytes]:
        """The mission's last event, and the document as of then, gzipped."""
        key = (str(services.db.url), mission_id)
        with self._lock, services.db.read() as tx:
            seq = missions.get(tx, mission_id).event_seq
            kept = self._kept.get(key)
            if kept is None or kept[0] != seq:
                document = json.dumps(_collection(tx, mission_id), separators=(",", ":"))
                kept = self._kept[key] = seq, gzip.compress(document.encode(), 4)
            self._kept.move_to_end(key)
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
            return kept


_cache = _Cache()


@dataclass(frozen=True, slots=True)
class _Shot:
    """One photo with a known position; `outline`: its footprint's corners in degrees, if it is posed."""

    frame: Seen
    lon_lat: tuple[float, float]
    outline: Sequence[tuple[float, float]] | None
    source: str | None

    @property
    def order(self) -> tuple[float, str, str]:
        time = self.frame.meta.captured_s
        return (math.inf if time is None else time, self.frame.name, self.frame.frame_id)

    def about(self, kind: str) -> dict[str, Any]:
        about = {"kind": kind, "frame_id": self.frame.frame_id, "name": self.frame.name}
        return about | {"drone": self.frame.meta.drone, "state": self.frame.state}


def _collection(tx: Session, mission_id: str) -> dict[str, Any]:
    known = poses.load(tx, mission_id)
    outlines = _outlines(known)
    shots = [shot for frame in frames.sightings(tx, mission_id) if (shot := _shot(frame, known, outlines))]
    drones: dict[str, list[_Shot]] = defaultdict(list)
    for shot in sorted(shots, key=lambda s: s.order):
        drones[shot.frame.meta.drone].append(shot)
    flying = missions.get(tx, mission_id).state == "open"
    features = [_feature("Polygon", [_ring(s.outline)], s.about("footprint") | {"source": s.source})
                for s in shots if s.outline]  # fmt: skip
    for drone, flown in sorted(drones.items()):
        features += _track(drone, flown, flying)
    return {"type": "FeatureCollection", "features": features}


def _track(drone: str, flown: Sequence[_Shot], flying: bool) -> Iterable[dict[str, Any]]:
    if len(flown) > 1:
        yield _feature("LineString", [s.lon_lat for s in flown], {"kind": "track", "drone": drone})
    for shot in flown:
        head = flying and shot is flown[-1]
        yield _feature("Point", shot.lon_lat, shot.about("camera") | {"head": head})


def _shot(frame: Seen, known: Poses, outlines: Mapping[str, Array]) -> _Shot | None:
    """The photo at its solved position, else where its GPS says; None when nobody knows."""
    corners = outlines.get(frame.frame_id)
    if corners is not None:
        points = [(round(float(lon), 8), round(float(lat), 8)) for lon, lat in corners]
        return _Shot(frame, points[0], points[1:], known.placed[frame.frame_id].pose.source)
    position = _gps(frame.meta)
    return None if position is None else _Shot(frame, position, None, None)


def _gps(meta: FrameMeta) -> tuple[float, float] | None:
    return None if meta.gps is None else (round(meta.gps.lon_deg, 8), round(meta.gps.lat_deg, 8))


def _outlines(known: Poses) -> Mapping[str, Array]:
    """frame_id → (5, 2) degrees: the camera's position, then the four corners of its footprint."""
    if known.world is None or not known.placed:
        return {}
    points = []
    for placed in known.placed.values():
        ground = placed.pose.footprint(known.cameras[placed.camera_key])
        heights = np.full((4, 1), placed.pose.ground_h_m)
        points.append(np.vstack((placed.pose.center[None], np.hstack((ground, heights)))))
    degrees = known.world.to_geodetic(np.concatenate(points))[:, :2].reshape(-1, 5, 2)
    return dict(zip(known.placed, degrees, strict=True))


def _ring(corners: Sequence[tuple[float, float]] | None) -> list[tuple[float, float]]:
    return [*(corners or ()), *(corners or ())[:1]]


def _feature(kind: str, coordinates: Any, properties: Mapping[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": dict(properties)}
