"""One at a time makes the overviews of what was rendered: of two, one would make them in vain."""

from __future__ import annotations

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from services.catalog.rows import clock, hold, lock
from services.errors import RevisionConflict
from services.tables import DirtyTile


def claim(
    tx: Session, mission_id: str, expected_revision: int, ttl_s: float, now: float | None = None
) -> float | None:
    """The claim on publishing all that is rendered; None while somebody else's is younger than `ttl_s`.

    What is rendered meanwhile is no part of it: whoever published looks again. Raises RevisionConflict unless
    the mission is at `expected_revision`.
    """
    if lock(tx, mission_id).revision != expected_revision:
        raise RevisionConflict()
    now = clock(now)
    # A tile that is dirty again may be claimed too, by whoever draws it anew.
    ours = (DirtyTile.mission_id == mission_id, DirtyTile.rendered_generation >= DirtyTile.generation)
    if tx.scalar(select(DirtyTile.z).where(*ours, DirtyTile.claimed_at > now - ttl_s).limit(1)) is not None:
        return None
    statement = update(DirtyTile).where(*ours).values(claimed_at=now)
    tx.execute(statement.execution_options(synchronize_session=False))
    return now


def release(tx: Session, mission_id: str, claimed_at: float) -> None:
    """End a claim: its tiles are published, or were not."""
    hold(tx, mission_id)
    ours = (DirtyTile.mission_id == mission_id, DirtyTile.claimed_at == claimed_at)
    statement = update(DirtyTile).where(*ours).values(claimed_at=None)
    tx.execute(statement.execution_options(synchronize_session=False))
