"""Dirty tiles → their pictures: a pure function of the poses and photos that are there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace

from core.coverage import FUSION, Encoded, block_grid, blocks, draw_block, overview, quarter, tiles_under
from core.fusion import FrameIndex
from core.grid import TileKey, children, parent
from core.inputs import frame_digest, tile_inputs
from core.patching import fill_block
from services.catalog import backlog, missions, poses, tiles
from services.catalog.backlog import ToDraw
from services.catalog.poses import Placed, Poses
from services.catalog.tiles import Above, Key, Render, TileBox
from services.queue import send
from services.tables import Mission
from workers import warmup
from workers.app import Stopwatch, before_the_fork, db, go_on, log, settings, stage, store
from workers.photos import FileGone, MissionPhotos, shelf
from workers.pictures import Pictures, putting

before_the_fork(warmup.rendering)

pictures = Pictures(store, settings.tile_cache_bytes // 2)


@stage("fuse")
def fuse(mission_id: str, keys: Sequence[Sequence[int]]) -> None:
    """Render these tiles from the newest poses and hand them to publish."""
    clock = Stopwatch()
    for claimed in blocks(TileKey(*key) for key in keys):
        try:
            _fuse_block(mission_id, claimed, clock)
        except FileGone as gone:
            log.warning("photo lost", mission=mission_id, frame=gone.frame_id)
            with db.write() as tx:
                poses.lose(tx, mission_id, gone.frame_id)
            send("fuse", mission_id, claimed)
            send("sequence", mission_id)
    go_on("publish", mission_id)


def _fuse_block(mission_id: str, claimed: Sequence[TileKey], clock: Stopwatch) -> None:
    with db.read() as tx:
        wanted = backlog.unrendered(tx, mission_id, claimed)
        if not wanted:
            return  # this task ran before, or somebody else was faster
        mission = missions.get(tx, mission_id)
        known = near(poses.load(tx, mission_id, _box(mission, list(wanted))), mission.tile_zoom)
    renders, pixels = drawn(mission, known, wanted)
    with db.write() as tx:
        tiles.record_renders(tx, mission_id, renders)
        missions.count_pixels(tx, mission_id, pixels)
        clock.spend(tx, mission_id, "fuse")


def _box(mission: Mission, block: Sequence[Key]) -> TileBox:
    """The tiles around the block among those by which poses are found: next to it frames move its seams."""
    finer = max(0, block[0][0] - (mission.zoom or 0))
    xs, ys = [x >> finer for _, x, _ in block], [y >> finer for _, _, y in block]
    return TileBox(block[0][0] - finer, min(xs) - 1, min(ys) - 1, max(xs) + 1, max(ys) + 1)


def near(known: Poses, zoom: int | None) -> Poses:
    """The same poses, with the tiles of this zoom that they touch."""
    if known.world is None or zoom is None or zoom == known.zoom:
        return known
    found: dict[str, Placed] = {}
    for frame_id, placed in known.placed.items():
        under = tiles_under(placed.posed(known.cameras), known.world, zoom)
        xs, ys = [t.x for t in under], [t.y for t in under]
        if under:
            found[frame_id] = replace(placed, box=TileBox(zoom, min(xs), min(ys), max(xs), max(ys)))
    return replace(known, zoom=zoom, placed=found)


def drawn(
    mission: Mission, known: Poses, wanted: Mapping[Key, ToDraw]
) -> tuple[list[Render], dict[str, int]]:
    """The block's tiles, and how many pixels were rendered for what.

    Tiles of another zoom than the mission's are empty (publish makes overviews).
    """
    block = [TileKey(*key) for key in wanted]
    if known.world is None or known.zoom != block[0].z or not known.placed:
        return [Render(tile, wanted[tile].generation) for tile in block], {}
    whole = [tile for tile in block if wanted[tile].whole]
    parts = [tile for tile in block if not wanted[tile].whole]
    anew, redrawn = _redrawn(mission, known, whole, wanted)
    filled, added = _filled(mission, known, parts, wanted)
    kind = "sharpen" if mission.sharp_zoom else "heal" if mission.final_generation is None else "final"
    return [*anew, *filled], {kind: redrawn, "new": added}


def _redrawn(
    mission: Mission, known: Poses, block: Sequence[TileKey], wanted: Mapping[Key, ToDraw]
) -> tuple[list[Render], int]:
    """The tiles drawn as a whole, but for those that show what they were drawn from already."""
    assert known.world is not None
    index = FrameIndex([p.posed(known.cameras) for p in known.placed.values()], FUSION)
    digests = {f.frame_id: frame_digest(f) for f in index.frames}
    done, inputs = [], dict[TileKey, str]()
    for tile in block:
        near = [digests[f.frame_id] for f in index.overlapping(block_grid([tile]), known.world)]
        inputs[tile] = tile_inputs(tile, known.world, mission.tile_side, near, FUSION)
        shown = wanted[tile].shown
        if shown is not None and shown.inputs == inputs[tile]:
            done.append(replace(shown, generation=wanted[tile].generation))
    left = [tile for tile in block if tile not in {TileKey(*r.key) for r in done}]
    if not left:
        return done, 0
    photos = MissionPhotos(shelf, mission.id, mission.tile_side)
    found = draw_block(left, known.world, index, photos)
    put = [putting(store, mission.id, wanted[t].generation, t, p, inputs[t]) for t, p in found.items()]
    if len(left) == len(wanted) and mission.final_generation is not None:
        made = _with_above(mission.id, put, found)
    else:
        made = [begun.result() for begun in put]
    grid = block_grid(left)
    return [*done, *made], grid.width * grid.height


def _with_above(
    mission_id: str, put: Sequence[Future[Render]], found: Mapping[TileKey, Encoded | None]
) -> list[Render]:
    """Siblings, all of which were drawn now, with their overview on one of them: publish finds it ready."""
    above = parent(next(iter(found)))
    encoded = [found.get(child) for child in children(above)]
    picture = overview([None if e is None else quarter(e[0]) for e in encoded])
    over = putting(store, mission_id, 0, above, picture).result()
    made = [begun.result() for begun in put]
    pictures_of = {TileKey(*r.key): r.object_key for r in made if r.object_key is not None}
    if not pictures_of:
        return made
    first = min(pictures_of)
    of = tuple(pictures_of.get(child) for child in children(above))
    ready = Above(of, over.object_key, over.etag, over.media_type, over.size_bytes)
    return [replace(r, above=ready) if r.key == first else r for r in made]


def _filled(
    mission: Mission, known: Poses, block: Sequence[TileKey], wanted: Mapping[Key, ToDraw]
) -> tuple[list[Render], int]:
    """The tiles with what they did not show yet drawn beside what they show."""
    if not block:
        return [], 0
    assert known.world is not None
    shown = {tile: pictures.get(_key(wanted[tile].shown)) for tile in block}
    index = FrameIndex([p.posed(known.cameras) for p in known.placed.values()], FUSION)
    photos = MissionPhotos(shelf, mission.id, mission.tile_side)
    patched = fill_block(shown, known.world, index, photos)
    put = [putting(store, mission.id, wanted[t].generation, t, p) for t, p in patched.changed.items()]
    kept = [_as_shown(tile, wanted[tile]) for tile in block if tile not in patched.changed]
    return [*kept, *(begun.result() for begun in put)], patched.pixels


def _as_shown(tile: TileKey, todo: ToDraw) -> Render:
    return replace(todo.shown or Render(tile, todo.generation), generation=todo.generation)


def _key(shown: Render | None) -> str | None:
    return shown.object_key if shown else None
