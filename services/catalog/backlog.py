"""How much lies on each stage's desk: what the sequencer decides the pace of rendering by."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from sqlalchemy import ColumnElement, Integer, bindparam, func, or_, select
from sqlalchemy.orm import Session

from services.catalog.rows import among, chunks, clock, mission, table
from services.catalog.tiles import HEAL, Key, Render, waiting
from services.tables import DirtyTile, Frame, Tile


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


def _to_do() -> ColumnElement[bool]:
    return or_(DirtyTile.rendered_generation.is_(None), DirtyTile.rendered_generation < DirtyTile.generation)


_FRAME, _DIRTY = table(Frame).c, table(DirtyTile).c
_FRAMES = (
    select(_FRAME.state, func.count())
    .where(_FRAME.mission_id == bindparam("mission"), _FRAME.state.in_(("received", "ready", "matched")))
    .group_by(_FRAME.state)
)
_MATCHED_AT = select(_FRAME.matched_at).where(
    _FRAME.mission_id == bindparam("mission"), _FRAME.id == bindparam("frame")
)
_WAITING = (
    select(_FRAME.id)
    .where(_FRAME.mission_id == bindparam("mission"), _FRAME.state == "matched")
    .where(_FRAME.id != bindparam("frame"), _FRAME.matched_at >= bindparam("since"))
    .limit(1)
)
_UNREAD = select(func.count()).select_from(
    select(_FRAME.id)
    .where(_FRAME.mission_id == bindparam("mission"), _FRAME.state.in_(("received", "ready")))
    .limit(bindparam("most", type_=Integer))
    .subquery()
)
_CLAIMED = _DIRTY.claimed_at > bindparam("begun")
_TILES = select(
    func.count().filter(_to_do(), _CLAIMED),
    func.count().filter(_to_do(), or_(_DIRTY.claimed_at.is_(None), ~_CLAIMED)),
    func.count().filter(_DIRTY.rendered_generation.is_not(None)),
).where(_DIRTY.mission_id == bindparam("mission"))


def of(tx: Session, mission_id: str, ttl_s: float, now: float | None = None) -> Backlog:
    """The mission's backlog. A claim older than `ttl_s` counts as not begun."""
    frames = {row[0]: row[1] for row in tx.execute(_FRAMES, {"mission": mission_id})}
    claims = {"mission": mission_id, "begun": clock(now) - ttl_s}
    in_flight, to_render, to_publish = tx.execute(_TILES, claims).one()
    unread = frames.get("received", 0) + frames.get("ready", 0)
    return Backlog(unread, frames.get("matched", 0), in_flight, to_render, to_publish)


def is_news(tx: Session, mission_id: str, frame_id: str, calm_s: float, workers: int = 0) -> bool:
    """Whether to wake the sequencer for this frame, which was matched just now.

    Not for one of many: the first of every `calm_s` wakes it, the last that there is to match, and the one
    after which there are only as many as `workers` are at.
    """
    this = {"mission": mission_id, "frame": frame_id}
    at = tx.execute(_MATCHED_AT, this).scalar()
    if tx.execute(_WAITING, this | {"since": (at or 0.0) // calm_s * calm_s}).first() is None:
        return True
    # Counted no further than it matters: thousands may still be to come.
    still_to_come = tx.execute(_UNREAD, {"mission": mission_id, "most": workers + 1}).scalar_one()
    return still_to_come in (0, workers)


@dataclass(frozen=True, slots=True)
class ToDraw:
    """A dirty tile: the `generation` that its new picture will show, and what it shows so far, if anything.

    `whole`: all of it is to be drawn, not only what it does not show yet.
    """

    generation: int
    whole: bool
    shown: Render | None


def unrendered(tx: Session, mission_id: str, keys: Collection[Key]) -> Mapping[Key, ToDraw]:
    """Those of these tiles that are to be rendered, sorted.

    Read it in the same transaction as the poses: those are as new as that generation, or newer.
    """
    final = mission(tx, mission_id).final_generation is not None
    found: dict[Key, ToDraw] = {}
    for some in chunks(sorted((z, x, y) for z, x, y in keys)):
        query = select(DirtyTile).where(
            DirtyTile.mission_id == mission_id,
            among(DirtyTile, some),
            _to_do(),
        )
        for row in tx.scalars(query.execution_options(populate_existing=True)):
            shown = waiting(row) if row.rendered_generation is not None else None
            key = (row.z, row.x, row.y)
            found[key] = ToDraw(row.generation, final or row.priority >= HEAL, shown)
    published = _published(tx, mission_id, [key for key, todo in found.items() if todo.shown is None])
    return {key: replace(found[key], shown=found[key].shown or published.get(key)) for key in sorted(found)}


def _published(tx: Session, mission_id: str, keys: Sequence[Key]) -> Mapping[Key, Render]:
    found: dict[Key, Render] = {}
    for some in chunks(keys):
        query = select(Tile).where(Tile.mission_id == mission_id, among(Tile, some))
        for t in tx.scalars(query.execution_options(populate_existing=True)):
            picture = (t.object_key, t.etag, t.media_type, t.size_bytes, t.inputs)
            found[t.z, t.x, t.y] = Render((t.z, t.x, t.y), t.generation, *picture)
    return found
