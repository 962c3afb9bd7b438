"""Sharpening: a map that is final at preview size is drawn once more from the full photos, tile by tile.

What is shown stays until something sharper takes its place: a tile of the preview's zoom only when all that
lies below it is there. A photo that comes meanwhile ends it; after the next finalising it begins anew.
"""

from __future__ import annotations

from collections.abc import Collection

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from services.catalog import events, leases, tiles
from services.catalog.rows import clock, lock
from services.catalog.tiles import HEAL, Key, Render
from services.tables import DirtyTile, Mission, Tile


def wanted(row: Mission) -> bool:
    """Whether the mission, final at preview size, is to be drawn at full resolution."""
    return row.backfill and not row.full and row.max_side is not None and row.zoom is not None


def begin(tx: Session, mission_id: str, epoch: int, zoom: int, keys: Collection[Key]) -> None:
    """These are the tiles to draw, those of `zoom` from the full photos. Raises LeaseLost."""
    leases.guard(tx, mission_id, epoch)
    row = lock(tx, mission_id)
    if row.state != "sharpening":
        return
    row.sharp_zoom, row.sharp_tiles = zoom, len(keys)
    tiles.mark_dirty(tx, mission_id, keys, row.generation, HEAL)
    events.append(tx, mission_id, "mission", {"state": "sharpening"})


def end(tx: Session, mission_id: str, now: float | None = None) -> bool:
    """Sharpening → final: from now on all is drawn at full resolution. False when it is no longer that.

    In the same transaction save the poses with the tiles of the new zoom.
    """
    row = lock(tx, mission_id)
    if row.state != "sharpening" or row.sharp_zoom is None:
        return False
    now = clock(now)
    row.full, row.sharp_zoom, row.sharp_tiles = True, None, None
    row.state, row.finished_at = "final", now
    events.append(tx, mission_id, "mission", {"state": "final", "revision": row.revision}, now)
    return True


def undo(tx: Session, row: Mission, now: float) -> None:
    """Forget what was drawn at full resolution below the preview's tiles: its poses will move."""
    if row.sharp_zoom is None:
        return
    deeper = DirtyTile.z > row.zoom
    tx.execute(delete(DirtyTile).where(DirtyTile.mission_id == row.id, deeper))
    query = select(Tile.z, Tile.x, Tile.y).where(
        Tile.mission_id == row.id, Tile.z > row.zoom, Tile.object_key.is_not(None)
    )
    gone = [Render((z, x, y), row.generation) for z, x, y in tx.execute(query)]
    tiles.publish(tx, row.id, row.revision, gone, [], now)
    row.sharp_zoom = row.sharp_tiles = None


def share(tx: Session, row: Mission) -> float | None:
    """How much of it is drawn, 0 … 1; None when the mission is not being sharpened."""
    if row.state != "sharpening":
        return None
    if not row.sharp_tiles:
        return 0.0
    left = tx.scalar(select(func.count()).select_from(DirtyTile).where(DirtyTile.mission_id == row.id)) or 0
    return max(0.0, 1 - left / row.sharp_tiles)


def awaited(tx: Session, mission_id: str) -> set[Key]:
    """The tiles that are still to be drawn or published."""
    query = select(DirtyTile.z, DirtyTile.x, DirtyTile.y).where(DirtyTile.mission_id == mission_id)
    return {(z, x, y) for z, x, y in tx.execute(query)}
