"""Whether a finished map shows its poses: every native tile against what it would be drawn from now."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sqlalchemy import select

from core.coverage import block_grid, fusion_of
from core.fusion import FrameIndex
from core.grid import TileKey
from core.inputs import frame_digest, tile_inputs
from services.catalog import poses, tiles
from services.database import Database
from services.tables import Mission, Tile


def older_tiles(out: Path) -> dict[str, Any]:
    """Of an `orthostream run`: its native tiles, and how many are `older` than its poses.

    A tile is older when the digest of all that it was drawn from is not that of the poses of now.
    """
    database = Database(f"sqlite:///{out / '.orthostream' / 'orthostream.db'}")
    with database.read() as tx:
        mission = tx.scalars(select(Mission).order_by(Mission.created_at.desc()).limit(1)).one()
        known, dirty = poses.load(tx, mission.id), tiles.dirty_count(tx, mission.id)
        query = select(Tile).where(Tile.mission_id == mission.id, Tile.z == known.zoom)
        shown = {TileKey(t.z, t.x, t.y): t.inputs for t in tx.scalars(query)}
        side = mission.drawn_side
    database.close()
    if known.world is None:
        return {"tiles": 0, "older": 0, "dirty": dirty}
    fusion = fusion_of(known.photo_side, side)
    index = FrameIndex([p.posed(known.cameras) for p in known.placed.values()], fusion)
    digests = {f.frame_id: frame_digest(f) for f in index.frames}
    older = 0
    for tile, inputs in shown.items():
        near = [digests[f.frame_id] for f in index.overlapping(block_grid([tile]), known.world)]
        older += inputs != tile_inputs(tile, known.world, side, near, fusion)
    return {"tiles": len(shown), "older": older, "dirty": dirty}
