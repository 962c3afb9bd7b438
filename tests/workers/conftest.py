"""The stages as plain functions in this process: a queue that the test empties, and a real catalog."""

from __future__ import annotations

import os
import random
from dataclasses import dataclass, field
from typing import Any

import pytest

from core.mosaic import Mosaic, build, frame_id_of
from core.photo import probe
from core.simulation import FlightParams
from services.catalog import exports, frames, missions, tiles
from services.settings import get_settings
from services.tables import Export
from workers.simulate import simulate

STAGES = ("ingest", "match", "sequence", "fuse", "publish", "export")
Photos = list[tuple[str, bytes]]


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Photos:
    """Nine photos of one drone, in capture order."""
    out = tmp_path_factory.mktemp("flight")
    params = FlightParams(frames=9, drones=1, width_px=640, height_px=480, gps_noise_m=1.0, seed=7)
    simulate(params, out, jobs=2, truth=False)
    return [(p.name, p.read_bytes()) for p in sorted((out / "images").iterdir())]


@pytest.fixture(scope="session")
def oracle(photos: Photos) -> Mosaic:
    """What the stages must come to."""
    return build(photos)


@pytest.fixture(scope="session")
def modules(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The stages' modules, on a data folder of their own; they read their settings when they are imported."""
    os.environ["ORTHOSTREAM_DATA_DIR"] = str(tmp_path_factory.mktemp("data"))
    os.environ["ORTHOSTREAM_BROKER_URL"] = "memory://"
    os.environ["ORTHOSTREAM_MIN_FREE_BYTES"] = "0"
    get_settings.cache_clear()
    from workers import app, export, fuse, ingest, match, publish, sequence

    app.settings.make_dirs()
    app.db.upgrade()
    for name in ("DATA_DIR", "BROKER_URL", "MIN_FREE_BYTES"):
        del os.environ[f"ORTHOSTREAM_{name}"]
    get_settings.cache_clear()
    found = (ingest, match, sequence, fuse, publish, export)
    return dict(zip(STAGES, found, strict=True)) | {"app": app}


@dataclass
class Bench:
    """One mission; `queue` holds the wake-ups that were sent and not handled yet."""

    modules: dict[str, Any]
    mission_id: str
    queue: list[tuple[str, tuple[Any, ...]]] = field(default_factory=list)

    @property
    def db(self) -> Any:
        return self.modules["app"].db

    def send(self, name: str, *args: Any, priority: int | None = None) -> bool:
        self.queue.append((name, args))
        return True

    def upload(self, photos: Photos) -> None:
        store = self.modules["app"].store
        for name, data in photos:
            frame_id, header = frame_id_of(data), probe(data)
            store.put(f"missions/{self.mission_id}/photos/{frame_id}", data)
            with self.db.write() as tx:
                frames.receive(
                    tx, self.mission_id, frame_id, name, len(data), header.media_type, *_size(header)
                )
            self.send("ingest", self.mission_id, frame_id)

    def handle(self, name: str, *args: Any) -> None:
        getattr(self.modules[name], name)(*args)

    def drain(self, chance: random.Random | None = None, times: int = 1) -> int:
        """Handles wake-ups until none is left: in order, or shuffled; each so many times. Their number."""
        count = 0
        while self.queue:
            index = chance.randrange(len(self.queue)) if chance else 0
            name, args = self.queue.pop(index)
            for _ in range(times):
                self.handle(name, *args)
            count += 1
            assert count < 3000, "the stages wake each other for ever"
        return count

    def finalise(self) -> None:
        with self.db.write() as tx:
            missions.request_finalise(tx, self.mission_id)
        self.send("sequence", self.mission_id)

    def export(self, name: str) -> Export:
        """Asked for, made if it has to be, and as it is then."""
        with self.db.write() as tx:
            exports.request(tx, self.mission_id, name)
        self.handle("export", self.mission_id, name)
        with self.db.read() as tx:
            row = exports.get(tx, self.mission_id, name)
        assert row is not None
        return row

    @property
    def state(self) -> str:
        with self.db.read() as tx:
            return str(missions.get(tx, self.mission_id).state)

    def frame_states(self) -> dict[str, str]:
        with self.db.read() as tx:
            return {f.name: f.state for f in frames.list(tx, self.mission_id)}

    def tiles(self) -> dict[tuple[int, int, int], bytes]:
        store = self.modules["app"].store
        with self.db.read() as tx:
            shown = tiles.current(tx, self.mission_id, tiles.keys(tx, self.mission_id))
        return {k: store.get(t.object_key) for k, t in shown.items() if t.object_key is not None}


def _size(header: Any) -> tuple[int, int]:
    return header.width, header.height


@pytest.fixture
def bench(modules: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A new mission, mode visual."""
    with modules["app"].db.write() as tx:
        found = Bench(modules, missions.create(tx, "bench").id)
    for name in STAGES:
        for how in ("send", "go_on"):
            monkeypatch.setattr(modules[name], how, found.send, raising=False)
    return found


def oracle_tiles(oracle: Mosaic) -> dict[tuple[int, int, int], bytes]:
    return {tuple(k): v for k, v in oracle.tiles.items()}  # type: ignore[misc]


@pytest.fixture
def expected(oracle: Mosaic) -> dict[tuple[int, int, int], bytes]:
    """The oracle's tiles."""
    return oracle_tiles(oracle)
