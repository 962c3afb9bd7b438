"""One database, two kinds of transaction: `write()` and `read()`; SQLite and Postgres behave the same."""

from __future__ import annotations

import fcntl
import json
import os
import sqlite3
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, create_engine, event, make_url, text
from sqlalchemy.engine import URL
from sqlalchemy.orm import Session

_BUSY_TIMEOUT_MS = 30_000
_MIGRATION_LOCK = 7_041_776  # any number, the same for everybody who migrates this schema

_READ, _DURABLE, _HASTY = "read", "durable", "hasty"
_PRAGMAS = {
    _READ: ("PRAGMA query_only = 1",),
    _DURABLE: ("PRAGMA query_only = 0", "PRAGMA synchronous = FULL"),
    _HASTY: ("PRAGMA query_only = 0", "PRAGMA synchronous = NORMAL"),
}

# NaN is no JSON: SQLite would store it and Postgres refuse it, so both refuse.
_to_json = partial(json.dumps, allow_nan=False, separators=(",", ":"))


class Database:
    """The catalog's database. Safe to share between threads and to inherit across a fork."""

    def __init__(self, url: str) -> None:
        """`url`: SQLAlchemy's form; postgresql:// means psycopg 3."""
        self.url = _normalised(url)
        self.engine = _sqlite_engine(self.url) if self.is_sqlite else _postgres_engine(self.url)
        self._writer = self.engine.execution_options(orthostream_write=_DURABLE)
        self._hasty_writer = self.engine.execution_options(orthostream_write=_HASTY)
        # One connection for both kinds would compile all of its statements anew at every change.
        self._reads = _sqlite_engine(self.url) if self._is_file else self.engine
        self._reader = (
            self._reads
            if self.is_sqlite
            else self.engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
        )
        self._turn: AbstractContextManager[None] = (
            _Turn(f"{self.url.database}.lock") if self._is_file else nullcontext()
        )
        for engine in {self.engine, self._reads}:
            _forget_connections_in_children(engine)

    @property
    def _is_file(self) -> bool:
        return self.is_sqlite and self.url.database not in (None, "", ":memory:")

    @property
    def is_sqlite(self) -> bool:
        """Whether one file holds everything and one writer at a time is all there is."""
        return self.url.get_backend_name() == "sqlite"

    @contextmanager
    def write(self, durable: bool = True) -> Iterator[Session]:
        """A transaction that may write: commits at the end of the block, rolls back on any exception.

        Not `durable`: a power cut may take it back, as long as no durable one has followed it; nothing else
        can. For what is done again when it is not there.
        """
        writer = self._writer if durable else self._hasty_writer
        with self._turn, Session(writer, expire_on_commit=False) as tx, tx.begin():
            if not durable and not self.is_sqlite:
                tx.execute(text("SET LOCAL synchronous_commit TO off"))
            yield tx

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A read-only transaction over one snapshot; a write inside it fails."""
        with Session(self._reader, expire_on_commit=False, autoflush=False) as tx:
            yield tx

    def upgrade(self) -> None:
        """Bring the schema to the newest revision; any number of processes may do it at the same time."""
        from alembic import command  # 0.2 s to import, and only this needs it
        from alembic.config import Config

        config = Config()
        config.set_main_option("script_location", "migrations:")
        config.set_main_option("path_separator", "os")
        with self._writer.begin() as connection:
            if not self.is_sqlite:
                connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _MIGRATION_LOCK})
            config.attributes["connection"] = connection
            command.upgrade(config, "head")

    def ping(self) -> None:
        """Raise SQLAlchemy's own error when the database or its schema is not there."""
        with self.read() as tx:
            tx.execute(text("SELECT 1 FROM missions LIMIT 1"))

    def close(self) -> None:
        """Close the pooled connections."""
        for engine in {self.engine, self._reads}:
            engine.dispose()


class _Turn:
    """Writers of one SQLite file queue here: the kernel wakes the next one at once.

    SQLite's own way is to look again every now and then, up to 100 ms later, which leaves some waiting for
    a second while others pass. The lock goes with its process, however that ends.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._held = threading.local()

    def __enter__(self) -> None:
        if getattr(self._held, "handle", None) is not None:
            raise RuntimeError("a write transaction inside another one would wait for itself")
        handle = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(handle, fcntl.LOCK_EX)
        self._held.handle = handle

    def __exit__(self, *_: object) -> None:
        handle, self._held.handle = self._held.handle, None
        fcntl.flock(handle, fcntl.LOCK_UN)  # a child forked meanwhile may still have the file open
        os.close(handle)


def _normalised(url: str) -> URL:
    parsed = make_url(url)
    if parsed.drivername in ("postgres", "postgresql"):
        return parsed.set(drivername="postgresql+psycopg")
    return parsed


def _postgres_engine(url: URL) -> Engine:
    return create_engine(
        url,
        pool_size=5,
        max_overflow=10,
        pool_pre_ping=True,
        json_serializer=_to_json,
        connect_args={"connect_timeout": 10},
    )


def _sqlite_engine(url: URL) -> Engine:
    if url.database not in (None, "", ":memory:"):
        Path(url.database).parent.mkdir(parents=True, exist_ok=True)
    engine = create_engine(
        url,
        pool_size=8,
        max_overflow=56,  # the API's thread pool is 40 wide; a connection costs a file handle
        json_serializer=_to_json,
        connect_args={"timeout": _BUSY_TIMEOUT_MS / 1000},
    )
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _prepare_sqlite(connection: Any, _record: object) -> None:
    connection.isolation_level = None  # the driver must not begin transactions behind our back
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout = {_BUSY_TIMEOUT_MS}")
    _enter_wal(cursor)
    cursor.execute("PRAGMA foreign_keys = ON")
    cursor.close()


def _enter_wal(cursor: Any) -> None:
    # The change of mode ignores busy_timeout while another process is changing it too.
    deadline = time.monotonic() + _BUSY_TIMEOUT_MS / 1000
    while True:
        try:
            cursor.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)


def _begin_sqlite(connection: Connection) -> None:
    # A deferred transaction that reads, then writes, loses updates of others without an error: writers
    # take the lock first.
    kind = connection.get_execution_options().get("orthostream_write", _READ)
    if connection.info.get("orthostream_write") != kind:
        for pragma in _PRAGMAS[kind]:
            connection.exec_driver_sql(pragma)
        connection.info["orthostream_write"] = kind
    connection.exec_driver_sql("BEGIN" if kind == _READ else "BEGIN IMMEDIATE")


def _forget_connections_in_children(engine: Engine) -> None:
    # A connection used on both sides of a fork corrupts both; the child opens its own.
    reference = weakref.ref(engine)

    def forget() -> None:
        inherited = reference()
        if inherited is not None:
            inherited.dispose(close=False)

    os.register_at_fork(after_in_child=forget)
