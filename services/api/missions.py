"""Missions: create, list, look at, finalise, delete."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from core.scale import UNKNOWN
from services.api.context import MissionId, PublicUrl, Use
from services.api.documents import (
    MissionIn,
    MissionOut,
    MissionPage,
    ProgressOut,
    ScaleIn,
    mission_document,
    progress_document,
)
from services.catalog import missions
from services.report import report

router = APIRouter(tags=["missions"])


@router.post("/missions", status_code=201)
def create_mission(body: MissionIn, response: Response, services: Use, public_url: PublicUrl) -> MissionOut:
    """A new, empty mission; its id is in the answer and in `Location`."""
    with services.db.write() as tx:
        scale = body.scale.known() if body.scale else UNKNOWN
        row = missions.create(tx, body.name, body.mode, body.max_side, scale=scale, backfill=body.backfill)
        document = mission_document(tx, row, public_url)
    response.headers["Location"] = f"/api/v1/missions/{row.id}"
    return document


@router.get("/missions")
def list_missions(
    services: Use,
    public_url: PublicUrl,
    limit: Annotated[int, Query(ge=1, le=200)] = 50,
    after: Annotated[str | None, Query(pattern="^[a-z0-9]{1,40}$")] = None,
) -> MissionPage:
    """All missions, newest first, a page at a time."""
    with services.db.read() as tx:
        rows = missions.list(tx, limit + 1, after)
        shown = [mission_document(tx, row, public_url) for row in rows[:limit]]
    return MissionPage(missions=shown, next=shown[-1].id if len(rows) > limit else None)


@router.get("/missions/{mission_id}")
def get_mission(mission_id: MissionId, services: Use, public_url: PublicUrl) -> MissionOut:
    """One mission with its progress."""
    with services.db.read() as tx:
        return mission_document(tx, missions.get(tx, mission_id), public_url)


@router.get("/missions/{mission_id}/progress")
def get_progress(mission_id: MissionId, services: Use) -> ProgressOut:
    """How far the mission has come."""
    with services.db.read() as tx:
        return progress_document(tx, mission_id)


@router.put("/missions/{mission_id}/scale")
def put_scale(mission_id: MissionId, body: ScaleIn, services: Use, public_url: PublicUrl) -> MissionOut:
    """Say how large the ground is where no GPS tells: the height of the first photo, or a marker in any.

    It takes the place of what was said before; `{}` takes it back. Where it moves poses that were solved
    already, a final mission is open again: finalise it once more.
    """
    with services.db.write() as tx:
        moves = missions.set_scale(tx, mission_id, body.known())
        document = mission_document(tx, missions.get(tx, mission_id), public_url)
    if moves:
        services.send("sequence", mission_id)
    return document


@router.post("/missions/{mission_id}/finalise", status_code=202)
def finalise_mission(mission_id: MissionId, services: Use, public_url: PublicUrl) -> MissionOut:
    """Solve all photos together and draw the final map; the same photos give the same bytes.

    Photos that come later open the mission again. Asking twice changes nothing.
    """
    with services.db.write() as tx:
        row = missions.request_finalise(tx, mission_id)
        document = mission_document(tx, row, public_url)
    if document.state == "finalising":
        services.send("sequence", mission_id)
    return document


@router.delete("/missions/{mission_id}", status_code=204)
def delete_mission(mission_id: MissionId, services: Use) -> Response:
    """The mission is gone for everybody at once; its photos and tiles are removed soon after."""
    with services.db.write() as tx:
        missions.delete(tx, mission_id)
    return Response(status_code=204)


@router.get("/missions/{mission_id}/report")
def get_report(mission_id: MissionId, services: Use) -> dict[str, Any]:
    """The mission's report as of now: counts, rejected photos with reasons, seconds per stage, latency."""
    with services.db.read() as tx:
        return report(tx, mission_id)
