"""Dirty tiles → their pictures: a pure function of the poses and photos that are there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace

from core.coverage import Encoded, block_grid, blocks, draw_block, fusion_of, overview, quarter, tiles_under
from core.fusion import FrameIndex, FusionParams, Territory
from core.grid import TILE_PX, TileKey, children, parent, zoom_resolution_m
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

CLOSE_TILES, SPARSEST = 48, 2.0
"""Tiles are drawn from what is read once as long as the rectangle around them holds so many tiles at most, or
so many times as many as are wanted.
"""


@dataclass(frozen=True, slots=True)
class _Sight:
    """All that neighbouring tiles are drawn from, read at one moment."""

    mission: Mission
    known: Poses
    index: FrameIndex
    photos: MissionPhotos
    fusion: FusionParams
    digests: dict[str, bytes] = field(default_factory=dict)

    @classmethod
    def of(cls, mission: Mission, known: Poses) -> _Sight:
        fusion = _fusion(mission)
        index = FrameIndex([p.posed(known.cameras) for p in known.placed.values()], fusion)
        photos = MissionPhotos(shelf, mission.id, mission.tile_side)
        if known.world is not None and known.zoom is not None:
            resolution_m = zoom_resolution_m(known.zoom, known.world.lat_deg)
            photos = replace(photos, likely=Territory(index, resolution_m, fusion).share)
        return cls(mission, known, index, photos, fusion)

    def shows(self, zoom: int) -> bool:
        """Whether tiles of this zoom show anything: those of another than the mission's are overviews."""
        return self.known.world is not None and self.known.zoom == zoom and bool(self.known.placed)

    def inputs(self, tile: TileKey) -> str:
        """See Render."""
        assert self.known.world is not None
        around = self.index.overlapping(block_grid([tile]), self.known.world)
        for frame in around:
            if frame.frame_id not in self.digests:
                self.digests[frame.frame_id] = frame_digest(frame)
        digests = [self.digests[f.frame_id] for f in around]
        return tile_inputs(
            tile, self.known.world, self.mission.tile_side, digests, self.fusion, settings.tile_format
        )


@stage("fuse")
def fuse(mission_id: str, keys: Sequence[Sequence[int]]) -> None:
    """Render these tiles from the newest poses and hand them to publish."""
    clock = Stopwatch()
    for group in neighbourhoods(blocks(TileKey(*key) for key in keys)):
        try:
            _fuse_group(mission_id, group, clock)
        except FileGone as gone:
            log.warning("photo lost", mission=mission_id, frame=gone.frame_id)
            with db.write() as tx:
                poses.lose(tx, mission_id, gone.frame_id)
            send("fuse", mission_id, [tile for block in group for tile in block])
            send("sequence", mission_id)
    go_on("publish", mission_id)


def neighbourhoods(found: Iterable[list[TileKey]]) -> list[list[list[TileKey]]]:
    """Blocks in their order, together as long as they lie close: they are drawn from the same frames."""
    groups: list[list[list[TileKey]]] = []
    for block in found:
        near = [tile for one in (groups[-1] if groups else []) for tile in one] + block
        xs, ys = [tile.x for tile in near], [tile.y for tile in near]
        area = (max(xs) - min(xs) + 1) * (max(ys) - min(ys) + 1)
        if groups and groups[-1][0][0].z == block[0].z and area <= max(SPARSEST * len(near), CLOSE_TILES):
            groups[-1].append(block)
        else:
            groups.append([block])
    return groups


def _fuse_group(mission_id: str, group: Sequence[Sequence[TileKey]], clock: Stopwatch) -> None:
    with db.read() as tx:
        wanted = backlog.unrendered(tx, mission_id, [tile for block in group for tile in block])
        if not wanted:
            return  # this task ran before, or somebody else was faster
        mission = missions.get(tx, mission_id)
        known = near(poses.load(tx, mission_id, _box(mission, list(wanted))), mission)
    sight = _Sight.of(mission, known)
    for block in group:
        mine = {tile: wanted[tile] for tile in block if tile in wanted}
        if mine:
            renders, pixels = _drawn(sight, mine)
            with db.write() as tx:
                tiles.record_renders(tx, mission_id, renders)
                missions.count_pixels(tx, mission_id, pixels)
                clock.spend(tx, mission_id, "fuse")


def _fusion(mission: Mission) -> FusionParams:
    """How the tiles that are drawn now are put together."""
    return fusion_of(mission.photo_side, mission.tile_side)


def _box(mission: Mission, block: Sequence[Key]) -> TileBox:
    """The tiles around the block among those by which poses are found: next to it frames move its seams."""
    finer = max(0, block[0][0] - (mission.zoom or 0))
    xs, ys = [x >> finer for _, x, _ in block], [y >> finer for _, _, y in block]
    rim = -(-_fusion(mission).rim_px // TILE_PX)
    return TileBox(block[0][0] - finer, min(xs) - rim, min(ys) - rim, max(xs) + rim, max(ys) + rim)


def near(known: Poses, mission: Mission) -> Poses:
    """The same poses, with the tiles that they touch of the zoom that is drawn now."""
    zoom, fusion = mission.tile_zoom, _fusion(mission)
    if known.world is None or zoom is None or zoom == known.zoom:
        return known
    found: dict[str, Placed] = {}
    for frame_id, placed in known.placed.items():
        under = tiles_under(placed.posed(known.cameras), known.world, zoom, fusion)
        xs, ys = [t.x for t in under], [t.y for t in under]
        if under:
            found[frame_id] = replace(placed, box=TileBox(zoom, min(xs), min(ys), max(xs), max(ys)))
    return replace(known, zoom=zoom, placed=found)


def _drawn(sight: _Sight, wanted: Mapping[TileKey, ToDraw]) -> tuple[list[Render], dict[str, int]]:
    """The block's tiles, and how many pixels were rendered for what."""
    block = sorted(wanted)
    if not sight.shows(block[0].z):
        return [Render(tile, wanted[tile].generation) for tile in block], {}
    anew, redrawn = _redrawn(sight, [tile for tile in block if wanted[tile].whole], wanted)
    filled, added = _filled(sight, [tile for tile in block if not wanted[tile].whole], wanted)
    mission = sight.mission
    kind = "sharpen" if mission.sharp_zoom else "heal" if mission.final_generation is None else "final"
    return [*anew, *filled], {kind: redrawn, "new": added}


def _redrawn(
    sight: _Sight, block: Sequence[TileKey], wanted: Mapping[TileKey, ToDraw]
) -> tuple[list[Render], int]:
    """The tiles drawn as a whole, but for those that show what they were drawn from already."""
    mission, world = sight.mission, sight.known.world
    assert world is not None
    done, inputs = [], {tile: sight.inputs(tile) for tile in block}
    for tile in block:
        shown = wanted[tile].shown
        if shown is not None and shown.inputs == inputs[tile]:
            done.append(replace(shown, generation=wanted[tile].generation))
    left = [tile for tile in block if tile not in {TileKey(*r.key) for r in done}]
    if not left:
        return done, 0
    found = draw_block(left, world, sight.index, sight.photos, sight.fusion, settings.tile_format)
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
    quarters = [None if e is None else quarter(e[0]) for e in encoded]
    picture = overview(quarters, settings.tile_format)
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
    sight: _Sight, block: Sequence[TileKey], wanted: Mapping[TileKey, ToDraw]
) -> tuple[list[Render], int]:
    """The tiles with what they did not show yet drawn beside what they show."""
    if not block:
        return [], 0
    mission, world = sight.mission, sight.known.world
    assert world is not None
    shown = {tile: pictures.get(_key(wanted[tile].shown)) for tile in block}
    patched = fill_block(shown, world, sight.index, sight.photos, tile_format=settings.tile_format)
    put = [putting(store, mission.id, wanted[t].generation, t, p) for t, p in patched.changed.items()]
    kept = [_as_shown(tile, wanted[tile]) for tile in block if tile not in patched.changed]
    return [*kept, *(begun.result() for begun in put)], patched.pixels


def _as_shown(tile: TileKey, todo: ToDraw) -> Render:
    return replace(todo.shown or Render(tile, todo.generation), generation=todo.generation)


def _key(shown: Render | None) -> str | None:
    return shown.object_key if shown else None
