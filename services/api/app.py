"""The API process: everything under /api/v1, the pages, health, and the sweep that forgets nothing."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

from fastapi import APIRouter, FastAPI
from fastapi.openapi.utils import get_openapi

from services import queue
from services.api import (
    events,
    exports,
    frames,
    health,
    missions,
    pages,
    problems,
    submaps,
    surveys,
    tiles,
    upload,
)
from services.api.context import ACCEPT_AT_ONCE, Send, Services
from services.api.documents import progress_document
from services.api.feed import Feed
from services.api.sweep import Sweep
from services.database import Database
from services.logging import configure_logging
from services.settings import Settings, get_settings
from services.storage import get_store

VERSION = "1"
_PROBLEM: dict[int | str, dict[str, Any]] = {
    "default": {
        "description": "What went wrong (RFC 9457)",
        "content": {problems.MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
    }
}


def create_app(settings: Settings | None = None, send: Send | None = None) -> FastAPI:
    """The application. `settings`: from the environment when None; `send`: the broker's when None."""
    settings = settings or get_settings()
    app = FastAPI(
        title="Orthostream",
        version=VERSION,
        description="Drone photos in, one live georeferenced orthophoto map out.",
        lifespan=partial(_lifespan, settings, send or queue.send),
        docs_url=None,  # FastAPI's own page loads its script from a CDN
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
    )
    v1 = APIRouter(prefix="/api/v1", responses=_PROBLEM)
    for part in (missions, upload, frames, tiles, events, submaps, surveys, exports):
        v1.include_router(part.router)
    app.include_router(v1)
    app.include_router(health.router)
    app.include_router(pages.router)
    problems.install(app)
    app.openapi = partial(_openapi, app)  # type: ignore[method-assign]
    return app


@asynccontextmanager
async def _lifespan(settings: Settings, send: Send, app: FastAPI) -> AsyncIterator[None]:
    configure_logging(settings, "api")
    settings.make_dirs()
    db = Database(settings.database_url)
    if settings.database_embedded:
        await asyncio.to_thread(db.upgrade)
    store = get_store(settings)
    uploads = settings.data_dir / "uploads"
    uploads.mkdir(mode=0o700, exist_ok=True)
    feed = Feed(db, partial(_progress_json, db))
    app.state.services = Services(settings, db, store, send, feed, uploads, asyncio.Semaphore(ACCEPT_AT_ONCE))
    sweep = Sweep(settings, db, store, send, uploads)
    sweep.start()
    if send is queue.send:
        await asyncio.to_thread(queue.prepare)
    try:
        yield
    finally:
        await feed.close()
        await asyncio.to_thread(sweep.stop)
        db.close()


def _progress_json(db: Database, mission_id: str) -> str:
    with db.read() as tx:
        return progress_document(tx, mission_id).model_dump_json()


def _openapi(app: FastAPI) -> dict[str, Any]:
    """FastAPI's schema with our one error body instead of its own."""
    if app.openapi_schema is None:
        schema = get_openapi(
            title=app.title, version=app.version, description=app.description, routes=app.routes
        )
        for path in schema["paths"].values():
            for operation in path.values():
                operation["responses"].pop("422", None)
        components = schema["components"]["schemas"]
        components.pop("HTTPValidationError", None)
        components.pop("ValidationError", None)
        components["Problem"] = problems.Problem.model_json_schema()
        app.openapi_schema = schema
    return app.openapi_schema
