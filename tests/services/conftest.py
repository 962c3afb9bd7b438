"""The backends that the memory runs on, started by the tests themselves, and processes to race on them."""

from __future__ import annotations

import multiprocessing
import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from core.frame import FrameMeta
from services.catalog import frames, leases, missions
from services.database import Database


def _postgres_programs() -> Path | None:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    on_path = shutil.which("initdb")
    return found[-1].parent if found else Path(on_path).parent if on_path else None


POSTGRES = _postgres_programs()
BACKENDS = ["sqlite", "postgres"] if POSTGRES else ["sqlite"]


@pytest.fixture(scope="session")
def migrated_sqlite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sqlite") / "template.db"
    database = Database(f"sqlite:///{path}")
    database.upgrade()
    database.close()
    return path


@pytest.fixture(scope="session")
def postgres_url() -> Iterator[str]:
    """A Postgres server of our own on a unix socket; Postgres refuses to run as root."""
    assert POSTGRES is not None
    as_user = ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []
    folder = Path(tempfile.mkdtemp(prefix="pg-", dir="/tmp"))  # socket paths are short
    if as_user:
        owner = pwd.getpwnam("postgres")
        os.chown(folder, owner.pw_uid, owner.pw_gid)

    def run(*command: str | Path) -> None:
        subprocess.run([*as_user, *command], check=True, stdout=subprocess.DEVNULL, cwd="/")

    options = f"-k {folder} -c listen_addresses='' -c fsync=off -c max_connections=60"
    run(
        POSTGRES / "initdb",
        "-D",
        folder / "data",
        "-U",
        "orthostream",
        "-A",
        "trust",
        "-E",
        "UTF8",
        "--no-locale",
    )
    run(POSTGRES / "pg_ctl", "-D", folder / "data", "-w", "-l", folder / "log", "-o", options, "start")
    url = f"postgresql://orthostream@/postgres?host={folder}"
    try:
        database = Database(url)
        database.upgrade()
        database.close()
        yield url
    finally:
        run(POSTGRES / "pg_ctl", "-D", folder / "data", "-w", "-m", "immediate", "stop")
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(params=BACKENDS)
def db(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """An empty, migrated database; every test that asks for it runs on every backend."""
    if request.param == "sqlite":
        shutil.copy(request.getfixturevalue("migrated_sqlite"), tmp_path / "test.db")
        database = Database(f"sqlite:///{tmp_path / 'test.db'}")
    else:
        database = Database(request.getfixturevalue("postgres_url"))
        with database.write() as tx:
            tx.execute(text("DELETE FROM missions"))
    yield database
    database.close()


@pytest.fixture
def mission_id(db: Database) -> str:
    with db.write() as tx:
        return missions.create(tx, "a flood", now=0.0).id


@pytest.fixture
def race() -> Callable[[int, Callable[[int], Any]], list[Any]]:
    """`race(n, work)`: the results of work(0) … work(n - 1), each in its own process, all let go at once."""
    context = multiprocessing.get_context("fork")

    def child(work: Callable[[int], Any], i: int, gate: Any, pipe: Connection) -> None:
        gate.wait(30)
        try:
            pipe.send((True, work(i)))
        except BaseException as error:
            pipe.send((False, repr(error)))

    def run(n: int, work: Callable[[int], Any]) -> list[Any]:
        gate = context.Barrier(n)
        runners = []
        for i in range(n):
            here, there = context.Pipe(duplex=False)
            process = context.Process(target=child, args=(work, i, gate, there))
            process.start()
            runners.append((process, here))
        answers = [here.recv() for _, here in runners]
        for process, _ in runners:
            process.join(30)
        failed = [result for good, result in answers if not good]
        assert not failed, failed
        return [result for _, result in answers]

    return run


@pytest.fixture
def owner(db: Database, mission_id: str) -> int:
    with db.write() as tx:
        epoch = leases.acquire(tx, mission_id, "me", 3600.0)
    assert epoch is not None
    return epoch


@pytest.fixture
def matched(db: Database, mission_id: str) -> list[str]:
    ids = ["f0", "f1", "f2"]
    with db.write() as tx:
        for frame_id in ids:
            frames.receive(tx, mission_id, frame_id, frame_id, 1, "image/jpeg", 4000, 3000, now=1.0)
            frames.mark_ready(tx, mission_id, frame_id, FrameMeta(4000, 3000), 1.0)
            frames.mark_matched(tx, mission_id, frame_id, 1.0)
    return ids
