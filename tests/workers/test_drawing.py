"""What drawing costs: a live map fills its holes, rest or the end draws all once, nothing is drawn twice."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from core.coverage import block_grid, fusion_of, tiles_under
from core.fusion import overlapping
from core.geometry import Camera, Pose, PosedFrame, World
from services.catalog import backlog, frames, missions, tiles
from services.catalog.tiles import Render
from services.report import report
from services.tables import Mission, Tile

Photos = list[tuple[str, bytes]]


def pixels(bench: Any) -> dict[str, Any]:
    with bench.db.read() as tx:
        return report(tx, bench.mission_id)["pixels"]


def in_parts(bench: Any) -> int:
    """How many native tiles were drawn in parts, from several poses of the same photos."""
    with bench.db.read() as tx:
        row = missions.get(tx, bench.mission_id)
        tiles = tx.query(Tile).filter_by(mission_id=bench.mission_id, z=row.zoom).all()
    assert tiles
    return sum(tile.inputs is None for tile in tiles)


@pytest.fixture
def quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if no photo had come for a long time."""
    monkeypatch.setattr(frames, "quiet_s", lambda *_: math.inf)


@pytest.mark.parametrize("photo_side", [1600, 4000, 8000])
def test_no_frame_that_may_change_a_tile_is_left_out_when_its_poses_are_read(
    modules: dict[str, Any], photo_side: int
) -> None:
    fuse, fusion, zoom = modules["fuse"], fusion_of(photo_side, None), 20
    world, down = World(47.0, 8.0, 400.0), np.diag([1.0, -1.0, -1.0])
    mission = Mission(zoom=zoom, photo_side=photo_side, max_side=None, full=False, state="open")
    camera = Camera(1600, 1200, 1600.0, 799.5, 599.5)
    at = [PosedFrame(f"{x}", camera, Pose(down, np.array([float(x), 9.0, 120.0]), 0.0)) for x in range(400)]
    tile = min(tiles_under(at[0], world, zoom, fusion))
    box, found = fuse._box(mission, [tile]), 0
    for frame in at:
        if overlapping(block_grid([tile]), world, [frame], fusion):
            under = tiles_under(frame, world, zoom, fusion)
            xs, ys = [t.x for t in under], [t.y for t in under]
            assert min(xs) <= box.x1
            assert max(xs) >= box.x0
            assert min(ys) <= box.y1
            assert max(ys) >= box.y0
            found += 1
    assert 0 < found < len(at)


def test_a_mission_whose_photos_come_one_by_one_renders_less_than_two_passes(
    bench: Any, photos: Photos, expected: dict[tuple[int, int, int], bytes]
) -> None:
    for photo in photos:
        bench.upload([photo])
        bench.drain()
    live = pixels(bench)
    bench.finalise()
    bench.drain()
    cost = pixels(bench)
    assert live["rendered"] > 0
    last = cost["by_kind"]["final"]
    assert cost["one_pass"] <= last <= 1.2 * cost["one_pass"]  # tiles that the live poses led to besides
    assert cost["rendered"] == live["rendered"] + last
    assert cost["ratio"] <= 2.0
    assert in_parts(bench) == 0
    assert bench.tiles() == expected


def test_a_map_at_rest_is_what_finalising_makes_of_it_also_by_another_sequencer(
    bench: Any, photos: Photos, expected: dict[tuple[int, int, int], bytes], quiet: None
) -> None:
    sequence = bench.modules["sequence"]
    with pytest.MonkeyPatch.context() as flying:
        flying.setattr(frames, "quiet_s", lambda *_: 0.0)
        for photo in photos:
            bench.upload([photo])
            bench.drain()
    assert in_parts(bench) > 0
    sequence._known.clear()  # the one that posed them was killed
    with bench.db.write() as tx:
        for wake in missions.stalled(tx, 30.0, now=4e9):
            if wake.args[0] == bench.mission_id:
                bench.send(wake.task, *wake.args)
    bench.drain()
    assert bench.state == "open"
    assert in_parts(bench) == 0
    assert bench.tiles() == expected
    before = pixels(bench)
    bench.finalise()
    bench.drain()
    assert bench.state == "final"
    assert bench.tiles() == expected
    assert pixels(bench) == before  # nothing was left to draw


def test_a_map_at_rest_is_left_alone(bench: Any, photos: Photos, quiet: None) -> None:
    bench.upload(photos[:4])
    bench.drain()
    with bench.db.read() as tx:
        before = missions.get(tx, bench.mission_id)
    bench.send("sequence", bench.mission_id)
    bench.drain()
    with bench.db.read() as tx:
        after = missions.get(tx, bench.mission_id)
    assert (after.generation, after.revision) == (before.generation, before.revision)


def test_another_finalising_of_the_same_photos_draws_nothing(bench: Any, photos: Photos) -> None:
    bench.upload(photos[:5])
    bench.finalise()
    bench.drain()
    before = pixels(bench)
    with bench.db.write() as tx:
        row = missions.get(tx, bench.mission_id)
        row.state, row.final_generation = "open", None
    bench.finalise()
    bench.drain()
    assert bench.state == "final"
    assert pixels(bench) == before


def dealt(bench: Any) -> list[list[tuple[int, int, int]]]:
    """The runs of tiles that are handed out now, with 5000 photos still to be read."""
    with bench.db.read() as tx:
        mission = missions.get(tx, bench.mission_id)
        desk = replace(backlog.of(tx, bench.mission_id, 30), unread=5000)
    bench.modules["sequence"]._dispatch(mission, desk)
    found = [args[1] for name, args in bench.queue if name == "fuse"]
    bench.queue.clear()
    return found


def test_while_photos_wait_more_is_drawn_live_the_more_waits_as_long_as_that_is_cheap(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workers.dealing.REST_CORE_S", 0.0)
    with bench.db.write() as tx:
        tiles.mark_dirty(tx, bench.mission_id, [(20, x, y) for x in range(24) for y in range(20)], 1)

    def drawn(runs: list[list[tuple[int, int, int]]], reading_s: float, drawing_s: float) -> int:
        keys = [key for run in runs for key in run]
        with bench.db.write() as tx:
            tiles.record_renders(tx, bench.mission_id, [Render(key, 1) for key in keys])
            missions.spend(tx, bench.mission_id, "ingest", reading_s)
            missions.spend(tx, bench.mission_id, "fuse", drawing_s)
        return len(keys)

    first = dealt(bench)
    assert dealt(bench) == []  # until these are drawn
    assert (len(first), drawn(first, 10.0, 0.1)) == (1, 12)  # drawn by one worker
    assert drawn(dealt(bench), 10.0, 50.0) == (480 - 12) // 3
    assert drawn(dealt(bench), 0.0, 0.0) == 12
