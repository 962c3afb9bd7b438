"""Errors as HTTP answers: one table from exception to status, one body (RFC 9457)."""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from sqlalchemy.exc import DBAPIError, OperationalError
from starlette.exceptions import HTTPException

from core.errors import (
    BadCheckpoints,
    BadCrs,
    BadScale,
    BadTelemetry,
    FileTooLarge,
    NotAnImage,
    NothingToMap,
    OrthostreamError,
    RejectedFrame,
    TooManyPixels,
)
from services.errors import BadKey, LeaseLost, NotFound, OutOfDisk, RevisionConflict

log = structlog.get_logger(__name__)

MEDIA_TYPE = "application/problem+json"


class BadUpload(OrthostreamError):
    """The request is no multipart upload of photos. Send each photo as a part with the name "files"."""

    code = "bad_upload"


class NoPhotos(OrthostreamError):
    """The request brought no photo. Send each photo as a part with the name "files" and a filename."""

    code = "no_photos"


class TooManyPhotos(OrthostreamError):
    """The request holds more photos than one request may. Send them in several requests."""

    code = "too_many_photos"


class MissionBusy(OrthostreamError):
    """The mission is being deleted and takes nothing any more."""

    code = "mission_busy"


class ExportFailed(OrthostreamError):
    """The export could not be made."""

    code = "export_failed"


class ExportNotFound(NotFound):
    """There is no such file to be had of a mission."""

    code = "export_not_found"


class RevisionGone(NotFound):
    """The mission has not been published under that revision."""

    code = "revision_not_found"


class NotDrawnYet(NotFound):
    """The tile is still to be drawn at this zoom; the ones above it show the place already."""

    code = "not_drawn_yet"


class AllRefused(OrthostreamError):
    """No photo of the request was accepted; `errors` says why for each."""

    code = "all_refused"

    def __init__(self, first: OrthostreamError, errors: Sequence[Mapping[str, Any]]) -> None:
        """`first`: the reason that decides the status. `errors`: one result per file."""
        super().__init__(str(first) if len(errors) == 1 else None)
        self.code = first.code if len({e.get("code") for e in errors}) == 1 else type(self).code
        self.status = status_of(first)
        self.errors = errors


# The first class that an error is an instance of decides.
STATUS: tuple[tuple[type[Exception], int], ...] = (
    (NotFound, 404),
    (FileTooLarge, 413),
    (TooManyPixels, 413),
    (TooManyPhotos, 413),
    (NotAnImage, 415),
    (RejectedFrame, 422),
    (BadTelemetry, 422),
    (BadCheckpoints, 422),
    (BadCrs, 422),
    (BadScale, 422),
    (NoPhotos, 422),
    (BadUpload, 400),
    (BadKey, 400),
    (NothingToMap, 409),
    (MissionBusy, 409),
    (LeaseLost, 409),
    (RevisionConflict, 409),
    (ExportFailed, 409),
    (OutOfDisk, 507),
)


class Problem(BaseModel):
    """The body of every refusal (RFC 9457): `code` is for programs, `detail` for people."""

    type: str = "about:blank"
    title: str
    status: int
    code: str
    detail: str
    errors: list[dict[str, Any]] | None = None


def status_of(error: Exception) -> int:
    """The HTTP status that stands for an error of ours; 500 for what the table does not know."""
    if isinstance(error, AllRefused):
        return error.status
    return next((status for kind, status in STATUS if isinstance(error, kind)), 500)


def problem(
    status: int,
    code: str,
    detail: str,
    errors: Sequence[Mapping[str, Any]] | None = None,
    headers: Mapping[str, str] | None = None,
) -> JSONResponse:
    """The answer itself."""
    try:
        title = HTTPStatus(status).phrase
    except ValueError:
        title = "Error"
    listed = None if errors is None else [dict(e) for e in errors]
    body = Problem(title=title, status=status, code=code, detail=detail, errors=listed)
    return JSONResponse(
        body.model_dump(exclude_none=True), status, media_type=MEDIA_TYPE, headers=dict(headers or {})
    )


def install(app: FastAPI) -> None:
    """Every error that leaves a route becomes a problem."""
    app.add_exception_handler(OrthostreamError, _ours)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, _http)
    app.add_exception_handler(DBAPIError, _database)
    app.add_exception_handler(OSError, _system)
    app.add_exception_handler(Exception, _unexpected)


def as_ours(error: Exception) -> Exception:
    """A full disk, however it shows itself, as OutOfDisk; everything else as it is."""
    full = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)
    if full or (isinstance(error, OperationalError) and "disk is full" in str(error.orig)):
        return OutOfDisk()
    return error


async def _ours(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, OrthostreamError)
    status = status_of(error)
    if status >= 500:
        log.error("request failed", path=request.url.path, code=error.code, detail=str(error))
    return problem(status, error.code, str(error), getattr(error, "errors", None))


async def _invalid(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    errors = [{"where": [str(part) for part in e["loc"]], "detail": e["msg"]} for e in error.errors()]
    said = "; ".join(f"{'.'.join(e['where'][1:]) or e['where'][0]}: {e['detail']}" for e in errors)
    return problem(422, "invalid_request", f"The request is not as it should be. {said}.", errors)


async def _http(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    codes = {404: "not_found", 405: "method_not_allowed", 400: "bad_request"}
    code = codes.get(error.status_code, "http_error")
    return problem(error.status_code, code, str(error.detail), headers=error.headers)


async def _database(request: Request, error: Exception) -> JSONResponse:
    ours = as_ours(error)
    if isinstance(ours, OutOfDisk):
        return await _ours(request, ours)
    if isinstance(error, OperationalError):
        log.error("database unavailable", path=request.url.path, error=str(error.orig))
        detail = "The database does not answer. Try again in a moment."
        return problem(503, "database_unavailable", detail, headers={"Retry-After": "2"})
    return await _unexpected(request, error)


async def _system(request: Request, error: Exception) -> JSONResponse:
    ours = as_ours(error)
    return await (_ours if isinstance(ours, OutOfDisk) else _unexpected)(request, ours)


async def _unexpected(request: Request, error: Exception) -> JSONResponse:
    log.error("request failed", path=request.url.path, exc_info=error)
    return problem(500, "internal_error", "Something went wrong on the server; its log says what.")
