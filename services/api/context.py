"""What every route works with: settings, database, object store, the way to wake workers, the event feed."""

from __future__ import annotations

import asyncio
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

from fastapi import Depends, Request
from fastapi import Path as PathParameter

from services.api.feed import Feed
from services.database import Database
from services.errors import MissionNotFound
from services.settings import Settings
from services.storage import ObjectStore

# A finished photo is read once as a whole to look at its header: this many at a time.
ACCEPT_AT_ONCE = 8

_MISSION_ID = re.compile(r"[a-z0-9]{1,40}")


class Send(Protocol):
    """Wakes a worker by the name of its task; False when the broker is away (the sweep sends it again)."""

    def __call__(self, name: str, /, *args: Any, priority: int | None = None) -> bool:
        """`args` must be JSON. `priority`: where not the task's own, 0 goes first."""


@dataclass(frozen=True, slots=True)
class Services:
    """One API process's share of the world. `uploads`: the folder of photos still being received."""

    settings: Settings
    db: Database
    store: ObjectStore
    send: Send
    feed: Feed
    uploads: Path
    accepting: asyncio.Semaphore


# Coroutines, or each would be handed to a thread and back.
async def _services(request: Request) -> Services:
    services: Services = request.app.state.services
    return services


async def _mission_id(mission_id: Annotated[str, PathParameter(description="The mission's id")]) -> str:
    # Whatever cannot be an id needs no query; some of it the database would choke on.
    if not _MISSION_ID.fullmatch(mission_id):
        raise MissionNotFound(f"There is no mission {mission_id[:50]!r}.")
    return mission_id


async def _public_url(request: Request) -> str:
    settings = (await _services(request)).settings
    # Unless somebody said where we are to be found, the caller's own way here is the one that works.
    if settings.public_url == f"http://{settings.host}:{settings.port}":
        return str(request.base_url).rstrip("/")
    return settings.public_url


PublicUrl = Annotated[str, Depends(_public_url)]
Use = Annotated[Services, Depends(_services)]
MissionId = Annotated[str, Depends(_mission_id)]
