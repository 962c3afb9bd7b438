"""The mission's diary: what viewers are told, in the order in which it became true."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import bindparam, insert, select, update
from sqlalchemy.orm import Session

from services.catalog.rows import MISSION, clock, hold, in_step, table
from services.tables import Event, Mission

_NEXT = (
    update(table(Mission))
    .where(MISSION.id == bindparam("mission"))
    .values(event_seq=MISSION.event_seq + 1)
    .returning(MISSION.event_seq)
)
_INSERT = insert(table(Event))


def append(
    tx: Session, mission_id: str, kind: str, payload: Mapping[str, Any], now: float | None = None
) -> int:
    """Write one event; its number, one more than the last one's of the mission."""
    hold(tx, mission_id)
    seq: int = tx.execute(_NEXT, {"mission": mission_id}).scalar_one()
    event = {"mission_id": mission_id, "seq": seq, "kind": kind, "payload": dict(payload), "at": clock(now)}
    tx.execute(_INSERT, event)
    in_step(tx, mission_id, event_seq=seq)
    return seq


def append_frames(
    tx: Session, mission_id: str, state: str, frame_ids: Iterable[str], now: float | None = None, **more: Any
) -> None:
    """One 'frame' event {"state", "frames": [ids], …more} for all that changed alike; none for no frame."""
    ids = sorted(frame_ids)
    if ids:
        append(tx, mission_id, "frame", {"state": state, "frames": ids, **more}, now)


def since(tx: Session, mission_id: str, seq: int, limit: int = 500) -> Sequence[Event]:
    """The events after number `seq`, oldest first, at most `limit`."""
    query = (
        select(Event).where(Event.mission_id == mission_id, Event.seq > seq).order_by(Event.seq).limit(limit)
    )
    return tx.scalars(query).all()
