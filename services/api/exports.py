"""Exports: made when somebody asks for them, streamed when they are there, in parts to who wants parts."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Annotated, Any, BinaryIO

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from sqlalchemy.orm import Session

from core.errors import BadCrs
from services.api.context import MissionId, Services, Use
from services.api.documents import ExportList, ExportOut, export_document
from services.api.etags import has
from services.api.problems import ExportFailed, ExportNotFound
from services.catalog import exports, missions
from services.errors import ObjectNotFound
from services.export_names import MOSAIC, NAMES, crs_of, mosaic_in
from services.queue import PRIORITIES
from services.tables import Export

router = APIRouter(tags=["exports"])

Crs = Annotated[
    str | None,
    Query(pattern=r"^EPSG:[0-9]{4,6}$", description="Of the mosaic, where not the UTM zone of the mission"),
]

# While the map still grows an export this old is as good as a new one: else one could never fetch any.
_FRESH_S = 15.0
_RETRY_S = 1
_READS = 3
_PIECE_BYTES = 1 << 20
# More digits than any file's length has make it no range that we know.
_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")
# What takes a worker longer than a photo does goes behind the photos that have come.
_LONG = (MOSAIC, "map.kmz")

_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file", "content": {"application/octet-stream": {}, "application/json": {}}},
    202: {"description": "It is being made: ask again after `Retry-After` seconds", "model": ExportOut},
    206: {"description": "The part of the file that `Range` asks for"},
    304: {"description": "The one you have is the newest"},
}


@router.get("/missions/{mission_id}/exports")
def list_exports(mission_id: MissionId, services: Use) -> ExportList:
    """What can be had of this mission, and what of it is there already."""
    with services.db.read() as tx:
        missions.get(tx, mission_id)
        known = {row.name: row for row in exports.list(tx, mission_id)}
    documents = [export_document(name, known.get(name), _url(mission_id, name)) for name in NAMES]
    return ExportList(exports=documents)


async def _export_name(
    name: Annotated[str, Path(description="The file's name", json_schema_extra={"enum": list(NAMES)})],
) -> str:
    if name not in NAMES:
        raise ExportNotFound(f"There is no file {name[:50]!r}. There are {', '.join(NAMES)}.")
    return name


@router.get("/missions/{mission_id}/exports/{name}", response_class=Response, responses=_ANSWERS)
@router.head("/missions/{mission_id}/exports/{name}", include_in_schema=False)
def get_export(
    mission_id: MissionId,
    name: Annotated[str, Depends(_export_name)],
    request: Request,
    services: Use,
    retry: bool = False,
    crs: Crs = None,
) -> Response:
    """The file (200), or 202 while it is made. One that failed stays failed until the map changes or `retry`.

    Of a map that still grows it shows the state of a few seconds ago. Who has part of a file (`Range`,
    `If-Range`) gets the rest of that one as long as no newer one has been made.
    """
    file = _named(name, crs)
    for _ in range(_READS):
        export = _rest_of(services, mission_id, file, request) or _wanted(services, mission_id, file, retry)
        if export.state == "ready" or _goes_on(export, request):
            with suppress(ObjectNotFound):  # a newer one took its place between the two reads
                return _send(services, request, export, f"{mission_id}-{file}")
        elif export.state == "failed":
            raise ExportFailed(export.error)
        else:
            url = _url(mission_id, name) + (f"?crs={crs}" if crs else "")
            document = export_document(file, export, url)
            return JSONResponse(document.model_dump(), 202, headers={"Retry-After": str(_RETRY_S)})
    raise ExportFailed("The file was made anew each time that it was to be read. Ask again.")


def _named(name: str, crs: str | None) -> str:
    if crs is None:
        return name
    if name != MOSAIC:
        raise BadCrs(f"Only {MOSAIC} can be had in another CRS.")
    return mosaic_in(crs)


def _rest_of(services: Services, mission_id: str, file: str, request: Request) -> Export | None:
    """The export that the request has part of already, however the map has grown since."""
    if "range" not in request.headers:
        return None
    with services.db.read() as tx:
        missions.get(tx, mission_id)
        export = exports.get(tx, mission_id, file)
    return export if export is not None and _goes_on(export, request) else None


def _goes_on(export: Export, request: Request) -> bool:
    """Whether the request is for what follows a part that was there before."""
    match = _RANGE.fullmatch(request.headers.get("range", ""))
    if export.object_key is None or match is None or not match[1] or int(match[1]) == 0:
        return False
    return request.headers.get("if-range", _etag(export)) == _etag(export)


def _wanted(services: Services, mission_id: str, file: str, retry: bool) -> Export:
    with services.db.write() as tx:
        export, new = _request(tx, mission_id, file, retry)
    if new:
        # In a burst of thousands of photos the lowest priority would be that of their end.
        first = {} if file in _LONG or crs_of(file) else {"priority": PRIORITIES["match"]}
        services.send("export", mission_id, file, **first)
    return export


def _request(tx: Session, mission_id: str, name: str, retry: bool) -> tuple[Export, bool]:
    mission = missions.get(tx, mission_id)
    row = exports.get(tx, mission_id, name)
    if row is not None and not retry:
        same = (row.revision, row.generation) == (mission.revision, mission.generation)
        fresh = (row.finished_at or 0.0) > time.time() - _FRESH_S
        if (row.state == "failed" and same) or (row.state == "ready" and fresh and mission.state != "final"):
            return row, False
    return exports.request(tx, mission_id, name)


def _etag(export: Export) -> str:
    """Of the object, which never changes: what has been made anew lies under another key."""
    assert export.object_key
    return f'"{export.object_key.split("/")[-2]}"'


def _send(services: Services, request: Request, export: Export, filename: str) -> Response:
    """Raises ObjectNotFound."""
    assert export.object_key
    headers = {"ETag": _etag(export), "Cache-Control": "no-cache"}
    if has(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    size = services.store.size(export.object_key)
    part = _part(request, size, headers["ETag"])
    headers |= {"Accept-Ranges": "bytes", "Content-Disposition": f'attachment; filename="{filename}"'}
    if part is None:
        return Response(status_code=416, headers={"Content-Range": f"bytes */{size}"})
    start, stop, status = part
    headers["Content-Length"] = str(stop - start)
    if status == 206:
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    if request.method == "HEAD":
        return Response(status_code=status, media_type=export.media_type, headers=headers)
    body = _pieces(services.store.open(export.object_key), start, stop)
    return StreamingResponse(body, status, headers, export.media_type)


def _part(request: Request, size: int, etag: str) -> tuple[int, int, int] | None:
    """The bytes asked for, [start, stop), and the status; None: the file has no such part.

    All of it unless a GET names a single part of what is there (RFC 9110, 14.2).
    """
    whole = 0, size, 200
    match = _RANGE.fullmatch(request.headers.get("range", ""))
    if match is None or request.method != "GET" or request.headers.get("if-range", etag) != etag:
        return whole
    first, last = match.groups()
    if not first:
        start, stop = max(0, size - int(last or 0)), size
        return (start, stop, 206) if start < stop else whole if not last else None
    start, stop = int(first), min(size, int(last) + 1 if last else size)
    if last and int(last) < start:
        return whole
    return (start, stop, 206) if start < stop else None


def _pieces(file: BinaryIO, start: int, stop: int) -> Iterator[bytes]:
    with file:
        file.seek(start)
        while start < stop and (piece := file.read(min(_PIECE_BYTES, stop - start))):
            start += len(piece)
            yield piece


def _url(mission_id: str, name: str) -> str:
    return f"/api/v1/missions/{mission_id}/exports/{name}"
