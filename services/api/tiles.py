"""Tiles: as they are now (checked by ETag at each use), and as they were at a revision (never changing)."""

from __future__ import annotations

import math
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request, Response

from services.api.context import MissionId, PublicUrl, Services, Use
from services.api.etags import has
from services.api.problems import NotDrawnYet, RevisionGone
from services.catalog import missions, tiles
from services.catalog.tiles import StoredTile, TileBox
from services.errors import ObjectNotFound

router = APIRouter(tags=["map"])

_MAX_ZOOM = 30
Zoom = Annotated[int, Path(ge=0, le=_MAX_ZOOM)]
Column = Annotated[int, Path(ge=0, lt=2**_MAX_ZOOM)]
Revision = Annotated[int, Path(ge=0, le=2**53)]

_NOW = "no-cache"  # keep it, but ask every time
_FOR_EVER = "public, max-age=31536000, immutable"
_PICTURE = {"schema": {"type": "string", "format": "binary"}}
_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "JPEG where opaque, else WebP; or all PNG, as the service is set",
        "content": {"image/jpeg": _PICTURE, "image/webp": _PICTURE, "image/png": _PICTURE},
    },
    204: {"description": "Nothing to see there"},
    304: {"description": "The one you have is the newest"},
}


@router.get("/missions/{mission_id}/tiles/{z}/{x}/{y}", response_class=Response, responses=_ANSWERS)
def get_tile(
    mission_id: MissionId, z: Zoom, x: Column, y: Column, request: Request, services: Use
) -> Response:
    """The newest picture of a 512 px web-mercator tile; 204 where there is nothing yet."""
    for _ in range(2):
        with services.db.read() as tx:
            tile = tiles.get(tx, mission_id, z, x, y)
            row = missions.get(tx, mission_id) if tile is None else None
            if row is not None and row.zoom is not None and row.zoom < z <= (row.sharp_zoom or 0):
                raise NotDrawnYet()  # viewers show the tile above instead
        try:
            return _answer(services, tile, request, _NOW)
        except ObjectNotFound:
            continue  # replaced and collected between the two reads: the row names a newer one by now
    return Response(status_code=204, headers={"Cache-Control": _NOW})


@router.get(
    "/missions/{mission_id}/revisions/{revision}/tiles/{z}/{x}/{y}",
    response_class=Response,
    responses=_ANSWERS,
)
def get_tile_at_revision(
    mission_id: MissionId, revision: Revision, z: Zoom, x: Column, y: Column, request: Request, services: Use
) -> Response:
    """The tile as it was when the mission was published for the `revision`-th time: it never changes."""
    with services.db.read() as tx:
        if revision > missions.get(tx, mission_id).revision:
            raise RevisionGone(f"The mission has no revision {revision} yet.")
        tile = tiles.get(tx, mission_id, z, x, y, revision)
    return _answer(services, tile, request, _FOR_EVER)


@router.get("/missions/{mission_id}/tilejson.json")
def get_tilejson(mission_id: MissionId, services: Use, public_url: PublicUrl) -> dict[str, Any]:
    """TileJSON 3.0 of the map as it is now, for MapLibre, QGIS and others."""
    with services.db.read() as tx:
        row = missions.get(tx, mission_id)
        box = tiles.bounds(tx, mission_id)
    document: dict[str, Any] = {
        "tilejson": "3.0.0",
        "name": row.name,
        "version": f"1.0.{row.revision}",
        "scheme": "xyz",
        "tiles": [f"{public_url}/api/v1/missions/{row.id}/tiles/{{z}}/{{x}}/{{y}}"],
        "tileSize": 512,
        "minzoom": 0,
        "maxzoom": row.tile_zoom or 0,
    }
    if box:
        west, south, east, north = _bounds_deg(box)
        document["bounds"] = [west, south, east, north]
        document["center"] = [(west + east) / 2, (south + north) / 2, box.z]
    return document


def _answer(services: Services, tile: StoredTile | None, request: Request, cache: str) -> Response:
    headers = {"Cache-Control": cache}
    if tile is None or tile.object_key is None:
        return Response(status_code=204, headers=headers)
    headers["ETag"] = f'"{tile.etag or tile.revision}"'
    if has(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return Response(services.store.get(tile.object_key), media_type=tile.media_type, headers=headers)


def _bounds_deg(box: TileBox) -> tuple[float, float, float, float]:
    def latitude(row: int) -> float:
        return math.degrees(math.atan(math.sinh(math.pi * (1 - row / 2.0 ** (box.z - 1)))))

    def longitude(column: int) -> float:
        return column / 2.0**box.z * 360 - 180

    return longitude(box.x0), latitude(box.y1 + 1), longitude(box.x1 + 1), latitude(box.y0)
