"""Rendered tiles → one new revision of the map, with every overview above them made anew."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager

from core.coverage import overview, quarter, top_zoom
from core.grid import TileKey, ancestors, children, parent
from services.catalog import backlog, missions, publishing, sharpening, tiles
from services.catalog.tiles import Key, Render, TileBox
from services.errors import RevisionConflict
from services.queue import send
from services.tables import Mission
from workers.app import CLAIM_TTL_S, Stopwatch, db, log, settings, stage, store
from workers.pictures import Pictures, putting

quarters = Pictures(store, settings.tile_cache_bytes // 2, quarter)
ENOUGH, ENOUGH_LIVE = 128, 24
"""Tiles that are worth a revision of their own while others are still drawn: every revision has its price,
the overviews up to the top.
"""
LAST_TILES = 12
"""So many a worker are still drawn when the last but one revision is published."""


@stage("publish")
def publish(mission_id: str) -> None:
    """Flip what was rendered, and its overviews, in one transaction; whoever comes meanwhile leaves it all
    to the one who is at it.
    """
    while True:
        clock = Stopwatch()
        with db.read() as tx:
            mission = missions.get(tx, mission_id)
            pending = tiles.pending_renders(tx, mission_id)
            bounds = tiles.bounds(tx, mission_id)
            desk = backlog.of(tx, mission_id, CLAIM_TTL_S)
            awaited = sharpening.awaited(tx, mission_id) if mission.sharp_zoom is not None else set()
        if not pending or mission.zoom is None:
            break
        sharpens = mission.sharp_zoom is not None
        final = mission.final_generation is not None and not sharpens
        more = desk.in_flight + (desk.to_render if final else 0)
        if more and not _worth_it(len(pending), more, final):
            break  # whoever draws the last of them wakes us
        left = awaited - {render.key for render in pending}
        try:
            with _at_it(mission) as mine:
                if not mine:
                    return  # who is at it looks again when that is done, and wakes the sequencer
                changes = _with_overviews(mission, pending, bounds, left)
                with db.write() as tx:
                    revision = tiles.publish(tx, mission_id, mission.revision, changes, pending)
                    clock.spend(tx, mission_id, "publish")
        except RevisionConflict:
            continue
        log.info("published", mission=mission_id, revision=revision, tiles=len(changes))
    send("sequence", mission_id)


def _worth_it(rendered: int, more: int, final: bool) -> bool:
    """Whether tiles are shown while `more` are still drawn. When all are, everybody waits for the overviews:
    those of most tiles are made before, while the others draw the last few.
    """
    if not final:
        return rendered >= ENOUGH_LIVE
    few = LAST_TILES * settings.workers
    return rendered >= ENOUGH or more <= few <= rendered


@contextmanager
def _at_it(mission: Mission) -> Iterator[bool]:
    """Whether this worker is the one to publish; nobody else does until the end of the block."""
    with db.write() as tx:
        claim = publishing.claim(tx, mission.id, mission.revision, CLAIM_TTL_S)
    try:
        yield claim is not None
    finally:
        if claim is not None:
            with db.write() as tx:
                publishing.release(tx, mission.id, claim)


def _with_overviews(
    mission: Mission, pending: Sequence[Render], bounds: TileBox | None, awaited: Collection[Key]
) -> list[Render]:
    """The renders and everything above them, deepest first.

    While the map is sharpened, a tile from the preview's zoom on waits for all the sharper ones below it
    (`awaited` are still to come): until then it shows what it did.
    """
    assert mission.tile_zoom is not None
    zoom = mission.tile_zoom
    by_level: dict[int, dict[TileKey, Render]] = {}
    for render in pending:
        by_level.setdefault(render.key[0], {})[TileKey(*render.key)] = render
    top = _top(mission, by_level.get(zoom, {}), bounds, bool(awaited))
    held = set(ancestors([TileKey(*key) for key in awaited], mission.zoom or 0))
    newest = max(r.generation for r in pending)
    changes = [r for z, level in by_level.items() if z >= zoom for r in level.values()]
    below = by_level.get(zoom, {})
    for z in range(zoom - 1, -1, -1):
        stale = {parent(tile) for tile in below} | by_level.get(z, {}).keys()
        below = _overviews(mission.id, sorted(stale - held), below, newest, z >= top)
        changes += below.values()
    return changes


def _overviews(
    mission_id: str,
    stale: Collection[TileKey],
    below: Mapping[TileKey, Render],
    generation: int,
    wanted: bool,
) -> dict[TileKey, Render]:
    """Overviews of one zoom from their children, new or as shown; beyond the pyramid's top they are empty."""
    if not wanted:
        return {tile: Render(tile, generation) for tile in stale}
    others: list[Key] = [c for tile in stale for c in children(tile) if c not in below]
    with db.read() as tx:
        shown = tiles.current(tx, mission_id, others)

    def picture_key(tile: TileKey) -> str | None:
        if tile in below:
            return below[tile].object_key
        return shown[tile].object_key if tile in shown else None

    ready = {parent(tile): render.above for tile, render in below.items() if render.above is not None}

    made, put = dict[TileKey, Render](), dict[TileKey, Future[Render]]()
    for tile in stale:
        of = tuple(picture_key(c) for c in children(tile))
        above = ready.get(tile)
        if above is not None and above.of == of:
            picture = above.object_key, above.etag, above.media_type, above.size_bytes
            made[tile] = Render(tile, generation, *picture)
        else:
            picture_of = overview([quarters.get(key) for key in of], settings.tile_format)
            put[tile] = putting(store, mission_id, generation, tile, picture_of)
    return made | {tile: begun.result() for tile, begun in put.items()}


def _top(mission: Mission, renders: Mapping[TileKey, Render], bounds: TileBox | None, partly: bool) -> int:
    """The uppermost zoom of the pyramid once these native tiles are shown. `partly`: others are to come."""
    assert mission.tile_zoom is not None
    zoom = mission.tile_zoom
    filled = {tile for tile, r in renders.items() if r.object_key is not None}
    sharpened = mission.sharp_zoom is not None and not partly
    if sharpened or (len(filled) < len(renders) and not partly):
        # Something became empty: only all tiles together tell how far the map still reaches.
        with db.read() as tx:
            shown = {TileKey(*key) for key in tiles.keys(tx, mission.id, zoom)}
        filled |= shown - renders.keys()
    elif bounds is not None:
        corners = {TileKey(bounds.z, bounds.x0, bounds.y0), TileKey(bounds.z, bounds.x1, bounds.y1)}
        filled = corners if partly else filled | corners
    return top_zoom(filled) if filled else zoom
