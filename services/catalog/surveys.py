"""The surveyed points of a mission: those that hold its map in place, and those that check it."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from core.checkpoints import Checkpoints, parse_gcp_list
from services.catalog import events
from services.catalog.rows import clock, lock, mission
from services.tables import Frame, Mission, Survey


def put(tx: Session, mission_id: str, content: str | None, used: list[str], now: float | None = None) -> bool:
    """Keep a gcp_list.txt (None: none any more); whether poses depend on it that were solved already.

    Then the mission is open again, or solves its final poses once more. Raises MissionNotFound.
    """
    row = lock(tx, mission_id)
    now = clock(now)
    before, used = get(tx, mission_id), sorted(set(used))
    if before is None:
        if content is None:
            return False
        before = Survey(mission_id=mission_id, content=None, used=[], changed_at=now)
        tx.add(before)
    if (before.content, before.used) == (content, used):
        return False
    moves = bool(before.used or used)
    before.content, before.used, before.changed_at = content, used, now
    tx.flush()
    solved = tx.scalar(
        select(func.count()).where(Frame.mission_id == mission_id, Frame.posed_at.is_not(None))
    )
    if moves and solved:
        _reopen(tx, row, now)
    return bool(moves and solved)


def get(tx: Session, mission_id: str) -> Survey | None:
    """The survey's row; None when there never was one. Raises MissionNotFound."""
    mission(tx, mission_id)
    return tx.get(Survey, mission_id, populate_existing=True)


def checkpoints(tx: Session, mission_id: str) -> Checkpoints | None:
    """The surveyed points, None without any. Raises MissionNotFound."""
    row = get(tx, mission_id)
    if row is None or row.content is None:
        return None
    return parse_gcp_list(row.content).using(row.used)


def _reopen(tx: Session, row: Mission, now: float) -> None:
    row.final_generation = None  # what was solved as final knew other points
    if row.state == "final":
        row.state = "open"
        row.finished_at = None
        events.append(tx, row.id, "mission", {"state": "open"}, now)
