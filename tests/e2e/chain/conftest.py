"""A small simulated flight, the map that the oracle makes of it, and whole stacks to make it again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pytest

from core.mosaic import Mosaic, build
from core.simulation import FlightParams
from services.catalog import missions, tiles
from services.cli.client import Client
from services.cli.flight import find_photos
from services.database import Database
from services.processes import running_url
from services.storage import FolderStore
from workers.simulate import simulate

# Whatever waits for something lost is to notice soon: these tests lose things all the time.
IMPATIENT = {
    "ORTHOSTREAM_LEASE_TTL_S": "1.5",
    "ORTHOSTREAM_STALLED_AFTER_S": "2",
    "ORTHOSTREAM_SWEEP_S": "0.5",
    "ORTHOSTREAM_MIN_FREE_BYTES": "0",
}


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of 14 photos by two drones."""
    out = tmp_path_factory.mktemp("flight")
    params = FlightParams(frames=14, drones=2, width_px=640, height_px=480, gps_noise_m=1.0, seed=4)
    simulate(params, out, jobs=2, truth=False)
    return out / "images"


@pytest.fixture(scope="session")
def oracle(flight: Path) -> Mosaic:
    """What every stack must come to."""
    found = build([(p.name, p.path.read_bytes()) for p in find_photos(flight)])
    assert len(found.layout.frames) == 14
    return found


@dataclass
class Stack:
    """`orthostream serve` on a folder of its own."""

    data_dir: Path
    workers: int = 2
    process: subprocess.Popen[bytes] | None = None
    ever: set[int] = field(default_factory=set)

    def start(self) -> Stack:
        """Returns when the API is ready."""
        command = [sys.executable, "-m", "services.cli", "serve", "--data-dir", str(self.data_dir)]
        with (self.data_dir.parent / "serve.log").open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "--port", "0", "--workers", str(self.workers)],
                env={**os.environ, **IMPATIENT},
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        wait_for(lambda: running_url(self.data_dir, self.pid) is not None, 60, "the stack gets ready")
        return self

    @property
    def pid(self) -> int:
        assert self.process is not None
        return self.process.pid

    @property
    def url(self) -> str:
        url = running_url(self.data_dir)
        assert url is not None
        return url

    def members(self) -> dict[str, list[psutil.Process]]:
        """The tree's processes by what they are."""
        found: dict[str, list[psutil.Process]] = {}
        for child in psutil.Process(self.pid).children():
            with suppress(psutil.NoSuchProcess):  # killed a moment ago, its parent has yet to notice
                line = " ".join(child.cmdline())
                words = {
                    "valkey": "broker",
                    "uvicorn": "api",
                    "-Q work": "worker",
                    "-Q sequence": "sequencer",
                }
                name = next((n for word, n in words.items() if word in line), "other")
                found[name] = [child]
                if name in ("worker", "sequencer"):
                    found[f"{name}'s pool"] = child.children()
        self.ever |= {p.pid for ps in found.values() for p in ps}
        return found

    def stop(self, how: signal.Signals = signal.SIGTERM) -> float:
        """Seconds until the root had ended."""
        assert self.process is not None
        self.members()
        begin = time.monotonic()
        self.process.send_signal(how)
        self.process.wait(20)
        return time.monotonic() - begin

    def nobody_left(self) -> bool:
        """Whether all processes that were ever seen are gone."""
        return not any(_alive(pid) for pid in self.ever)

    def tiles(self, mission_id: str) -> dict[tuple[int, int, int], bytes]:
        """Every tile that shows something now, from the store."""
        db = Database(f"sqlite:///{self.data_dir / 'orthostream.db'}")
        store = FolderStore(self.data_dir / "objects")
        with db.read() as tx:
            shown = tiles.current(tx, mission_id, tiles.keys(tx, mission_id))
        db.close()
        return {k: store.get(t.object_key) for k, t in shown.items() if t.object_key is not None}

    def mission_ids(self) -> list[str]:
        """Of every mission there is."""
        db = Database(f"sqlite:///{self.data_dir / 'orthostream.db'}")
        with db.read() as tx:
            found = [m.id for m in missions.list(tx)]
        db.close()
        return found


def _alive(pid: int) -> bool:
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def wait_for(condition: Callable[[], bool], seconds: float, what: str) -> None:
    give_up_at = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < give_up_at, f"waited {seconds} s in vain until {what}"
        time.sleep(0.1)


@pytest.fixture
def new_stack(tmp_path: Path) -> Iterator[Callable[..., Stack]]:
    """Makes stacks; what still runs at the end is killed."""
    made: list[Stack] = []

    def make(workers: int = 2) -> Stack:
        made.append(Stack(tmp_path / f"stack-{len(made)}" / "data", workers))
        made[-1].data_dir.mkdir(parents=True)
        return made[-1]

    yield make
    for stack in made:
        if stack.process is not None and stack.process.poll() is None:
            stack.process.kill()
            stack.process.wait()


@pytest.fixture
def finish() -> Callable[[Client, str], None]:
    """Finalises a mission and waits for it."""

    def run(client: Client, mission_id: str) -> None:
        client.finalise(mission_id)
        wait_for(lambda: client.progress(mission_id)["state"] == "final", 60, "the mission is final")

    return run
