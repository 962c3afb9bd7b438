"""Surveyed points: sent as a gcp_list.txt, they check the map or hold it in place."""

from __future__ import annotations

from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, Field

from core.checkpoints import Checkpoints, parse_gcp_list
from core.errors import BadCheckpoints
from services.api.context import MissionId, Services, Use
from services.catalog import surveys
from services.errors import NotFound

router = APIRouter(tags=["checkpoints"])

MOST_BYTES = 8_000_000
_BODY = {
    "required": True,
    "content": {
        "text/plain": {
            "schema": {"type": "string"},
            "example": "EPSG:32632\n483211.20 5421000.75 412.3 1033.5 702.0 DJI_0001.JPG gcp1\n",
        }
    },
}
_Used = Annotated[
    list[str],
    Query(
        max_length=1000,
        description="Points that enter the solution; the rest checks it. One shifts the map, more turn and "
        "scale it too.",
    ),
]


class CheckpointsNotFound(NotFound):
    """The mission has no checkpoints. Send a gcp_list.txt first."""

    code = "checkpoints_not_found"


class CheckpointsOut(BaseModel):
    """The surveyed points of a mission. `sightings`: marked pixels, of all points together."""

    points: list[str]
    sightings: int
    use: list[str] = Field(description="Points that enter the solution")


@router.put(
    "/missions/{mission_id}/checkpoints",
    openapi_extra={"requestBody": _BODY},
)
async def put_checkpoints(
    mission_id: MissionId,
    request: Request,
    services: Use,
    use: _Used = [],  # noqa: B006
) -> CheckpointsOut:
    """Send the surveyed points (ODM's gcp_list.txt, UTF-8); they take the place of those sent before.

    report.json then says how far each lies off, in the poses and in the mosaic. Other points to `use` open a
    final mission again: finalise it once more.
    """
    content = await _text(request)
    points = await to_thread.run_sync(lambda: parse_gcp_list(content).using(use))
    await to_thread.run_sync(_keep, services, mission_id, content, sorted(points.used))
    return _document(points)


@router.get("/missions/{mission_id}/checkpoints")
def get_checkpoints(mission_id: MissionId, services: Use) -> CheckpointsOut:
    """The mission's surveyed points."""
    with services.db.read() as tx:
        points = surveys.checkpoints(tx, mission_id)
    if points is None:
        raise CheckpointsNotFound
    return _document(points)


@router.delete("/missions/{mission_id}/checkpoints", status_code=204)
def delete_checkpoints(mission_id: MissionId, services: Use) -> Response:
    """Take the surveyed points back; the map lies again where its photos say."""
    _keep(services, mission_id, None, [])
    return Response(status_code=204)


def _keep(services: Services, mission_id: str, content: str | None, used: list[str]) -> None:
    with services.db.write() as tx:
        moves = surveys.put(tx, mission_id, content, used)
    if moves:
        services.send("sequence", mission_id)


def _document(points: Checkpoints) -> CheckpointsOut:
    return CheckpointsOut(points=points.points, sightings=len(points.sightings), use=sorted(points.used))


async def _text(request: Request) -> str:
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BYTES:
            raise BadCheckpoints(f"The checkpoint file has more than {MOST_BYTES / 1e6:.0f} MB.")
    try:
        return body.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadCheckpoints("The checkpoint file is no UTF-8 text.") from error
