"""The event stream of a real API process: live, resumable, and no obstacle to stopping."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import httpx
import pytest

from services.catalog import missions

if TYPE_CHECKING:
    from conftest import Mission, Service, Shot

Event = tuple[str, int | None, Any]


@contextmanager
def listening(url: str, headers: dict[str, str] | None = None, **query: int) -> Iterator[Iterator[Event]]:
    """The events of a stream as (kind, number, payload)."""
    with httpx.stream("GET", f"{url}/events", params=query, headers=headers or {}, timeout=30) as answer:
        assert answer.status_code == 200
        assert answer.headers["content-type"].startswith("text/event-stream")
        yield _events(answer.iter_lines())


def _events(lines: Iterator[str]) -> Iterator[Event]:
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(": ")
        if line:
            fields[name] = value
        elif "event" in fields:
            number = int(fields["id"]) if "id" in fields else None
            yield fields["event"], number, json.loads(fields["data"])
            fields = {}


def api_url(mission: Mission) -> str:
    return f"{mission.service.url}/api/v1/missions/{mission.mission_id}"


def until(events: Iterator[Event], kind: str) -> list[Event]:
    """The events up to the first of this kind."""
    seen = []
    for event in events:
        seen.append(event)
        if event[0] == kind:
            return seen
    pytest.fail(f"the stream ended without {kind!r}")


def test_a_viewer_hears_of_frames_tiles_and_progress(mission: Mission, shots: list[Shot]) -> None:
    with listening(api_url(mission)) as events:
        assert next(events)[0] == "heartbeat"
        begin = time.monotonic()
        mission.receive(shots[:1])
        first = until(events, "frame")[-1]
        assert time.monotonic() - begin < 2
        assert first[2]["state"] == "received"
        mission.pose(shots[:1])
        revision = mission.publish()
        kind, number, said = until(events, "tiles")[-1]
        assert (kind, said["revision"]) == ("tiles", revision)
        assert list(next(iter(mission.pictures))) in said["tiles"]
        assert number is not None
        progress = until(events, "progress")[-1][2]
        while progress["counts"]["fused"] == 0:
            progress = until(events, "progress")[-1][2]
        assert (progress["total"], progress["revision"]) == (1, 1)


def test_a_stream_goes_on_where_it_broke_off(mission: Mission, shots: list[Shot]) -> None:
    mission.receive(shots[:4])  # three events each
    with listening(api_url(mission), after=0) as events:
        seen = [e[1] for e in (next(events) for _ in range(14)) if e[1]]
    assert seen[:5] == [1, 2, 3, 4, 5]
    mission.receive(shots[4:6])
    with listening(api_url(mission), {"Last-Event-ID": "5"}) as events:
        rest = [e[1] for e in (next(events) for _ in range(17)) if e[1]]
    assert rest[:13] == list(range(6, 19))
    with listening(api_url(mission), after=10**9) as events:
        mission.receive(shots[6:7])
        assert until(events, "frame")[-1][1] == 19


def test_long_ago_is_read_page_by_page(mission: Mission) -> None:
    from services.catalog import events as diary

    with mission.service.db.write() as tx:
        for i in range(1700):
            diary.append(tx, mission.mission_id, "export", {"i": i})
    with listening(api_url(mission), after=0) as events:
        numbered = (e for e in events if e[1])
        assert [next(numbered)[1] for _ in range(1700)] == list(range(1, 1701))


def test_many_viewers_hear_the_same(mission: Mission, shots: list[Shot]) -> None:
    from contextlib import ExitStack

    with ExitStack() as stack:
        streams = [stack.enter_context(listening(api_url(mission))) for _ in range(12)]
        mission.receive(shots[:2])
        for events in streams:
            numbered = (e for e in events if e[1])
            assert [next(numbered)[1] for _ in range(6)] == [1, 2, 3, 4, 5, 6]


def test_the_stream_of_a_deleted_mission_ends(mission: Mission) -> None:
    with listening(api_url(mission)) as events:
        next(events)
        assert httpx.delete(api_url(mission)).status_code == 204
        rest = list(events)
    assert ("mission", {"state": "deleting"}) in [(kind, said) for kind, _, said in rest]
    assert httpx.get(f"{api_url(mission)}/events").status_code == 404


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_open_streams_do_not_keep_the_server_from_stopping(service: Service, how: signal.Signals) -> None:
    with service.db.write() as tx:
        url = f"{service.url}/api/v1/missions/{missions.create(tx, 'm').id}"
    with listening(url) as one, listening(url) as two:
        next(one)
        next(two)
        assert service.stop(how) < 2
