"""What stands still and whom to wake: the sweep's one question to the catalog."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy.orm import Session

from services.catalog import exports, frames, missions
from services.catalog.wakes import Wake


def stalled(tx: Session, older_than_s: float, now: float | None = None) -> Sequence[Wake]:
    """Everything that stood still for `older_than_s`, stamped so that the next sweep waits as long again."""
    return [
        *frames.stalled(tx, older_than_s, now),
        *missions.stalled(tx, older_than_s, now),
        *exports.stalled(tx, older_than_s, now),
    ]
