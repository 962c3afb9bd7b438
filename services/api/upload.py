"""POST …/frames: photos come in. Idempotent by content; answered when bytes and row are durable."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import Mapping, Sequence
from typing import Any, cast

from anyio import to_thread
from fastapi import APIRouter, Request, Response
from starlette.requests import ClientDisconnect

from core.errors import BadTelemetry, FileTooLarge, OrthostreamError, RejectedFrame
from core.photo import PhotoHeader, probe_file
from core.telemetry import parse_telemetry
from services.api.context import MissionId, Services, Use
from services.api.documents import FrameState, UploadedFrame, UploadOut
from services.api.multipart import FormReader, ReceivedFile, clean_name
from services.api.problems import AllRefused, BadUpload, NoPhotos, as_ours
from services.catalog import frames, missions
from services.catalog.frames import NOT_ITS_FAULT, Upload
from services.errors import OutOfDisk

router = APIRouter(tags=["frames"])

# Chunks arrive in 64 kB; handed to a thread in larger lots, hashing and writing leave the event loop free.
_LOT_BYTES = 1_000_000

_FORM = {
    "required": True,
    "content": {
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["files"],
                "properties": {
                    "telemetry": {
                        "type": "string",
                        "description": 'JSON {"photo.jpg": {"lat": …, "lon": …, "yaw": …}}: what is '
                        "known of each photo besides its own metadata. Send it before the photos.",
                    },
                    "files": {
                        "type": "array",
                        "minItems": 1,
                        "items": {"type": "string", "format": "binary"},
                        "description": "JPEG or TIFF photos, one part each",
                    },
                },
            }
        }
    },
}


@router.post(
    "/missions/{mission_id}/frames",
    status_code=201,
    response_model=UploadOut,
    responses={200: {"model": UploadOut, "description": "Every photo was here already"}},
    openapi_extra={"requestBody": _FORM},
)
async def upload_frames(mission_id: MissionId, request: Request, services: Use) -> Response:
    """Upload photos. 201 when one of them is new, 200 when all were here already.

    Each photo has a result of its own; only when every one is refused the answer is an error, with the
    results in `errors`. Photos that were accepted stay so when a later part of the request breaks off.
    """
    await to_thread.run_sync(_check_room, services, mission_id)
    upload = _Upload(services, mission_id, request.headers.get("content-type", ""))
    results = await upload.receive(request)
    if not any(isinstance(r, UploadedFrame) for r in results):
        raise _refusal([r for r in results if isinstance(r, _Refused)])
    documents = [r if isinstance(r, UploadedFrame) else r.document for r in results]
    said = UploadOut(frames=documents).model_dump_json(exclude_none=True)
    status = 201 if any(d.created for d in documents) else 200
    return Response(said, status, media_type="application/json")


class _Refused:
    """A photo that was not taken, and why."""

    def __init__(self, file: ReceivedFile, error: OrthostreamError) -> None:
        self.error = error
        self.document = UploadedFrame(
            name=file.name,
            frame_id=file.frame_id,
            state="rejected",
            created=False,
            code=error.code,
            detail=str(error),
        )


_Result = UploadedFrame | _Refused


class _Upload:
    """One request: reads the body, and accepts each photo in the background as soon as it is complete."""

    def __init__(self, services: Services, mission_id: str, content_type: str) -> None:
        self._services, self._mission_id = services, mission_id
        self._reader = FormReader(content_type, services.uploads, services.settings.max_upload_bytes)
        self._telemetry: Mapping[str, Any] | None = None
        self._tasks: list[asyncio.Task[_Result]] = []

    async def receive(self, request: Request) -> Sequence[_Result]:
        """Every photo's result, in the order of the request."""
        try:
            await self._read(request)
            if not self._tasks:
                raise NoPhotos
            return await asyncio.gather(*self._tasks)
        except ClientDisconnect:
            raise BadUpload("The connection broke off in the middle of the upload. Send it again.") from None
        finally:
            # What arrived whole is kept even if the rest did not; its results are simply not told.
            await asyncio.gather(*self._tasks, return_exceptions=True)
            self._reader.close()

    async def _read(self, request: Request) -> None:
        lot: list[bytes] = []
        size = 0
        async for chunk in request.stream():
            lot.append(chunk)
            size += len(chunk)
            if size >= _LOT_BYTES:
                await self._feed(lot)
                lot, size = [], 0
        await self._feed(lot)
        self._reader.end()

    async def _feed(self, lot: list[bytes]) -> None:
        try:
            await to_thread.run_sync(self._reader.feed, lot)
        except OSError as error:
            raise as_ours(error) from error
        finally:
            self._read_telemetry()
            finished, self._reader.finished = self._reader.finished, []
            self._tasks += [asyncio.create_task(self._accept(file)) for file in finished]

    def _read_telemetry(self) -> None:
        raw = self._reader.fields.pop("telemetry", None)
        # Small requests could be served in any order, large ones not: no order that works only sometimes.
        if "telemetry" in self._reader.late_fields:
            raise BadTelemetry('Send the field "telemetry" before the photos: each is accepted as it comes.')
        if raw is not None:
            self._telemetry = _telemetry(raw)

    async def _accept(self, file: ReceivedFile) -> _Result:
        known = (self._telemetry or {}).get(file.name)
        async with self._services.accepting:
            try:
                return await to_thread.run_sync(_accept, self._services, self._mission_id, file, known)
            finally:
                file.discard()


def _check_room(services: Services, mission_id: str) -> None:
    with services.db.read() as tx:
        missions.check(tx, mission_id)
    # Before the first byte is read: a full disk must not cost the sender an upload.
    free, kept = shutil.disk_usage(services.uploads).free, services.settings.min_free_bytes
    if free < kept:
        raise OutOfDisk(
            f"The server's disk has only {free / 1e6:.0f} MB left, of {kept / 1e6:.0f} MB that are "
            "kept for the map. Free some space, then upload again: nothing was lost."
        )


def _accept(services: Services, mission_id: str, file: ReceivedFile, telemetry: Any) -> _Result:
    """One photo: look at its header, store it, then its row, then wake a worker."""
    try:
        return _keep(services, mission_id, file, _probe(services, file), telemetry)
    except RejectedFrame as error:
        with services.db.write() as tx:
            frames.record_rejected_upload(tx, mission_id, file.frame_id, file.name, file.size_bytes, error)
        return _Refused(file, error)
    except Exception as error:
        ours = as_ours(error)
        if isinstance(ours, OutOfDisk):
            return _Refused(file, ours)
        raise


def _keep(
    services: Services, mission_id: str, file: ReceivedFile, header: PhotoHeader, telemetry: Any
) -> UploadedFrame:
    with services.db.read() as tx:
        known = frames.uploaded(tx, mission_id, file.frame_id)
    if known is not None and known.code not in NOT_ITS_FAULT:
        return _uploaded(known, file, created=False)
    assert file.path is not None  # the probe refuses what is larger than the limit
    services.store.put_file(f"missions/{mission_id}/photos/{file.frame_id}", file.path, move=True)
    if known is not None:
        return _tried_again(services, mission_id, file)
    with services.db.write() as tx:
        there, created = frames.receive(
            tx, mission_id, file.frame_id, file.name, file.size_bytes, header.media_type, header.width,
            header.height, telemetry,
        )  # fmt: skip
    if created:
        services.send("ingest", mission_id, file.frame_id)
    return _uploaded(there, file, created)


def _tried_again(services: Services, mission_id: str, file: ReceivedFile) -> UploadedFrame:
    """A photo that could not be read for a reason of ours has another try when it is sent again."""
    with services.db.write() as tx:
        again = frames.retry(tx, mission_id, file.frame_id)
        there = frames.uploaded(tx, mission_id, file.frame_id)
    if again:
        services.send("ingest", mission_id, file.frame_id)
    assert there is not None  # it was a moment ago, and only its mission goes
    return _uploaded(there, file, created=False)


def _probe(services: Services, file: ReceivedFile) -> PhotoHeader:
    limits = services.settings.photo_limits
    if file.path is None:
        raise FileTooLarge(
            f"The file has {file.size_bytes / 1e6:.0f} MB, more than the limit of "
            f"{limits.max_bytes / 1e6:.0f} MB. Export a smaller JPEG of it."
        )
    with file.path.open("rb") as photo:
        return probe_file(photo, limits)


def _uploaded(there: Upload, file: ReceivedFile, created: bool) -> UploadedFrame:
    return UploadedFrame(
        name=file.name,
        frame_id=there.frame_id,
        state=cast(FrameState, there.state),
        created=created,
        code=there.code,
        detail=there.reason,
    )


def _telemetry(raw: bytes) -> Mapping[str, Any]:
    try:
        document = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise BadTelemetry(f"The telemetry is no JSON: {error}.") from error
    if not isinstance(document, dict) or not all(isinstance(v, dict) for v in document.values()):
        raise BadTelemetry('The telemetry must be an object like {"photo.jpg": {"lat": 47.1, "lon": 8.2}}.')
    return {clean_name(name): parse_telemetry(values) for name, values in document.items()}


def _refusal(refused: Sequence[_Refused]) -> AllRefused:
    errors = [r.document.model_dump(exclude_none=True) for r in refused]
    # A full disk is the server's trouble and passes: it decides over what is wrong with single photos.
    worst = next((r.error for r in refused if isinstance(r.error, OutOfDisk)), refused[0].error)
    return AllRefused(worst, errors)
