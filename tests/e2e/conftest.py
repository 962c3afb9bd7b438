"""A real API process, a mission that grows in its catalog without workers, and a browser to watch it."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from playwright.sync_api import Browser, sync_playwright

from core import pyramid
from core.frame import FrameMeta, GpsFix
from core.geometry import Array, Camera, Pose, World
from core.grid import (
    TILE_PX,
    TileKey,
    ancestors,
    children,
    tile_bounds_lonlat,
    tile_grid,
    tiles_of,
    zoom_resolution_m,
)
from core.terrain import Terrain, TerrainParams
from services.catalog import frames, leases, missions, poses, tiles
from services.catalog.poses import Placed, PoseUpdate
from services.catalog.tiles import Render, TileBox
from services.database import Database
from services.settings import Settings
from services.storage import FolderStore
from services.web_build import ensure_built

CHROMIUM_FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
ZOOM = 19
# On a corner of tiles, so that the made-up countryside's own squares are the map's tiles.
WORLD = World(*reversed(tile_bounds_lonlat(TileKey(ZOOM, 274246, 184260))[::3]), 440.0)
HEIGHT_M = 62.0
STEP_M, LINE_M = 21.0, 34.0
PER_LINE = 7
LINES = 2  # per drone


@dataclass
class Service:
    """One API process and the data it works on."""

    url: str
    data_dir: Path
    db: Database
    store: FolderStore
    process: subprocess.Popen[bytes] | None = None

    @property
    def port(self) -> int:
        return int(self.url.rsplit(":", 1)[1])

    def start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "uvicorn", "--factory", "services.api.app:create_app",
             "--port", str(self.port), "--log-level", "warning"],
            env={**os.environ, "ORTHOSTREAM_DATA_DIR": str(self.data_dir), "ORTHOSTREAM_MIN_FREE_BYTES": "0"},
        )  # fmt: skip
        deadline = time.monotonic() + 60
        while True:
            try:
                urllib.request.urlopen(f"{self.url}/ready", timeout=2)
                return
            except OSError:
                assert time.monotonic() < deadline, "the API does not get ready"
                assert self.process.poll() is None, "the API ended"
                time.sleep(0.05)

    def stop(self, how: signal.Signals = signal.SIGINT) -> float:
        """Seconds until it had ended."""
        assert self.process is not None
        begin = time.monotonic()
        self.process.send_signal(how)
        self.process.wait(20)
        return time.monotonic() - begin


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    ensure_built()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    settings = Settings(data_dir=tmp_path / "data")
    settings.make_dirs()
    db = Database(settings.database_url)
    db.upgrade()
    found = Service(
        f"http://127.0.0.1:{port}", settings.data_dir, db, FolderStore(Path(settings.storage_url))
    )
    found.start()
    try:
        yield found
    finally:
        if found.process and found.process.poll() is None:
            found.process.kill()
            found.process.wait()
        db.close()


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    assert program, "the tests of the page need Chromium: apt-get install chromium"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, headless=True, args=CHROMIUM_FLAGS)
        yield browser
        browser.close()


@dataclass(frozen=True)
class Shot:
    """One photo of the flight: who took it, when, and where it looked straight down from."""

    frame_id: str
    name: str
    meta: FrameMeta
    pose: Pose


CAMERA = Camera(800, 600, 540.0, 399.5, 299.5)


def flight(drones: int = 3) -> list[Shot]:
    """Strips side by side, drone by drone, in the order of capture."""
    shots = []
    for drone in range(drones):
        for k in range(LINES * PER_LINE):
            line, step = divmod(k, PER_LINE)
            along = step if line % 2 == 0 else PER_LINE - 1 - step
            x = (drone * LINES + line - (drones * LINES - 1) / 2) * LINE_M
            y = (along - (PER_LINE - 1) / 2) * STEP_M
            shots.append(_shot(drone, k, x + 2.5 * np.sin(k * 1.7 + drone), y + 2.0 * np.cos(k * 2.3)))
    return sorted(shots, key=lambda s: (s.meta.captured_s or 0, s.name))


def _shot(drone: int, k: int, x: float, y: float) -> Shot:
    name = f"D{drone + 1}_{k:04d}.JPG"
    yaw = 0.05 * np.sin(3.1 * k + drone)
    rotation = np.array([[np.cos(yaw), np.sin(yaw), 0], [np.sin(yaw), -np.cos(yaw), 0], [0, 0, -1.0]])
    center = np.array([x, y, HEIGHT_M])
    lon, lat, alt = WORLD.to_geodetic(center[None])[0]
    meta = FrameMeta(
        width=CAMERA.width, height=CAMERA.height, f_px=CAMERA.f_px, captured_s=1.8e9 + 2 * k + 0.1 * drone,
        gps=GpsFix(float(lat), float(lon), float(alt)), drone=f"Drone {drone + 1}", body="simulated",
    )  # fmt: skip
    frame_id = hashlib.sha256(name.encode()).hexdigest()[:32]
    return Shot(frame_id, name, meta, Pose(rotation, center, 0.0))


@pytest.fixture
def shots() -> list[Shot]:
    return flight()


@dataclass
class Mission:
    """A mission whose rows and tiles the test makes itself, as the workers would."""

    service: Service
    mission_id: str
    posed: list[Shot] = field(default_factory=list)
    epoch: int = 0
    pictures: dict[TileKey, NDArray[np.uint8]] = field(default_factory=dict)
    changed: set[TileKey] = field(default_factory=set)  # by the last publication
    light: float = 1.0

    @property
    def url(self) -> str:
        return f"{self.service.url}/missions/{self.mission_id}"

    def receive(self, shots: Sequence[Shot]) -> None:
        for shot in shots:
            with self.service.db.write() as tx:
                frames.receive(tx, self.mission_id, shot.frame_id, shot.name, 5_000_000, "image/jpeg",
                               CAMERA.width, CAMERA.height)  # fmt: skip
                frames.mark_ready(tx, self.mission_id, shot.frame_id, shot.meta)
                frames.mark_matched(tx, self.mission_id, shot.frame_id)

    def save(self, change: PoseUpdate) -> None:
        with self.service.db.write() as tx:
            if not self.epoch:
                self.epoch = leases.acquire(tx, self.mission_id, "test", 3600) or 0
            poses.save(tx, self.mission_id, self.epoch, change)

    def pose(self, shots: Sequence[Shot]) -> None:
        placed = [Placed(s.frame_id, "simulated", s.pose, _box(s)) for s in shots]
        dirty = {tuple(t): 0 for s in shots for t in _under(s)}
        self.save(
            PoseUpdate(placed=placed, dirty=dirty, cameras={"simulated": CAMERA}, world=WORLD, zoom=ZOOM)
        )
        self.posed += shots

    def publish(self) -> int:
        """Draw every dirty tile and its overviews, store them, flip the revision."""
        with self.service.db.write() as tx:
            dirty = tiles.claim_dirty(tx, self.mission_id, 10_000, 60)
            revision = missions.get(tx, self.mission_id).revision
        native = {TileKey(d.z, d.x, d.y): d.generation for d in dirty}
        newest = max(native.values())
        for key in native:
            self.pictures[key] = (_picture(key, self.posed) * [*[self.light] * 3, 1]).astype(np.uint8)
        above = ancestors(native, ZOOM - 8)
        for key in above:
            self.pictures[key] = pyramid.reduce([self.pictures.get(c) for c in children(key)])
        self.changed = {*native, *above}
        rendered = [self._store(key, generation, revision + 1) for key, generation in native.items()]
        changes = rendered + [self._store(key, newest, revision + 1) for key in above]
        with self.service.db.write() as tx:
            tiles.record_renders(tx, self.mission_id, rendered)
            return tiles.publish(tx, self.mission_id, revision, changes, rendered)

    def fly(self, shots: Sequence[Shot]) -> int:
        """Receive, pose and publish."""
        self.receive(shots)
        self.pose(shots)
        return self.publish()

    def _store(self, key: TileKey, generation: int, revision: int) -> Render:
        encoded = pyramid.encode(self.pictures[key])
        if encoded is None:
            return Render(tuple(key), generation)
        data, media_type = encoded
        object_key = f"missions/{self.mission_id}/tiles/{key.z}/{key.x}/{key.y}/{revision}"
        self.service.store.put(object_key, data)
        etag = hashlib.sha256(data).hexdigest()[:16]
        return Render(tuple(key), generation, object_key, etag, media_type, len(data))


@pytest.fixture
def mission(service: Service) -> Mission:
    with service.db.write() as tx:
        return Mission(service, missions.create(tx, "River bank east").id)


def _under(shot: Shot) -> set[TileKey]:
    return tiles_of(WORLD, shot.pose.footprint(CAMERA), 0.0, ZOOM)


def _box(shot: Shot) -> TileBox:
    keys = _under(shot)
    xs, ys = [k.x for k in keys], [k.y for k in keys]
    return TileBox(ZOOM, min(xs), min(ys), max(xs), max(ys))


_TERRAIN = Terrain(TerrainParams(seed=5))


def _picture(key: TileKey, shots: Sequence[Shot]) -> NDArray[np.uint8]:
    """One native tile of the made-up countryside, transparent where nobody has looked yet."""
    grid = tile_grid(key)
    mask = Image.new("L", (TILE_PX, TILE_PX))
    for shot in shots:
        cols, rows = _pixels(shot.pose.footprint(CAMERA))
        ImageDraw.Draw(mask).polygon(list(zip(cols - grid.col0, rows - grid.row0, strict=True)), fill=255)
    block = _ground(key.x // 2, key.y // 2)
    row, col = key.y % 2 * TILE_PX, key.x % 2 * TILE_PX
    return np.dstack((block[row : row + TILE_PX, col : col + TILE_PX], np.asarray(mask)))


@cache
def _ground(x: int, y: int) -> NDArray[np.uint8]:
    """A square of 2 × 2 native tiles of the countryside."""
    col0, row0 = (round(float(v[0]) / TILE_PX) for v in _pixels(np.zeros((1, 2))))
    column, row = (x * 2 - col0) * TILE_PX, (y * 2 - row0) * TILE_PX
    gsd_m = zoom_resolution_m(ZOOM, WORLD.lat_deg)
    return _TERRAIN.raster(column, row, 2 * TILE_PX, 2 * TILE_PX, gsd_m)


def _pixels(xy: Array) -> tuple[Array, Array]:
    return tile_grid(TileKey(ZOOM, 0, 0)).from_world(WORLD, xy, 0.0)
