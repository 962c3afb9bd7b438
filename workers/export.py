"""A finished (or growing) map → the files that other programs read."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from core.archives import TileSet, write_folder, write_mbtiles, write_pmtiles
from core.cog import DEFAULT as COG
from core.cog import MosaicPlan
from core.coverage import fusion_of, mission_gsd_m
from core.errors import NothingToMap, OrthostreamError
from core.exports import (
    NamedFrame,
    WaitingFrame,
    footprints_geojson,
    is_local,
    json_bytes,
    poses_document,
    route_csv,
)
from core.geometry import PosedFrame, World
from core.grid import TileKey, utm_epsg
from core.preview import Preview, preview, write_preview
from core.pyramid import JPEG
from core.stac import stac_item
from core.superoverlay import write_kmz
from services.catalog import exports, frames, missions, poses, surveys, tiles
from services.catalog.frames import Seen
from services.catalog.poses import Poses
from services.errors import OutOfDisk
from services.export_names import MAKING, MOSAIC, crs_of
from services.queue import send
from services.report import report
from services.tables import Export, Mission
from workers import surveyed
from workers.app import Stopwatch, db, log, settings, stage, store
from workers.photos import MissionPhotos, shelf
from workers.pieces import SLICE_S, SharedMosaic, check_room, locked

MEDIA_TYPES = {
    ".tif": "image/tiff",
    ".json": "application/json",
    ".geojson": "application/geo+json",
    ".csv": "text/csv",
    ".png": "image/png",
    ".zip": "application/zip",
    ".pmtiles": "application/vnd.pmtiles",
    ".mbtiles": "application/vnd.sqlite3",
    ".kmz": "application/vnd.google-earth.kmz",
}

FOLDER = settings.exports_dir
"""Where files are while they are made."""

NO_ROOM = "The server's disk has no room for this file. Free some space there, then ask for it again."

Maker = Callable[[Path, Mission, Export], None]


@stage("export")
def export(mission_id: str, name: str) -> None:
    """Wanted → ready or failed. Who finds somebody at it already lends a hand."""
    with locked(FOLDER / f"{mission_id}-{name}.lock") as alone:
        with db.read() as tx:
            wanted = exports.get(tx, mission_id, name)
            mission = missions.get(tx, mission_id)
        if wanted is None or wanted.state != "wanted":
            return
        clock = Stopwatch()
        if alone:
            _make(mission, wanted, clock)
            return
    if _is_mosaic(name):
        _help(mission, name, clock)


def _make(mission: Mission, wanted: Export, clock: Stopwatch) -> None:
    try:
        check_room(FOLDER, settings.min_free_bytes)
        key, size = _made(mission, wanted)
    except Exception as error:
        with db.write() as tx:  # raises MissionNotFound when that is why
            exports.fail(tx, mission.id, wanted.name, wanted.revision, _reason(error))
        if not isinstance(error, OrthostreamError):
            log.exception("export failed", mission=mission.id, export=wanted.name)
        return
    _keep(mission, wanted, key, size, clock)


def _reason(error: Exception) -> str:
    """For people. GDAL and SQLite have many words for a full disk."""
    try:
        if not isinstance(error, OrthostreamError):
            check_room(FOLDER, settings.min_free_bytes)
    except OutOfDisk as full:
        error = full
    return NO_ROOM if isinstance(error, OutOfDisk) else str(error) or type(error).__name__


def _keep(mission: Mission, wanted: Export, key: str, size: int, clock: Stopwatch) -> None:
    """The row names the new file, and the one before goes: of a map that grows they would fill the disk."""
    media_type = MEDIA_TYPES[Path(wanted.name).suffix]
    before, named = wanted.object_key, wanted.object_key
    try:
        with db.write() as tx:
            exports.finish(tx, mission.id, wanted.name, wanted.revision, key, size, media_type)
            row = exports.get(tx, mission.id, wanted.name)
            named = row.object_key if row else None
            clock.spend(tx, mission.id, "export")
    finally:
        for left in {before, key} - {named, None}:
            store.delete(str(left))


def _help(mission: Mission, name: str, clock: Stopwatch) -> None:
    """Draw some pieces of a mosaic that another worker makes, unless that one draws it from other poses."""
    again = _shared(mission, name).lend_a_hand(SLICE_S)
    with db.write() as tx:
        clock.spend(tx, mission.id, "export")
    if again:
        send("export", mission.id, name)


def _made(mission: Mission, wanted: Export) -> tuple[str, int]:
    """The file's key in the store, and its bytes."""
    make = _mosaic if _is_mosaic(wanted.name) else MAKERS.get(wanted.name)
    if make is None:
        raise OrthostreamError(f"{wanted.name} cannot be made by this version.")
    with TemporaryDirectory(dir=FOLDER, prefix=MAKING) as folder:
        path = Path(folder) / wanted.name
        make(path, mission, wanted)
        # Never twice the same: a download that goes on elsewhere in a file must not find another one.
        as_of = f"{wanted.revision}-{wanted.generation}-{wanted.requested_at:.3f}"
        key = f"missions/{mission.id}/exports/{as_of}/{wanted.name}"
        size_bytes = os.stat(path).st_size
        store.put_file(key, path, move=True)
        return key, size_bytes


def _known(mission_id: str) -> tuple[Poses, list[Seen]]:
    with db.read() as tx:
        return poses.load(tx, mission_id), list(frames.sightings(tx, mission_id))


def _placed(mission: Mission) -> tuple[World, list[NamedFrame]]:
    """The world and every posed frame. Raises NothingToMap."""
    known, seen = _known(mission.id)
    if known.world is None or not known.placed:
        raise NothingToMap
    named = [
        NamedFrame(s.name, known.placed[s.frame_id].posed(known.cameras), s.meta.captured_s)
        for s in seen
        if s.frame_id in known.placed
    ]
    return known.world, named


def _is_mosaic(name: str) -> bool:
    return name == MOSAIC or crs_of(name) is not None


def _mosaic(path: Path, mission: Mission, wanted: Export) -> None:
    mosaic = _shared(mission, wanted.name)
    mosaic.plan.checked_crs(crs_of(wanted.name))  # before hours of work
    mosaic.begin()
    for _ in range(settings.workers - 1):
        send("export", mission.id, wanted.name)
    try:
        mosaic.write(path, crs_of(wanted.name))
    finally:
        mosaic.forget()


def _shared(mission: Mission, name: str) -> SharedMosaic:
    """Raises NothingToMap."""
    plan = _plan(mission)
    photos = MissionPhotos(shelf, mission.id, mission.drawn_side)
    pieces = FOLDER / f"{mission.id}-{name}.{plan.digest()}-{mission.drawn_side}"
    return SharedMosaic(plan, photos, pieces, settings.workers, settings.min_free_bytes)


def _plan(mission: Mission) -> MosaicPlan:
    """Raises NothingToMap."""
    world, named = _placed(mission)
    drawn: list[PosedFrame] = [n.posed for n in named]
    params = replace(COG, threads=settings.workers)
    fusion = fusion_of(mission.photo_side, mission.drawn_side)
    return MosaicPlan.of(world, drawn, mission_gsd_m(drawn, mission.drawn_side), params, fusion)


def _poses(path: Path, mission: Mission, _wanted: Export) -> None:
    world, named = _placed(mission)
    path.write_bytes(json_bytes(poses_document(world, named, _waiting(mission.id), mission.submaps)))


def _waiting(mission_id: str) -> list[WaitingFrame]:
    """The frames that wait for a tie."""
    known, seen = _known(mission_id)
    cameras = {s.frame_id: known.cameras.get(s.meta.camera_key) or s.meta.camera() for s in seen}
    return [
        WaitingFrame(s.name, s.frame_id, cameras[s.frame_id], known.waiting[s.frame_id], s.meta.captured_s)
        for s in seen
        if s.frame_id in known.waiting
    ]


def _footprints(path: Path, mission: Mission, _wanted: Export) -> None:
    path.write_bytes(json_bytes(footprints_geojson(*_placed(mission))))


def _route(path: Path, mission: Mission, _wanted: Export) -> None:
    path.write_text(route_csv(*_placed(mission)))


def _report(path: Path, mission: Mission, _wanted: Export) -> None:
    with db.read() as tx:
        survey = surveys.get(tx, mission.id)
        points = surveys.checkpoints(tx, mission.id)
        placed = poses.georeferenced(tx, mission.id) is not None
    if survey is not None and points is not None and placed:
        shown = surveyed.in_mosaic(mission, points, *_placed(mission))
        as_of = {"revision": mission.revision, "generation": mission.generation}
        with db.write() as tx:
            surveys.keep_measured(tx, mission.id, survey.content, shown | as_of)
    with db.read() as tx:
        path.write_bytes(json_bytes(report(tx, mission.id)))


def _stac(path: Path, mission: Mission, _wanted: Export) -> None:
    world, named = _placed(mission)
    grid = _plan(mission).grid
    title = f"{mission.name} (not georeferenced)" if is_local(named) else mission.name
    item = stac_item(mission.id, title, world, named, grid, mission.created_at)
    path.write_bytes(json_bytes(item))


def _tiles(mission: Mission, wanted: Export) -> TileSet:
    """The map at the revision that was asked for, however it has grown since. Raises NothingToMap."""
    with db.read() as tx:
        shown = {TileKey(*t.key): t for t in tiles.at(tx, mission.id, wanted.revision)}
    # What is drawn sharper already lies below some of these only: readers would take the rest for empty.
    finest = mission.zoom or 0
    keys = {k: t.object_key for k, t in shown.items() if t.object_key is not None and k.z <= finest}
    kinds = {key: shown[key].media_type or JPEG for key in keys}
    with db.read() as tx:
        local = poses.georeferenced(tx, mission.id) is False
    title = f"{mission.name} (not georeferenced)" if local else mission.name

    def read(tile: TileKey) -> bytes:
        check_room(FOLDER, settings.min_free_bytes)
        return store.get(keys[tile])

    return TileSet(title, kinds, read)


def _archive(write: Callable[[Path, TileSet], None]) -> Maker:
    return lambda path, mission, wanted: write(path, _tiles(mission, wanted))


def _picture(mission: Mission, wanted: Export) -> Preview:
    shown, world = _tiles(mission, wanted), mission.world
    if world is None:
        raise NothingToMap
    return preview(shown, utm_epsg(world["lat_deg"], world["lon_deg"]))


def _preview_png(path: Path, mission: Mission, wanted: Export) -> None:
    path.write_bytes(_picture(mission, wanted).png())


def _preview_zip(path: Path, mission: Mission, wanted: Export) -> None:
    write_preview(path, _picture(mission, wanted))


MAKERS: dict[str, Maker] = {
    "mosaic.tif": _mosaic,
    "preview.png": _preview_png,
    "preview.zip": _preview_zip,
    "tiles.pmtiles": _archive(write_pmtiles),
    "tiles.mbtiles": _archive(write_mbtiles),
    "tiles.zip": _archive(write_folder),
    "map.kmz": _archive(write_kmz),
    "stac.json": _stac,
    "footprints.geojson": _footprints,
    "poses.json": _poses,
    "route.csv": _route,
    "report.json": _report,
}
