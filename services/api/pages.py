"""The web page's files, from memory and compressed: on a bad link every byte counts."""

from __future__ import annotations

import gzip
import mimetypes
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from fastapi import APIRouter, Request, Response
from starlette.exceptions import HTTPException

from services.web_build import DIST

router = APIRouter(include_in_schema=False)

_COMPRESSED = (".js", ".css", ".svg", ".html")
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; font-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; worker-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'self'"
)
_NOT_BUILT = """<!doctype html><meta charset="utf-8"><title>Orthostream</title>
<p>The web page is not built. Run <code>python -m services.web_build</code>, then load this page again.</p>"""


@dataclass(frozen=True, slots=True)
class _File:
    body: bytes
    packed: bytes | None
    media_type: str


class Files:
    """The built page. Names with a content hash never change; the page itself is asked for every time."""

    def __init__(self, folder: Path = DIST) -> None:
        self._folder = folder
        self._files: dict[str, _File] = {}

    def get(self, name: str) -> _File | None:
        """A file by its path below the folder; None when there is none."""
        if not self._files:
            self._files = _load(self._folder)
        return self._files.get(name)


files = Files()


@router.get("/")
@router.get("/docs")
@router.get("/missions/{mission_id}")
def get_page(request: Request) -> Response:
    """The page: which one it shows is up to its script."""
    page = files.get("index.html")
    if page is None:
        return Response(_NOT_BUILT, 503, _security(), "text/html; charset=utf-8")
    return _answer(request, page, {"Cache-Control": "no-cache"} | _security())


@router.get("/assets/{name}")
def get_asset(name: str, request: Request) -> Response:
    """A script, style, font or picture of the page."""
    file = files.get(f"assets/{name}")
    if file is None:
        raise HTTPException(404, "There is no such file.")
    headers = {"Cache-Control": "public, max-age=31536000, immutable", "X-Content-Type-Options": "nosniff"}
    return _answer(request, file, headers)


@router.get("/favicon.ico")
@router.get("/robots.txt")
def get_nothing() -> Response:
    """Browsers ask for these whatever the page says."""
    return Response(status_code=204, headers={"Cache-Control": "public, max-age=86400"})


def _security() -> dict[str, str]:
    return {
        "Content-Security-Policy": _POLICY,
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "same-origin",
    }


def _answer(request: Request, file: _File, headers: Mapping[str, str]) -> Response:
    if file.packed is not None and "gzip" in request.headers.get("accept-encoding", ""):
        packed = {"Content-Encoding": "gzip", "Vary": "Accept-Encoding"}
        return Response(file.packed, headers={**headers, **packed}, media_type=file.media_type)
    return Response(file.body, headers=dict(headers), media_type=file.media_type)


def _load(folder: Path) -> dict[str, _File]:
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith("."):
            body = path.read_bytes()
            packed = gzip.compress(body, 6) if path.suffix in _COMPRESSED else None
            found[path.relative_to(folder).as_posix()] = _File(body, packed, _media_type(path))
    return found


def _media_type(path: Path) -> str:
    known = {".js": "text/javascript", ".woff2": "font/woff2", ".svg": "image/svg+xml"}
    return known.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "application/octet-stream"
