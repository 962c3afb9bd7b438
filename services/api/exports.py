"""Exports: made when somebody asks for them, streamed when they are there, in parts to who wants parts."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from typing import Annotated, Any, BinaryIO

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from sqlalchemy.orm import Session

from core.errors import BadCrs
from services.api.context import MissionId, Services, Use
from services.api.documents import ExportList, ExportOut, export_document
from services.api.problems import ExportFailed
from services.catalog import exports, missions
from services.export_names import MOSAIC, NAMES, ExportName, mosaic_in
from services.tables import Export

router = APIRouter(tags=["exports"])

Crs = Annotated[
    str | None,
    Query(pattern=r"^EPSG:[0-9]{4,6}$", description="Of the mosaic, where not the UTM zone of the mission"),
]

# While the map still grows an export this old is as good as a new one: else one could never fetch any.
_FRESH_S = 60.0
_RETRY_S = 1
_PIECE_BYTES = 1 << 20
_RANGE = re.compile(r"bytes=(\d*)-(\d*)")

_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file", "content": {"application/octet-stream": {}, "application/json": {}}},
    202: {"description": "It is being made: ask again after `Retry-After` seconds", "model": ExportOut},
    206: {"description": "The part of the file that `Range` asks for"},
}


@router.get("/missions/{mission_id}/exports")
def list_exports(mission_id: MissionId, services: Use) -> ExportList:
    """What can be had of this mission, and what of it is there already."""
    with services.db.read() as tx:
        missions.get(tx, mission_id)
        known = {row.name: row for row in exports.list(tx, mission_id)}
    documents = [export_document(name, known.get(name), _url(mission_id, name)) for name in NAMES]
    return ExportList(exports=documents)


@router.get("/missions/{mission_id}/exports/{name}", response_class=Response, responses=_ANSWERS)
@router.head("/missions/{mission_id}/exports/{name}", include_in_schema=False)
def get_export(
    mission_id: MissionId,
    name: ExportName,
    request: Request,
    services: Use,
    retry: bool = False,
    crs: Crs = None,
) -> Response:
    """The file (200), or 202 while it is made. One that failed stays failed until the map changes or `retry`.

    Of a map that still grows it shows the state of at most a minute ago.
    """
    file = _named(name, crs)
    with services.db.write() as tx:
        export, wanted = _request(tx, mission_id, file, retry)
    if wanted:
        services.send("export", mission_id, file)
    if export.state == "failed":
        raise ExportFailed(export.error)
    if export.state != "ready" or export.object_key is None:
        url = _url(mission_id, name) + (f"?crs={crs}" if crs else "")
        document = export_document(file, export, url)
        return JSONResponse(document.model_dump(), 202, headers={"Retry-After": str(_RETRY_S)})
    return _send(services, request, export, f"{mission_id}-{file}")


def _named(name: ExportName, crs: str | None) -> str:
    if crs is None:
        return name
    if name != MOSAIC:
        raise BadCrs(f"Only {MOSAIC} can be had in another CRS.")
    return mosaic_in(crs)


def _request(tx: Session, mission_id: str, name: str, retry: bool) -> tuple[Export, bool]:
    mission = missions.get(tx, mission_id)
    row = exports.get(tx, mission_id, name)
    if row is not None and not retry:
        same = (row.revision, row.generation) == (mission.revision, mission.generation)
        fresh = (row.finished_at or 0.0) > time.time() - _FRESH_S
        if (row.state == "failed" and same) or (row.state == "ready" and fresh and mission.state == "open"):
            return row, False
    return exports.request(tx, mission_id, name)


def _send(services: Services, request: Request, export: Export, filename: str) -> Response:
    assert export.object_key is not None
    size = services.store.size(export.object_key)
    headers = {
        "Accept-Ranges": "bytes",
        "Content-Disposition": f'attachment; filename="{filename}"',
        "ETag": f'"{export.revision}-{export.generation}-{int(export.finished_at or 0)}"',
        "Cache-Control": "no-cache",
    }
    part = _part(request, size, headers["ETag"])
    if part is None:
        return Response(status_code=416, headers={"Content-Range": f"bytes */{size}"})
    start, stop = part
    headers["Content-Length"] = str(stop - start)
    if stop - start < size:
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    status = 206 if stop - start < size else 200
    if request.method == "HEAD":
        return Response(status_code=status, media_type=export.media_type, headers=headers)
    body = _pieces(services.store.open(export.object_key), start, stop)
    return StreamingResponse(body, status, headers, export.media_type)


def _part(request: Request, size: int, etag: str) -> tuple[int, int] | None:
    """The bytes asked for, [start, stop): all unless the request names a single part; None: no such part."""
    match = _RANGE.fullmatch(request.headers.get("range", ""))
    if match is None or request.headers.get("if-range", etag) != etag or not any(match.groups()):
        return 0, size
    first, last = match.groups()
    if not first:
        return max(0, size - int(last)), size
    start, stop = int(first), min(size, int(last) + 1 if last else size)
    return (start, stop) if start < stop else None


def _pieces(file: BinaryIO, start: int, stop: int) -> Iterator[bytes]:
    with file:
        file.seek(start)
        while start < stop and (piece := file.read(min(_PIECE_BYTES, stop - start))):
            start += len(piece)
            yield piece


def _url(mission_id: str, name: str) -> str:
    return f"/api/v1/missions/{mission_id}/exports/{name}"
