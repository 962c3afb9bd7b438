"""The pairs of the final solve are asked for while the last photos are still being read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from core.neighbours import NeighbourParams, Sighting
from core.pose_graph import GraphFrame
from core.ties import Canonical, Matched
from services.catalog import backlog, pairs


def test_workers_find_the_final_pairs_waiting_when_the_last_photos_are_read(
    bench: Any,
    photos: list[tuple[str, bytes]],
    expected: dict[tuple[int, int, int], bytes],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few = NeighbourParams(nearest=1, sectors=1, before_and_after=1, alike=0)
    monkeypatch.setattr(bench.modules["match"], "LIVE", few)
    bench.upload(photos)
    bench.finalise()
    early: set[tuple[str, str]] = set()
    while bench.queue:
        # The sequencer has a process of its own.
        at = next((k for k, (name, _) in enumerate(bench.queue) if name == "sequence"), 0)
        name, args = bench.queue.pop(at)
        with bench.db.read() as tx:
            unread = backlog.of(tx, bench.mission_id, 30).unread
            known = set(pairs.keys(tx, bench.mission_id))
        before = len(bench.queue)
        bench.handle(name, *args)
        if name == "sequence" and unread:
            asked = [tuple(p) for task, a in bench.queue[before:] if task == "match" for p in a[2]]
            assert not early & set(asked), "the same pairs were asked for twice"
            assert not known & set(asked), "a pair was asked for that somebody is at"
            early |= set(asked)
    assert early
    assert bench.state == "final"
    assert bench.tiles() == expected


def test_while_a_mission_is_finished_each_frame_is_read_once(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = bench.modules["sequence"].wanted
    read, asked = list[str](), list[int]()
    sighting, canonical = wanted.sighting, wanted.canonical

    def reading(mission_id: str, frame: GraphFrame) -> Sighting:
        read.append(frame.frame_id)
        return sighting(mission_id, frame)

    def asking(frames: Sequence[Sighting], matched: Matched) -> Canonical | None:
        asked.append(len(frames))
        return canonical(frames, matched)

    few = NeighbourParams(nearest=1, sectors=1, before_and_after=1, alike=0)
    monkeypatch.setattr(bench.modules["match"], "LIVE", few)
    monkeypatch.setattr(wanted, "sighting", reading)
    monkeypatch.setattr(wanted, "canonical", asking)
    bench.upload(photos)
    bench.finalise()
    bench.drain()
    assert bench.state == "final"
    assert len(asked) > 1
    assert len(read) == len(set(read)) == len(photos)
    assert bench.mission_id not in wanted._sightings
