"""Tiles: dirty → claimed → rendered → published under a new revision of the mission.

A dirty tile may be dirtied again at any point of its way; what was rendered from older poses is still
published, and the tile stays dirty.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy import (
    Integer,
    and_,
    bindparam,
    case,
    delete,
    exists,
    func,
    literal_column,
    or_,
    select,
    tuple_,
    update,
)
from sqlalchemy.orm import Session

from services.catalog import events
from services.catalog.rows import among, chunks, clock, hold, insert, lock, mission, table
from services.errors import RevisionConflict
from services.tables import DirtyTile, Frame, FramePose, Tile, TileVersion

Key = tuple[int, int, int]  # z, x, y: core.grid.TileKey is one

NEW, GROWN, HEAL = 0, 1, 5
"""Priorities of dirty tiles: where nothing was shown yet, where ground was added, where poses moved. Before
the mission is solved finally, those before HEAL are only drawn where they show nothing."""

_DIRTY = select(func.count()).where(table(DirtyTile).c.mission_id == bindparam("mission"))


@dataclass(frozen=True, slots=True)
class Above:
    """The overview of four tiles. `of`: their objects (NW, NE, SW, SE), None for one that is empty."""

    of: tuple[str | None, ...]
    object_key: str | None
    etag: str | None
    media_type: str | None
    size_bytes: int


@dataclass(frozen=True, slots=True)
class Render:
    """One tile's new picture, drawn from the poses of `generation`. Without an object it is empty.

    `etag`: a digest of the encoded picture, equal for equal bytes. `inputs`: of all that it was drawn from,
    when it was drawn as a whole. `above`: the overview of it and its siblings, where that was made with them.
    """

    key: Key
    generation: int
    object_key: str | None = None
    etag: str | None = None
    media_type: str | None = None
    size_bytes: int = 0
    inputs: str | None = None
    above: Above | None = None


@dataclass(frozen=True, slots=True)
class StoredTile:
    """What a tile shows since `revision`. Without an object it is empty."""

    key: Key
    revision: int
    object_key: str | None
    etag: str | None
    media_type: str | None
    size_bytes: int


@dataclass(frozen=True, slots=True)
class TileBox:
    """The tiles of zoom z from (x0, y0) to (x1, y1), both included."""

    z: int
    x0: int
    y0: int
    x1: int
    y1: int


def mark_dirty(
    tx: Session,
    mission_id: str,
    tiles: Mapping[Key, int] | Iterable[Key],
    generation: int,
    priority: int = GROWN,
) -> None:
    """These tiles show poses older than `generation`. `tiles` may map each to its own priority, 0 first."""
    hold(tx, mission_id)
    priorities = dict(tiles) if isinstance(tiles, Mapping) else dict.fromkeys(tiles, priority)
    rows = [
        {
            "mission_id": mission_id,
            "z": z,
            "x": x,
            "y": y,
            "generation": generation,
            "since": generation,
            "priority": priorities[z, x, y],
        }
        for z, x, y in sorted((int(z), int(x), int(y)) for z, x, y in priorities)
    ]
    if not rows:
        return
    upsert = insert(tx, DirtyTile)
    old, new = table(DirtyTile).c, upsert.excluded
    upsert = upsert.on_conflict_do_update(
        index_elements=["mission_id", "z", "x", "y"],
        set_={
            "generation": case((new.generation > old.generation, new.generation), else_=old.generation),
            "priority": case((new.priority < old.priority, new.priority), else_=old.priority),
        },
    )
    tx.execute(upsert, rows)


def claim_dirty(
    tx: Session,
    mission_id: str,
    limit_tiles: int,
    ttl_s: float,
    now: float | None = None,
    by_place: bool = False,
) -> Sequence[DirtyTile]:
    """Tiles to render now, best priority first, 2 × 2 siblings together; they are the caller's for `ttl_s`.

    At most `limit_tiles`, or one block of siblings when the limit is smaller than that. Of all that show new
    ground, and of equal priority, the longest waiting come first; `by_place`: neighbours, which share their
    photos, along strips four high.
    """
    hold(tx, mission_id)
    now = clock(now)
    free = _claimable(mission_id, ttl_s, now)
    block = _block()
    place = (func.min(DirtyTile.y.op(">>")(2)), func.min(DirtyTile.x.op(">>")(1)))
    priority = func.min(DirtyTile.priority)
    # While photos pour in there is new ground all the time: what is added elsewhere would wait for ever.
    adds = case((priority < HEAL, NEW), else_=priority)
    first = (priority, *place, *block) if by_place else (adds, func.min(DirtyTile.since), priority, *block)
    query = select(*block, func.count()).where(free).group_by(*block).order_by(*first).limit(limit_tiles)
    chosen: list[Key] = []
    total = 0
    for z, bx, by, count in tx.execute(query):
        if chosen and total + count > limit_tiles:
            break
        chosen.append((z, bx, by))
        total += count
    claimed: list[DirtyTile] = []
    for some in chunks(chosen):
        siblings = {(z, 2 * bx + k, 2 * by + j) for z, bx, by in some for k in (0, 1) for j in (0, 1)}
        claimed += _claim_blocks(tx, and_(free, among(DirtyTile, siblings)), now)
    rank = {key: i for i, key in enumerate(chosen)}
    return sorted(claimed, key=lambda d: (rank[d.z, d.x >> 1, d.y >> 1], d.x, d.y))


def record_renders(tx: Session, mission_id: str, renders: Collection[Render]) -> None:
    """Keep what was rendered until it is published; a render older than the one kept is dropped."""
    hold(tx, mission_id)
    dirty = table(DirtyTile)
    older = or_(
        dirty.c.rendered_generation.is_(None), dirty.c.rendered_generation < bindparam("new_generation")
    )
    statement = (
        update(dirty)
        .where(_is_tile(dirty), older)
        .values(
            rendered_generation=bindparam("new_generation"),
            rendered=bindparam("new_rendered", type_=dirty.c.rendered.type),
            claimed_at=None,
        )
    )
    rows = [
        _tile_params(mission_id, r.key) | {"new_generation": r.generation, "new_rendered": _rendered_json(r)}
        for r in sorted(renders, key=lambda r: r.key)
    ]
    if rows:
        tx.execute(statement, rows)


def pending_renders(tx: Session, mission_id: str, limit: int | None = None) -> Sequence[Render]:
    """What was rendered and not published yet, best priority first."""
    query = (
        select(DirtyTile)
        .where(DirtyTile.mission_id == mission_id, DirtyTile.rendered_generation.is_not(None))
        .order_by(DirtyTile.priority, DirtyTile.z, DirtyTile.x, DirtyTile.y)
        .limit(limit)
        .execution_options(populate_existing=True)
    )
    return [waiting(row) for row in tx.scalars(query)]


def publish(
    tx: Session,
    mission_id: str,
    expected_revision: int,
    changes: Collection[Render],
    rendered: Collection[Render],
    now: float | None = None,
) -> int:
    """Flip `changes` (native tiles and overviews) to a new revision, which is returned.

    `rendered`: the pending renders that went into it; their tiles are clean unless dirtied again since.
    Frames all of whose tiles are out become fused. A change that shows what is shown already is left out;
    when none is left the revision stays. Raises RevisionConflict unless the mission is at
    `expected_revision`.
    """
    row = lock(tx, mission_id)
    now = clock(now)
    if row.revision != expected_revision:
        raise RevisionConflict()
    row.woken_at = now
    news = _news(tx, mission_id, changes)
    if news:
        row.revision += 1
        row.last_tile_at = now
        _flip(tx, mission_id, row.revision, news)
        shown = [r.key for r in news]
        events.append(tx, mission_id, "tiles", {"revision": row.revision, "tiles": shown}, now)
    _note_inputs(tx, mission_id, row.revision, changes)
    _clean(tx, mission_id, rendered)
    fuse_frames(tx, mission_id, now)
    return row.revision


_FRAME, _POSE, _STALE = table(Frame).c, table(FramePose).c, table(DirtyTile).c
_MISSING = exists().where(
    _STALE.mission_id == _POSE.mission_id,
    _STALE.z == _POSE.z,
    _STALE.x.between(_POSE.x0, _POSE.x1),
    _STALE.y.between(_POSE.y0, _POSE.y1),
    _STALE.since <= _POSE.generation,
    _STALE.priority < HEAL,  # where poses moved, it is shown already
)
_SHOWN = (
    select(_FRAME.id)
    .join(table(FramePose), and_(_POSE.mission_id == _FRAME.mission_id, _POSE.frame_id == _FRAME.id))
    .where(_FRAME.mission_id == bindparam("mission"), _FRAME.state == "posed", ~_MISSING)
)


def fuse_frames(tx: Session, mission_id: str, now: float | None = None) -> Sequence[str]:
    """Posed → fused for the frames whose tiles show them; their ids."""
    hold(tx, mission_id)
    now = clock(now)
    fused = sorted(tx.execute(_SHOWN, {"mission": mission_id}).scalars())
    for some in chunks(fused):
        tx.execute(
            update(Frame)
            .where(Frame.mission_id == mission_id, Frame.id.in_(some))
            .values(state="fused", fused_at=func.coalesce(Frame.fused_at, now))
            .execution_options(synchronize_session=False)
        )
    events.append_frames(tx, mission_id, "fused", fused, now)
    return fused


def get(
    tx: Session, mission_id: str, z: int, x: int, y: int, revision: int | None = None
) -> StoredTile | None:
    """What the tile shows now, or showed at `revision`; None when it never showed anything."""
    if revision is None:
        return current(tx, mission_id, [(z, x, y)]).get((z, x, y))
    query = (
        select(TileVersion)
        .where(TileVersion.mission_id == mission_id, TileVersion.z == z)
        .where(TileVersion.x == x, TileVersion.y == y, TileVersion.revision <= revision)
        .order_by(TileVersion.revision.desc())
        .limit(1)
    )
    row = tx.scalars(query).first()
    return _stored(row) if row else None


def current(tx: Session, mission_id: str, keys: Collection[Key]) -> Mapping[Key, StoredTile]:
    """What these tiles show now; those that never showed anything are missing."""
    found: dict[Key, StoredTile] = {}
    for some in chunks(sorted({(z, x, y) for z, x, y in keys})):
        query = (
            select(Tile)
            .where(Tile.mission_id == mission_id, among(Tile, some))
            .execution_options(populate_existing=True)
        )
        found |= {(row.z, row.x, row.y): _stored(row) for row in tx.scalars(query)}
    return found


def at(tx: Session, mission_id: str, revision: int) -> Sequence[StoredTile]:
    """Every tile that showed something at `revision`, as it was then, sorted."""
    columns = (TileVersion.mission_id, TileVersion.z, TileVersion.x, TileVersion.y)
    newest = (
        select(*columns, func.max(TileVersion.revision))
        .where(TileVersion.mission_id == mission_id, TileVersion.revision <= revision)
        .group_by(*columns)
    )
    query = (
        select(TileVersion)
        .where(tuple_(*columns, TileVersion.revision).in_(newest), TileVersion.object_key.is_not(None))
        .order_by(TileVersion.z, TileVersion.x, TileVersion.y)
    )
    return [_stored(row) for row in tx.scalars(query.execution_options(yield_per=1000))]


def keys(tx: Session, mission_id: str, z: int | None = None) -> Sequence[Key]:
    """The tiles that show something now, sorted; `z`: of this zoom only."""
    query = select(Tile.z, Tile.x, Tile.y).where(Tile.mission_id == mission_id, Tile.object_key.is_not(None))
    if z is not None:
        query = query.where(Tile.z == z)
    return [(z, x, y) for z, x, y in tx.execute(query.order_by(Tile.z, Tile.x, Tile.y))]


def bounds(tx: Session, mission_id: str) -> TileBox | None:
    """The native tiles that show something; None while there is none."""
    zoom = mission(tx, mission_id).zoom
    corners = (func.min(Tile.x), func.min(Tile.y), func.max(Tile.x), func.max(Tile.y))
    query = select(*corners).where(
        Tile.mission_id == mission_id, Tile.z == zoom, Tile.object_key.is_not(None)
    )
    x0, y0, x1, y1 = tx.execute(query).one()
    return None if zoom is None or x0 is None else TileBox(zoom, x0, y0, x1, y1)


def dirty_count(tx: Session, mission_id: str) -> int:
    """How many native tiles do not show the newest poses yet, rendered ones included."""
    count: int = tx.execute(_DIRTY, {"mission": mission_id}).scalar_one()
    return count


def _block() -> tuple[Any, Any, Any]:
    # Literals: Postgres takes two bound 1s for two different expressions and refuses the GROUP BY.
    bx = literal_column("dirty_tiles.x >> 1", Integer)
    by = literal_column("dirty_tiles.y >> 1", Integer)
    return DirtyTile.z, bx, by


def _claimable(mission_id: str, ttl_s: float, now: float) -> Any:
    to_do = or_(DirtyTile.rendered_generation.is_(None), DirtyTile.rendered_generation < DirtyTile.generation)
    unclaimed = or_(DirtyTile.claimed_at.is_(None), DirtyTile.claimed_at <= now - ttl_s)
    return and_(DirtyTile.mission_id == mission_id, to_do, unclaimed)


def _claim_blocks(tx: Session, which: Any, now: float) -> Sequence[DirtyTile]:
    statement = update(DirtyTile).where(which).values(claimed_at=now).returning(DirtyTile)
    return tx.scalars(
        statement, execution_options={"synchronize_session": False, "populate_existing": True}
    ).all()


def _news(tx: Session, mission_id: str, changes: Collection[Render]) -> Sequence[Render]:
    shown = current(tx, mission_id, [c.key for c in changes])

    def is_news(change: Render) -> bool:
        old = shown.get(change.key)
        if old is None or old.object_key is None or change.object_key is None:
            return (old.object_key if old else None) != change.object_key
        return old.etag is None or old.etag != change.etag

    return sorted((c for c in changes if is_news(c)), key=lambda c: c.key)


def _flip(tx: Session, mission_id: str, revision: int, news: Sequence[Render]) -> None:
    versions = [
        {
            "mission_id": mission_id,
            "z": r.key[0],
            "x": r.key[1],
            "y": r.key[2],
            "revision": revision,
            "object_key": r.object_key,
            "etag": r.etag,
            "media_type": r.media_type,
            "size_bytes": r.size_bytes,
        }
        for r in news
    ]
    tx.execute(insert(tx, TileVersion), versions)
    upsert = insert(tx, Tile)
    columns = ("revision", "generation", "object_key", "etag", "media_type", "size_bytes")
    upsert = upsert.on_conflict_do_update(
        index_elements=["mission_id", "z", "x", "y"], set_={name: upsert.excluded[name] for name in columns}
    )
    tiles = [v | {"generation": r.generation} for v, r in zip(versions, news, strict=True)]
    tx.execute(upsert, tiles)


def _note_inputs(tx: Session, mission_id: str, revision: int, changes: Collection[Render]) -> None:
    """Also of pictures that are no news, and of tiles that are empty as they were."""
    tile = table(Tile)
    parts = [_tile_params(mission_id, r.key) for r in changes if r.inputs is None]
    if parts:
        tx.execute(update(tile).where(_is_tile(tile)).values(inputs=None), parts)
    rows = [
        {"mission_id": mission_id, "z": r.key[0], "x": r.key[1], "y": r.key[2], "inputs": r.inputs}
        | {"revision": revision, "generation": r.generation, "size_bytes": 0}
        for r in changes
        if r.inputs is not None
    ]
    if rows:
        upsert = insert(tx, Tile)
        keys = ["mission_id", "z", "x", "y"]
        update_ = upsert.on_conflict_do_update(
            index_elements=keys, set_={"inputs": upsert.excluded["inputs"]}
        )
        tx.execute(update_, rows)


def _clean(tx: Session, mission_id: str, rendered: Collection[Render]) -> None:
    """Delete the dirty tiles that are out; of those dirtied again, remember from when on they are not."""
    dirty = table(DirtyTile)
    out: Any = bindparam("out")
    rows = [_tile_params(mission_id, r.key) | {"out": r.generation} for r in rendered]
    if not rows:
        return
    tx.execute(delete(dirty).where(_is_tile(dirty), dirty.c.generation == out), rows)
    tx.execute(
        update(dirty).where(_is_tile(dirty), dirty.c.since <= out).values(since=bindparam("out") + 1), rows
    )
    # A newer render that came in meanwhile is kept for the next publication.
    kept = update(dirty).where(_is_tile(dirty), dirty.c.rendered_generation <= out)
    tx.execute(kept.values(rendered_generation=None, rendered=None), rows)


def _is_tile(rows: Any) -> Any:
    return and_(
        rows.c.mission_id == bindparam("tile_mission"),
        rows.c.z == bindparam("tile_z"),
        rows.c.x == bindparam("tile_x"),
        rows.c.y == bindparam("tile_y"),
    )


def _tile_params(mission_id: str, key: Key) -> dict[str, Any]:
    z, x, y = key
    return {"tile_mission": mission_id, "tile_z": z, "tile_x": x, "tile_y": y}


def _rendered_json(render: Render) -> dict[str, Any]:
    if render.object_key is None:
        return {"empty": True, "inputs": render.inputs}
    return {
        "object_key": render.object_key,
        "etag": render.etag,
        "media_type": render.media_type,
        "size_bytes": render.size_bytes,
        "inputs": render.inputs,
        "above": None if render.above is None else asdict(render.above),
    }


def waiting(row: DirtyTile) -> Render:
    """What was rendered for this tile last and is not published yet."""
    fields = {k: v for k, v in (row.rendered or {}).items() if k != "empty"}
    if above := fields.get("above"):
        fields["above"] = Above(**above | {"of": tuple(above["of"])})
    return Render((row.z, row.x, row.y), row.rendered_generation or 0, **fields)


def _stored(row: Tile | TileVersion) -> StoredTile:
    return StoredTile(
        (row.z, row.x, row.y), row.revision, row.object_key, row.etag, row.media_type, row.size_bytes
    )
