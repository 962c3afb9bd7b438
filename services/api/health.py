"""Is this process alive, and can it do its work?"""

from __future__ import annotations

import os
from typing import Literal

import structlog
from fastapi import APIRouter, Response
from pydantic import BaseModel
from sqlalchemy.exc import SQLAlchemyError

from services.api.context import Services, Use

log = structlog.get_logger(__name__)
router = APIRouter(tags=["health"])


class Health(BaseModel):
    """The process answers."""

    status: Literal["ok"] = "ok"


class Readiness(BaseModel):
    """What each part says; `ready` only when all of them say "ok"."""

    ready: bool
    checks: dict[str, str]


@router.get("/health")
async def get_health() -> Health:
    """Alive. Looks at nothing else, so that a slow database is no reason to kill the process."""
    return Health()


@router.get("/ready", responses={503: {"model": Readiness, "description": "Not ready; `checks` says why"}})
def get_readiness(response: Response, services: Use) -> Readiness:
    """Whether database and upload folder can be used. The broker may be away: its work waits."""
    checks = {"database": _database(services), "uploads": _uploads(services)}
    ready = all(said == "ok" for said in checks.values())
    response.status_code = 200 if ready else 503
    return Readiness(ready=ready, checks=checks)


def _database(services: Services) -> str:
    try:
        services.db.ping()
    except SQLAlchemyError as error:
        log.warning("database not ready", error=str(error))
        return "does not answer, or its schema is missing"
    return "ok"


def _uploads(services: Services) -> str:
    return "ok" if os.access(services.uploads, os.W_OK | os.X_OK) else "cannot be written to"
