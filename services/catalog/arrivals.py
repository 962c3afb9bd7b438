"""Frames that were read since somebody last asked: what a worker knows grows, nothing is read twice."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from sqlalchemy import and_, or_, select
from sqlalchemy.orm import Session

from core.frame import FrameMeta
from services.catalog.rows import chunks
from services.tables import Frame

LATE_S = 5.0
"""A frame may appear so long after the time at which it says that it was read."""


@dataclass(frozen=True, slots=True)
class Arrived:
    """A frame that was read, at `ready_at`. `looks`: `core.vocabulary.looks`, None before they were kept."""

    frame_id: str
    name: str
    meta: FrameMeta
    looks: bytes | None
    ready_at: float


def since(
    tx: Session, mission_id: str, ready_at: float | None, known: Collection[str], wanted: Collection[str] = ()
) -> Sequence[Arrived]:
    """The frames, but for those `known`, that were read at about `ready_at` or later (None: all), and those
    `wanted`, by id.
    """
    fresh = and_(Frame.meta.is_not(None), or_(Frame.state != "rejected", Frame.matched_at.is_not(None)))
    late = fresh if ready_at is None else and_(fresh, Frame.ready_at >= ready_at - LATE_S)
    query = select(Frame.id).where(Frame.mission_id == mission_id, late)
    ids = sorted({i for i in (*tx.scalars(query), *wanted) if i not in known})
    found: list[Arrived] = []
    columns = (Frame.id, Frame.name, Frame.meta, Frame.looks, Frame.ready_at)
    for some in chunks(ids):
        rows = select(*columns).where(Frame.mission_id == mission_id, Frame.id.in_(some), fresh)
        found += [
            Arrived(i, name, FrameMeta.from_json(meta or {}), looks, at or 0.0)
            for i, name, meta, looks, at in tx.execute(rows)
        ]
    return found


def is_ready(tx: Session, mission_id: str, frame_id: str) -> bool:
    """Whether the frame was read and its partners are still to be sought."""
    query = select(Frame.state).where(Frame.mission_id == mission_id, Frame.id == frame_id)
    return tx.scalar(query) == "ready"
