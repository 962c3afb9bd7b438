"""How much lies on each stage's desk: what the sequencer decides the pace of rendering by."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import func, or_, select
from sqlalchemy.orm import Session

from services.catalog.rows import clock
from services.tables import DirtyTile, Frame


@dataclass(frozen=True, slots=True)
class Backlog:
    """`unread`: frames that are not matched yet; `matched`: frames without a pose; `in_flight`: tiles that
    somebody renders now; `to_render`: dirty tiles that nobody has begun; `to_publish`: rendered ones.
    """

    unread: int
    matched: int
    in_flight: int
    to_render: int
    to_publish: int


def of(tx: Session, mission_id: str, ttl_s: float, now: float | None = None) -> Backlog:
    """The mission's backlog. A claim older than `ttl_s` counts as not begun."""
    by_state = select(Frame.state, func.count()).where(
        Frame.mission_id == mission_id, Frame.state.in_(("received", "ready", "matched"))
    )
    frames = {state: count for state, count in tx.execute(by_state.group_by(Frame.state))}
    to_do = or_(DirtyTile.rendered_generation.is_(None), DirtyTile.rendered_generation < DirtyTile.generation)
    claimed = DirtyTile.claimed_at > clock(now) - ttl_s
    query = select(
        func.count().filter(to_do, claimed),
        func.count().filter(to_do, or_(DirtyTile.claimed_at.is_(None), ~claimed)),
        func.count().filter(DirtyTile.rendered_generation.is_not(None)),
    ).where(DirtyTile.mission_id == mission_id)
    in_flight, to_render, to_publish = tx.execute(query).one()
    unread = frames.get("received", 0) + frames.get("ready", 0)
    return Backlog(unread, frames.get("matched", 0), in_flight, to_render, to_publish)
