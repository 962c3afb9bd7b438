"""What hangs together in a mission and why: submaps, the ties between them, and every pair's verdict."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from services.api.context import MissionId, Services, Use
from services.catalog import frames, missions, pairs, poses

router = APIRouter(tags=["submaps"])

_KEY = "^[0-9a-f]{32}-[0-9a-f]{32}$"


class ConnectedMap(BaseModel):
    """Frames whose poses hang together as of now. `sources`: how many were posed in which way."""

    submap: int = Field(description="As in poses.json; 0 is the largest of the last solve")
    frames: int
    sources: dict[str, int]


class SubmapOut(BaseModel):
    """A part of one drone's flight whose first matches hang together; 0 is the largest."""

    index: int
    submap: int | None = Field(description="The connected map it has become part of; null: it has no pose")
    frames: int
    drone: str
    georeferenced_by: Literal["gps", "tie", "none"]


class TieOut(BaseModel):
    """How firmly two submaps hang together: strength C = F + 0.1 M + 0.1 θ² (Zhan 2021)."""

    low: int
    high: int
    strength: float
    frames: int = Field(description="F: frames that take part")
    points: int = Field(description="M: points that both submaps see")
    angle_deg: float = Field(description="θ: the median angle at which rays to the same point meet")
    accepted: bool = Field(description="It belongs to the strongest forest, which merges the submaps")


class SubmapsOut(BaseModel):
    """The mission's maps as of now; its submaps and ties as of the last time that all was solved."""

    maps: list[ConnectedMap]
    submaps: list[SubmapOut]
    ties: list[TieOut]
    waiting: int = Field(description="Photos that wait, now, for a tie to anything that has a place")
    tried_pairs: int = Field(description="Pairs that were tried in order to tie submaps")
    dropped_pairs: int = Field(description="Accepted pairs that contradict the rest and count for nothing")
    solved_frames: int


class PairOut(BaseModel):
    """What matching two frames came to. `counts`: correspondences left after each stage."""

    low: str
    high: str
    state: Literal["claimed", "done"]
    accepted: bool
    reason: str | None = Field(description='"ok", or why it was not accepted; null: not matched yet')
    points: int
    counts: dict[str, int]


class PairPage(BaseModel):
    """Pairs by their frames' ids; `next` is the `after` of the next page, null on the last one."""

    pairs: list[PairOut]
    next: str | None


@router.get("/missions/{mission_id}/submaps")
def get_submaps(mission_id: MissionId, services: Use) -> SubmapsOut:
    """Which frames hang together, what places them, and how strong the ties are."""
    with services.db.read() as tx:
        row = missions.get(tx, mission_id)
        maps = poses.maps(tx, mission_id)
        waiting = len(frames.islands(tx, mission_id))
    known = row.submaps or {"submaps": [], "ties": [], "tried_pairs": 0, "dropped_pairs": 0}
    return SubmapsOut.model_validate(
        known
        | {
            "maps": [{"submap": k, "frames": sum(n.values()), "sources": n} for k, n in maps.items()],
            "waiting": waiting,
            "solved_frames": row.solved_frames,
        }
    )


@router.get("/missions/{mission_id}/pairs")
def list_pairs(
    mission_id: MissionId,
    services: Use,
    frame_id: Annotated[str | None, Query(pattern="^[0-9a-f]{32}$", description="Only its pairs")] = None,
    accepted: Annotated[bool | None, Query(description="Only those that were, or were not")] = None,
    limit: Annotated[int, Query(ge=1, le=5000)] = 500,
    after: Annotated[str | None, Query(pattern=_KEY, description="low-high")] = None,
) -> PairPage:
    """Every pair of frames that was proposed, and why it was accepted or not."""
    rows = _rows(services, mission_id, frame_id, accepted, limit + 1, after)
    shown = rows[:limit]
    more = len(rows) > limit
    return PairPage(pairs=shown, next=f"{shown[-1].low}-{shown[-1].high}" if more else None)


def _rows(
    services: Services,
    mission_id: str,
    frame_id: str | None,
    accepted: bool | None,
    limit: int,
    after: str | None,
) -> list[PairOut]:
    last = (after[:32], after[33:]) if after else None
    with services.db.read() as tx:
        missions.get(tx, mission_id)
        found = pairs.list(tx, mission_id, limit, last, frame_id, accepted)
    return [
        PairOut(
            low=p.low,
            high=p.high,
            state="done" if p.done else "claimed",
            accepted=p.accepted,
            reason=p.reason,
            points=p.inliers,
            counts=dict(p.counts),
        )
        for p in found
    ]
