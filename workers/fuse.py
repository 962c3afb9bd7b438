"""Dirty tiles → their pictures: a pure function of the poses and photos that are there."""

from __future__ import annotations

from collections.abc import Sequence

from core.coverage import Encoded, blocks, draw_block
from core.grid import TileKey
from services.catalog import backlog, missions, poses, tiles
from services.catalog.poses import Poses
from services.catalog.tiles import TileBox
from services.queue import send
from workers import warmup
from workers.app import Stopwatch, before_the_fork, db, stage, store
from workers.photos import MissionPhotos, shelf
from workers.pictures import put_tile

before_the_fork(warmup.rendering)


@stage("fuse")
def fuse(mission_id: str, keys: Sequence[Sequence[int]]) -> None:
    """Render these tiles from the newest poses and hand them to publish."""
    clock = Stopwatch()
    for claimed in blocks(TileKey(*key) for key in keys):
        with db.read() as tx:
            wanted = backlog.unrendered(tx, mission_id, claimed)
            block = [TileKey(*key) for key in wanted]
            if not block:
                continue  # this task ran before, or somebody else was faster
            mission = missions.get(tx, mission_id)
            known = poses.load(tx, mission_id, _box(block))
        photos = MissionPhotos(shelf, mission_id, mission.max_side)
        pictures = drawn(block, known, photos)
        renders = [put_tile(store, mission_id, wanted[t], t, p) for t, p in pictures.items()]
        with db.write() as tx:
            tiles.record_renders(tx, mission_id, renders)
            clock.spend(tx, mission_id, "fuse")
    send("publish", mission_id)


def _box(block: Sequence[TileKey]) -> TileBox:
    xs, ys = [t.x for t in block], [t.y for t in block]
    return TileBox(block[0].z, min(xs), min(ys), max(xs), max(ys))


def drawn(block: Sequence[TileKey], known: Poses, photos: MissionPhotos) -> dict[TileKey, Encoded | None]:
    """The block's tiles; those of another zoom than the mission's are empty (publish makes overviews)."""
    if known.world is None or known.zoom != block[0].z or not known.placed:
        return dict.fromkeys(block)
    frames = [p.posed(known.cameras) for p in known.placed.values()]
    return draw_block(block, known.world, frames, photos)
