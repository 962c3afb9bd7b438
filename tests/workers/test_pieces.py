"""A mosaic that many draw is the one that one draws, whoever helps and whoever is killed."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from core.cog import MosaicParams, MosaicPlan, write_mosaic
from core.decode import decode_rgb
from core.features import extract
from core.mosaic import Mosaic, frame_id_of
from services.catalog import exports, missions

PARAMS = MosaicParams(piece_px=256, window_px=256, block_px=128, threads=2)


class Album:
    """The flight's photos; `stuck`: set once somebody looks at one, who then hangs."""

    def __init__(self, photos: list[tuple[str, bytes]], stuck: Any = None) -> None:
        self._pixels = {frame_id_of(data): decode_rgb(data, 320) for _, data in photos}
        self._thumbs = {k: extract(p, (640, 480)).thumb for k, p in self._pixels.items()}
        self._stuck = stuck

    def photo(self, frame_id: str) -> Any:
        if self._stuck is not None:
            self._stuck.set()
            time.sleep(600)
        return self._pixels[frame_id]

    def thumb(self, frame_id: str) -> Any:
        return self._thumbs[frame_id]


@pytest.fixture(scope="module")
def plan(oracle: Mosaic) -> MosaicPlan:
    return MosaicPlan.of(oracle.layout.world, list(oracle.layout.frames.values()), 0.2, PARAMS)


@pytest.fixture(scope="module")
def album(photos: list[tuple[str, bytes]]) -> Album:
    return Album(photos)


@pytest.fixture(scope="module")
def alone(plan: MosaicPlan, album: Album, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of the file that one process writes on its own."""
    path = tmp_path_factory.mktemp("alone") / "mosaic.tif"
    write_mosaic(path, plan.world, plan.index.frames, album, 0.2, params=replace(PARAMS, threads=1))
    return path.read_bytes()


def shared(plan: MosaicPlan, album: Album, folder: Path, modules: Any) -> Any:
    from workers.pieces import SharedMosaic

    return SharedMosaic(plan, album, folder / "m-mosaic.tif.digest", hands=2)


def test_many_hands_draw_the_same_bytes(
    modules: Any, plan: MosaicPlan, album: Album, alone: bytes, tmp_path: Path
) -> None:
    mosaic = shared(plan, album, tmp_path, modules)
    mosaic.begin()
    helpers = [get_context("fork").Process(target=mosaic.lend_a_hand) for _ in range(2)]
    for helper in helpers:
        helper.start()
    mosaic.write(tmp_path / "mosaic.tif", None)
    for helper in helpers:
        helper.join()
        assert helper.exitcode == 0
    assert len(plan.pieces()) > 6
    assert (tmp_path / "mosaic.tif").read_bytes() == alone
    mosaic.forget()
    assert not mosaic.folder.exists()


def test_what_a_killed_helper_had_claimed_is_drawn_by_others(
    modules: Any,
    plan: MosaicPlan,
    photos: list[tuple[str, bytes]],
    album: Album,
    alone: bytes,
    tmp_path: Path,
) -> None:
    mosaic = shared(plan, album, tmp_path, modules)
    mosaic.begin()
    stuck = get_context("fork").Event()
    helper = get_context("fork").Process(
        target=shared(plan, Album(photos, stuck), tmp_path, modules).lend_a_hand
    )
    helper.start()
    assert stuck.wait(60)
    assert mosaic.lend_a_hand()  # all but the one that is claimed
    undrawn = [p for p in plan.pieces() if not plan.is_drawn(p, mosaic.folder)]
    assert len(undrawn) == 1
    os.kill(helper.pid or 0, signal.SIGKILL)
    helper.join()
    mosaic.write(tmp_path / "mosaic.tif", None)
    assert (tmp_path / "mosaic.tif").read_bytes() == alone


def test_there_is_nothing_to_help_with_before_and_after(
    modules: Any, plan: MosaicPlan, album: Album, tmp_path: Path
) -> None:
    mosaic = shared(plan, album, tmp_path, modules)
    assert not mosaic.lend_a_hand()
    mosaic.begin()
    assert mosaic.lend_a_hand(for_s=0.0)  # time was up before the first piece
    assert not any(plan.is_drawn(p, mosaic.folder) for p in plan.pieces())
    older = tmp_path / "m-mosaic.tif.from-other-poses"
    older.mkdir()
    mosaic.begin()
    assert not older.exists()
    mosaic.forget()
    assert not mosaic.lend_a_hand()


def test_plans_that_differ_have_other_pieces(plan: MosaicPlan) -> None:
    frames = plan.index.frames
    moved = replace(frames[0], pose=replace(frames[0].pose, ground_h_m=frames[0].pose.ground_h_m + 1e-9))
    other = MosaicPlan.of(plan.world, [moved, *frames[1:]], 0.2, PARAMS)
    again = MosaicPlan.of(plan.world, frames[::-1], 0.2, replace(PARAMS, threads=7))
    assert again.digest() == plan.digest()
    assert len({plan.digest(), other.digest(), replace(plan, grid=replace(plan.grid, width=9)).digest()}) == 3


def test_a_worker_that_is_asked_too_draws_for_the_one_who_makes_the_file(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench.upload(photos[:4])
    bench.drain()
    bench.finalise()
    bench.drain()
    export, name = bench.modules["export"], "mosaic.tif"
    write, drawn = export.SharedMosaic.write, []

    def write_with_help(mosaic: Any, path: Path, crs: str | None) -> None:
        bench.handle("export", bench.mission_id, name)
        drawn.append(all(mosaic.plan.is_drawn(p, mosaic.folder) for p in mosaic.plan.pieces()))
        write(mosaic, path, crs)

    monkeypatch.setattr(export.SharedMosaic, "write", write_with_help)
    with bench.db.write() as tx:
        exports.request(tx, bench.mission_id, name)
    bench.handle("export", bench.mission_id, name)
    assert drawn == [True]
    with bench.db.read() as tx:
        made = exports.get(tx, bench.mission_id, name)
        mission = missions.get(tx, bench.mission_id)
    assert made is not None
    assert made.state == "ready"
    again = export._shared(mission, name)
    plan = again.plan
    write_mosaic(tmp_path / name, plan.world, plan.index.frames, again.photos, plan.grid.gsd_m)
    assert bench.modules["app"].store.get(made.object_key) == (tmp_path / name).read_bytes()
    assert not [p for p in export.FOLDER.glob(f"{bench.mission_id}-*") if p.is_dir()]
