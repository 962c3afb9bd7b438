"""How much lies on each stage's desk: what the sequencer decides the pace of rendering by."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from sqlalchemy import ColumnElement, func, or_, select, tuple_
from sqlalchemy.orm import Session

from services.catalog.rows import chunks, clock
from services.catalog.tiles import Key
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
    frames = {row[0]: row[1] for row in tx.execute(by_state.group_by(Frame.state))}
    to_do = _to_do()
    claimed = DirtyTile.claimed_at > clock(now) - ttl_s
    query = select(
        func.count().filter(to_do, claimed),
        func.count().filter(to_do, or_(DirtyTile.claimed_at.is_(None), ~claimed)),
        func.count().filter(DirtyTile.rendered_generation.is_not(None)),
    ).where(DirtyTile.mission_id == mission_id)
    in_flight, to_render, to_publish = tx.execute(query).one()
    unread = frames.get("received", 0) + frames.get("ready", 0)
    return Backlog(unread, frames.get("matched", 0), in_flight, to_render, to_publish)


def unrendered(tx: Session, mission_id: str, keys: Collection[Key]) -> Mapping[Key, int]:
    """Those of these tiles that are to be rendered, sorted: each with the generation it then shows.

    Read it in the same transaction as the poses: those are as new as that generation, or newer.
    """
    found: dict[Key, int] = {}
    for some in chunks(sorted((z, x, y) for z, x, y in keys)):
        query = select(DirtyTile.z, DirtyTile.x, DirtyTile.y, DirtyTile.generation).where(
            DirtyTile.mission_id == mission_id,
            tuple_(DirtyTile.z, DirtyTile.x, DirtyTile.y).in_(some),
            _to_do(),
        )
        found |= {(z, x, y): generation for z, x, y, generation in tx.execute(query)}
    return dict(sorted(found.items()))


def _to_do() -> ColumnElement[bool]:
    return or_(DirtyTile.rendered_generation.is_(None), DirtyTile.rendered_generation < DirtyTile.generation)
