"""Rendered tiles → one new revision of the map, with every overview above them made anew."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from core.coverage import overview, quarter, top_zoom
from core.grid import TileKey, children, parent
from services.catalog import backlog, missions, tiles
from services.catalog.tiles import Key, Render, TileBox
from services.errors import RevisionConflict
from services.queue import send
from workers.app import CLAIM_TTL_S, Stopwatch, db, log, settings, stage, store
from workers.pictures import Pictures, put_tile

quarters = Pictures(store, settings.tile_cache_bytes // 2, quarter)
ENOUGH, ENOUGH_LIVE = 128, 24
"""Tiles that are worth a revision of their own while others are still drawn: every revision has its price,
the overviews up to the top.
"""


@stage("publish")
def publish(mission_id: str) -> None:
    """Flip what was rendered, and its overviews, in one transaction; whoever loses the race tries again."""
    while True:
        clock = Stopwatch()
        with db.read() as tx:
            mission = missions.get(tx, mission_id)
            pending = tiles.pending_renders(tx, mission_id)
            bounds = tiles.bounds(tx, mission_id)
            desk = backlog.of(tx, mission_id, CLAIM_TTL_S)
        if not pending or mission.zoom is None:
            break
        final = mission.final_generation is not None
        more = desk.in_flight + (desk.to_render if final else 0) > 0
        if more and len(pending) < (ENOUGH if final else ENOUGH_LIVE):
            break  # whoever draws the last of them wakes us
        changes = _with_overviews(mission_id, mission.zoom, pending, bounds)
        try:
            with db.write() as tx:
                revision = tiles.publish(tx, mission_id, mission.revision, changes, pending)
                clock.spend(tx, mission_id, "publish")
        except RevisionConflict:
            continue
        log.info("published", mission=mission_id, revision=revision, tiles=len(changes))
    send("sequence", mission_id)


def _with_overviews(
    mission_id: str, zoom: int, pending: Sequence[Render], bounds: TileBox | None
) -> list[Render]:
    """The renders and everything above them, deepest first."""
    by_level: dict[int, dict[TileKey, Render]] = {}
    for render in pending:
        by_level.setdefault(render.key[0], {})[TileKey(*render.key)] = render
    top = _top(mission_id, zoom, by_level.get(zoom, {}), bounds)
    newest = max(r.generation for r in pending)
    changes = [r for z, level in by_level.items() if z >= zoom for r in level.values()]
    below = by_level.get(zoom, {})
    for z in range(zoom - 1, -1, -1):
        stale = {parent(tile) for tile in below} | by_level.get(z, {}).keys()
        below = _overviews(mission_id, sorted(stale), below, newest, z >= top)
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

    return {
        tile: put_tile(
            store,
            mission_id,
            generation,
            tile,
            overview([quarters.get(picture_key(c)) for c in children(tile)]),
        )
        for tile in stale
    }


def _top(mission_id: str, zoom: int, renders: Mapping[TileKey, Render], bounds: TileBox | None) -> int:
    """The uppermost zoom of the pyramid once these native tiles are shown."""
    filled = {tile for tile, r in renders.items() if r.object_key is not None}
    if len(filled) < len(renders):
        # Something became empty: only all tiles together tell how far the map still reaches.
        with db.read() as tx:
            shown = {TileKey(*key) for key in tiles.keys(tx, mission_id, zoom)}
        filled |= shown - renders.keys()
    elif bounds is not None:
        filled |= {TileKey(zoom, bounds.x0, bounds.y0), TileKey(zoom, bounds.x1, bounds.y1)}
    return top_zoom(filled) if filled else zoom
