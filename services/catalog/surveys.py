"""The surveyed points of a mission: those that hold its map in place, and those that check it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy.orm import Session

from core.checkpoints import Checkpoints, parse_gcp_list
from services.catalog import missions
from services.catalog.rows import clock, hold, lock, mission
from services.tables import Survey


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
    before.measured = None
    tx.flush()
    return moves and missions.reopen_if_solved(tx, row, now)


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


def keep_measured(tx: Session, mission_id: str, content: str | None, measured: Mapping[str, Any]) -> None:
    """Remember what was found of the points in the mosaic, unless other points (`content`) came meanwhile."""
    hold(tx, mission_id)
    row = get(tx, mission_id)
    if row is not None and row.content == content:
        row.measured = dict(measured)
