"""A finished (or growing) map → the files that other programs read."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from core.archives import TileSet, write_folder, write_mbtiles, write_pmtiles
from core.cog import DEFAULT as MOSAIC
from core.cog import mosaic_grid
from core.coverage import mission_gsd_m
from core.errors import NothingToMap, OrthostreamError
from core.exports import (
    NamedFrame,
    WaitingFrame,
    footprints_geojson,
    is_local,
    json_bytes,
    poses_document,
    route_csv,
    write_mosaic,
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
from services.export_names import crs_of
from services.report import report
from services.tables import Export, Mission
from workers import surveyed
from workers.app import Stopwatch, db, log, settings, stage, store
from workers.photos import MissionPhotos, shelf

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

Maker = Callable[[Path, Mission, Export], None]


@stage("export")
def export(mission_id: str, name: str) -> None:
    """Wanted → ready or failed."""
    with _alone(mission_id, name) as alone:
        if not alone:
            return  # a large mosaic takes longer than its wake-up is patient
        with db.read() as tx:
            wanted = exports.get(tx, mission_id, name)
            mission = missions.get(tx, mission_id)
        if wanted is None or wanted.state != "wanted":
            return
        clock = Stopwatch()
        try:
            key, size = _made(mission, wanted)
        except Exception as error:
            if not isinstance(error, OrthostreamError):
                log.exception("export failed", mission=mission_id, export=name)
            with db.write() as tx:
                exports.fail(tx, mission_id, name, wanted.revision, str(error) or type(error).__name__)
            return
        with db.write() as tx:
            media_type = MEDIA_TYPES[Path(name).suffix]
            exports.finish(tx, mission_id, name, wanted.revision, key, size, media_type)
            clock.spend(tx, mission_id, "export")


@contextmanager
def _alone(mission_id: str, name: str) -> Iterator[bool]:
    """Whether nobody else on this machine makes this file right now."""
    folder = settings.data_dir / "exports"
    folder.mkdir(exist_ok=True)
    with (folder / f"{mission_id}-{name}.lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True


def _made(mission: Mission, wanted: Export) -> tuple[str, int]:
    """The file's key in the store, and its bytes."""
    make = _mosaic if crs_of(wanted.name) else MAKERS.get(wanted.name)
    if make is None:
        raise OrthostreamError(f"{wanted.name} cannot be made by this version.")
    with TemporaryDirectory(dir=settings.data_dir / "exports", prefix="making-") as folder:
        path = Path(folder) / wanted.name
        make(path, mission, wanted)
        key = f"missions/{mission.id}/exports/{wanted.revision}-{wanted.generation}/{wanted.name}"
        store.put_file(key, path)
        return key, os.stat(path).st_size


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


def _mosaic(path: Path, mission: Mission, wanted: Export) -> None:
    world, named = _placed(mission)
    drawn: list[PosedFrame] = [n.posed for n in named]
    gsd_m = mission_gsd_m(drawn, mission.drawn_side)
    photos = MissionPhotos(shelf, mission.id, mission.drawn_side)
    write_mosaic(path, world, drawn, photos, gsd_m, crs_of(wanted.name))


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
    drawn: list[PosedFrame] = [n.posed for n in named]
    gsd_m = mission_gsd_m(drawn, mission.drawn_side)
    if gsd_m is None:
        raise NothingToMap
    grid = mosaic_grid(world, drawn, gsd_m, MOSAIC.max_pixels)
    title = f"{mission.name} (not georeferenced)" if is_local(named) else mission.name
    item = stac_item(mission.id, title, world, named, grid, mission.created_at)
    path.write_bytes(json_bytes(item))


def _tiles(mission: Mission, wanted: Export) -> TileSet:
    """The map at the revision that was asked for, however it has grown since. Raises NothingToMap."""
    with db.read() as tx:
        shown = {TileKey(*t.key): t for t in tiles.at(tx, mission.id, wanted.revision)}
    keys = {key: t.object_key for key, t in shown.items() if t.object_key is not None}
    kinds = {key: t.media_type or JPEG for key, t in shown.items()}
    with db.read() as tx:
        local = poses.georeferenced(tx, mission.id) is False
    title = f"{mission.name} (not georeferenced)" if local else mission.name
    return TileSet(title, kinds, lambda tile: store.get(keys[tile]))


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
