"""Submaps in the chain: ties that are tried last, and maps that merge while drones still fly."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import pytest

from core import neighbours, ties
from core.gallery import Gallery
from core.mosaic import build
from core.neighbours import NeighbourParams, Pair, Sighting
from core.simulation import FlightParams
from services.catalog import missions, pairs, poses
from services.report import report
from workers.simulate import simulate

FEW_NEIGHBOURS = NeighbourParams(nearest=0, sectors=1, before_and_after=1, alike=0)


@pytest.fixture(scope="module")
def strips(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, bytes]]:
    """Two drones side by side, seven photos each, by name."""
    out = tmp_path_factory.mktemp("strips")
    params = FlightParams(
        drones=2, lines=1, per_line=7, side_overlap=0.5, width_px=640, height_px=480, seed=3
    )
    simulate(params, out, jobs=2, truth=False)
    return [(p.name, p.read_bytes()) for p in sorted((out / "images").iterdir())]


def test_ties_tried_between_submaps_are_the_oracles(
    bench: Any, strips: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    own = neighbours.candidates

    def one_drone(frames: Sequence[Sighting], _: NeighbourParams | None = None) -> list[Pair]:
        drone = {f.frame_id: f.drone for f in frames}
        return [(a, b) for a, b in own(frames, FEW_NEIGHBOURS) if drone[a] == drone[b]]

    monkeypatch.setattr(ties, "candidates", one_drone)
    oracle = build(strips)
    assert {p.submap for p in oracle.solution.poses.values()} == {0}
    assert oracle.submaps.tried > 0
    assert [(t.low, t.high, t.accepted) for t in oracle.submaps.ties] == [(0, 1, True)]

    chance = random.Random(0)
    bench.upload(chance.sample(strips, len(strips)))
    bench.drain(chance)
    bench.finalise()
    bench.drain(chance)
    assert bench.state == "final"
    assert bench.tiles() == {tuple(k): v for k, v in oracle.tiles.items()}
    with bench.db.read() as tx:
        assert missions.get(tx, bench.mission_id).submaps == oracle.submaps.to_json()
        told = report(tx, bench.mission_id)
        summary = pairs.summary(tx, bench.mission_id)
    assert (told["submaps"], told["ties"]) == (
        oracle.submaps.to_json()["submaps"], oracle.submaps.to_json()["ties"],
    )  # fmt: skip
    assert told["pairs"]["reasons"]["ok"] == summary.accepted
    assert sum(told["pairs"]["reasons"].values()) == summary.done == summary.total


def test_the_first_frame_that_sees_two_maps_makes_them_one(
    bench: Any, strips: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench.modules["sequence"], "GROWTH", 100.0)
    monkeypatch.setattr(bench.modules["sequence"], "FEW", 1)
    line = strips[:7]

    def now() -> tuple[int, set[int]]:
        with bench.db.read() as tx:
            solved = missions.get(tx, bench.mission_id).solved_frames
            return solved, set(poses.maps(tx, bench.mission_id))

    bench.upload([line[0], line[1], line[5], line[6]])
    while [task for task in bench.queue if task[0] in ("ingest", "match")]:
        task = next(t for t in bench.queue if t[0] in ("ingest", "match"))
        bench.queue.remove(task)
        bench.handle(task[0], *task[1])
    bench.drain()
    apart = now()
    for photo in line[2:5]:
        bench.upload([photo])
        bench.drain()
    assert apart == (4, {0, 1})
    assert now()[0] > 4
    assert now()[1] == {0}


def test_two_drones_maps_merge_while_they_fly_though_no_neighbour_was_found(
    bench: Any, strips: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def same_drone(gallery: Gallery, frame_id: str) -> list[Pair]:
        mine = gallery.sighting(frame_id).drone
        others = gallery.row_of.keys() - {frame_id}
        same = [k for k in others if gallery.sighting(k).drone == mine]
        return [(min(k, frame_id), max(k, frame_id)) for k in same]

    def maps() -> set[int]:
        with bench.db.read() as tx:
            return set(poses.maps(tx, bench.mission_id))

    tying = bench.modules["sequence"].tying
    monkeypatch.setattr(bench.modules["match"], "neighbours", same_drone)
    look, asked = tying.look, list[Pair]()
    monkeypatch.setattr(tying, "look", lambda *_: [])
    bench.upload(strips)
    bench.drain()
    assert maps() == {0, 1}

    def looks(mission_id: str, known: Any) -> list[Pair]:
        found = look(mission_id, known)
        asked.extend(found)
        return found

    monkeypatch.setattr(tying, "look", looks)
    known = bench.modules["sequence"]._known[bench.mission_id]
    known.untried |= set(known.seen)
    bench.send("sequence", bench.mission_id)
    bench.drain()
    assert maps() == {0}
    assert 0 < len(asked) <= 8
    with bench.db.read() as tx:
        assert [t["accepted"] for t in missions.get(tx, bench.mission_id).submaps["ties"]] == [True]
