"""The laws of transactions, the same on every backend."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import select, text
from sqlalchemy.exc import DBAPIError

from services.catalog import missions
from services.catalog.rows import lock
from services.database import Database
from services.tables import Base, Mission

Race = Callable[[int, Callable[[int], Any]], list[Any]]


class TestDatabase:
    def test_the_migrations_make_exactly_the_tables(self, db: Database) -> None:
        with db.engine.connect() as connection:
            context = MigrationContext.configure(connection, opts={"compare_type": True})
            assert compare_metadata(context, Base.metadata) == []

    def test_upgrading_again_keeps_what_is_there(self, db: Database, mission_id: str) -> None:
        db.upgrade()
        with db.read() as tx:
            assert missions.get(tx, mission_id).name == "a flood"

    def test_an_exception_rolls_everything_back(self, db: Database, mission_id: str) -> None:
        def fail() -> None:
            with db.write() as tx:
                lock(tx, mission_id).name = "gone"
                tx.flush()
                raise RuntimeError

        with pytest.raises(RuntimeError):
            fail()
        with db.read() as tx:
            assert missions.get(tx, mission_id).name == "a flood"

    def test_a_reader_cannot_write(self, db: Database, mission_id: str) -> None:
        with pytest.raises(DBAPIError), db.read() as tx:
            tx.execute(text("UPDATE missions SET name = 'gone'"))
        with db.write() as tx:  # the same connection writes again
            lock(tx, mission_id).name = "renamed"

    def test_a_reader_sees_one_moment(self, db: Database, mission_id: str) -> None:
        name = select(Mission.name)
        with db.read() as reader:
            before = reader.scalar(name)
            with db.write() as tx:
                lock(tx, mission_id).name = "later"
            assert reader.scalar(name) == before == "a flood"
        with db.read() as reader:
            assert reader.scalar(name) == "later"

    def test_read_modify_write_loses_nothing(self, db: Database, mission_id: str, race: Race) -> None:
        def count(_: int) -> None:
            for _ in range(100):
                with db.write() as tx:
                    row = lock(tx, mission_id)
                    row.solved_frames = row.solved_frames + 1

        race(4, count)
        with db.read() as tx:
            assert missions.get(tx, mission_id).solved_frames == 400

    def test_the_parent_keeps_working_after_its_children(
        self, db: Database, mission_id: str, race: Race
    ) -> None:
        with db.read() as tx:  # a connection is in the pool when the children are forked
            missions.get(tx, mission_id)

        def read(_: int) -> str:
            with db.read() as tx:
                return missions.get(tx, mission_id).name

        assert race(3, read) == ["a flood"] * 3
        assert read(0) == "a flood"

    def test_rows_can_be_read_after_the_transaction(self, db: Database, mission_id: str) -> None:
        with db.write() as tx:
            row = lock(tx, mission_id)
            row.zoom = 19
        assert (row.id, row.zoom, row.cameras) == (mission_id, 19, {})

    def test_a_commit_waits_for_the_disk_unless_told_otherwise(self, db: Database, mission_id: str) -> None:
        question = "PRAGMA synchronous" if db.is_sqlite else "SHOW synchronous_commit"
        for durable, answer in ((True, (2, "on")), (False, (1, "off")), (True, (2, "on"))):
            with db.write(durable) as tx:
                lock(tx, mission_id).name = f"{durable}"
                assert tx.scalar(text(question)) in answer
            with pytest.raises(DBAPIError), db.read() as tx:  # on the same connection
                tx.execute(text("DELETE FROM missions"))
            with db.read() as tx:
                assert missions.get(tx, mission_id).name == f"{durable}"

    def test_nan_is_refused_rather_than_stored(self, db: Database, mission_id: str) -> None:
        with pytest.raises(Exception, match="not JSON compliant"), db.write() as tx:
            lock(tx, mission_id).world = {"lat_deg": float("nan")}


def test_many_processes_may_create_the_same_file_at_once(tmp_path: Path, race: Race) -> None:
    def start(_: int) -> int:
        database = Database(f"sqlite:///{tmp_path / 'new' / 'one.db'}")
        database.upgrade()
        with database.write() as tx:
            missions.create(tx, "m")
        with database.read() as tx:
            return len(missions.list(tx))

    assert max(race(6, start)) == 6


def test_more_threads_than_pooled_connections_all_get_their_turn(db: Database, mission_id: str) -> None:
    # As many as the API's thread pool has.
    done = []

    def work() -> None:
        with db.write() as tx:
            missions.spend(tx, mission_id, "api", 1.0)
        done.append(True)

    threads = [threading.Thread(target=work) for _ in range(40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    with db.read() as tx:
        assert missions.get(tx, mission_id).stage_seconds == {"api": 40.0}
    assert len(done) == 40


def test_a_writer_that_is_killed_holds_nobody_up(db: Database, mission_id: str) -> None:
    def die() -> None:
        with db.write() as tx:
            lock(tx, mission_id).name = "never"
            tx.flush()
            os.kill(os.getpid(), signal.SIGKILL)

    process = multiprocessing.get_context("fork").Process(target=die)
    process.start()
    process.join(30)
    assert process.exitcode == -signal.SIGKILL
    with db.write() as tx:
        assert lock(tx, mission_id).name == "a flood"


def test_a_writer_inside_a_writer_is_told_rather_than_left_waiting(migrated_sqlite: Path) -> None:
    database = Database(f"sqlite:///{migrated_sqlite}")

    def nest() -> None:
        with database.write(), database.write():
            pass

    with pytest.raises(RuntimeError, match="wait for itself"):
        nest()
    with database.write() as tx:  # and the turn was given back
        assert missions.list(tx) == []


def test_sqlite_is_concurrent_and_checks_what_rows_refer_to(migrated_sqlite: Path) -> None:
    database = Database(f"sqlite:///{migrated_sqlite}")
    with database.read() as tx:
        pragmas = {name: tx.scalar(text(f"PRAGMA {name}")) for name in ("journal_mode", "foreign_keys")}
    assert pragmas == {"journal_mode": "wal", "foreign_keys": 1}


def test_a_plain_postgres_url_means_the_installed_driver() -> None:
    assert Database("postgresql://u@h/d").url.drivername == "postgresql+psycopg"
