"""Every stage may run twice, late and out of order: the rows and the tiles come out the same."""

from __future__ import annotations

import random
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from PIL import Image

from core.errors import TruncatedImage
from core.mosaic import Mosaic, build, frame_id_of
from core.pyramid import PNG, decode
from core.simulation import FlightParams
from services.catalog import backlog, exports, frames, leases, missions, pairs, poses, tiles
from services.errors import LeaseLost, OutOfDisk
from workers.simulate import simulate

Tiles = dict[tuple[int, int, int], bytes]


def rows(bench: Any) -> dict[str, Any]:
    """All that a finished mission's rows say, but times."""
    with bench.db.read() as tx:
        known = poses.load(tx, bench.mission_id)
        return {
            "frames": {f.id: (f.state, f.reason_code, f.meta) for f in frames.list(tx, bench.mission_id)},
            "pairs": pairs.accepted(tx, bench.mission_id),
            "poses": {k: (repr(p.pose), p.box, p.gain, p.camera_key) for k, p in known.placed.items()},
            "cameras": known.cameras,
            "tiles": {
                k: (t.etag, t.object_key)
                for k, t in tiles.current(tx, bench.mission_id, tiles.keys(tx, bench.mission_id)).items()
            },
        }


@pytest.mark.parametrize(("seed", "times"), [(None, 1), (1, 1), (2, 2), (3, 2)])
def test_shuffled_and_repeated_tasks_end_in_the_oracles_tiles(
    bench: Any, photos: list[tuple[str, bytes]], expected: Tiles, seed: int | None, times: int
) -> None:
    chance = None if seed is None else random.Random(seed)
    shown = list(photos)
    if chance:
        chance.shuffle(shown)
    bench.upload(shown)
    bench.drain(chance, times)
    bench.finalise()
    bench.drain(chance, times)
    assert bench.state == "final"
    assert set(bench.frame_states().values()) == {"fused"}
    assert bench.tiles() == expected


def test_tiles_are_png_by_setting_and_show_exactly_what_was_drawn(
    bench: Any, photos: list[tuple[str, bytes]], oracle: Mosaic, expected: Tiles
) -> None:
    settings = bench.modules["app"].settings
    assert settings.tile_format == "jpeg"
    object.__setattr__(settings, "tile_format", "png")  # frozen for everybody else
    try:
        bench.upload(photos)
        bench.drain()
        bench.finalise()
        bench.drain()
    finally:
        object.__setattr__(settings, "tile_format", "jpeg")
    shown = bench.tiles()
    assert shown == {tuple(k): v for k, v in build(photos, tile_format="png").tiles.items()}
    assert shown.keys() == expected.keys()
    with bench.db.read() as tx:
        assert {t.media_type for t in tiles.current(tx, bench.mission_id, shown).values()} == {PNG}
    zoom = oracle.layout.zoom
    for key in [k for k in shown if k[0] == zoom]:
        assert np.abs(decode(shown[key]).astype(int) - decode(expected[key])).mean() < 4


def test_large_photos_end_in_the_oracles_tiles_too(
    bench: Any, photos: list[tuple[str, bytes]], expected: Tiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More bands than usual: frames reach farther, and move seams farther away."""
    monkeypatch.setattr("core.coverage.USUAL_SIDE_PX", 160)
    bench.upload(photos[::-1])
    bench.drain(random.Random(5))
    bench.finalise()
    bench.drain(random.Random(6))
    made = build(photos)
    assert made.layout.fusion.bands == 6
    assert bench.tiles() == {tuple(k): v for k, v in made.tiles.items()} != expected


def test_a_map_whose_photos_turn_out_to_be_larger_is_drawn_anew(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing that is shown stays from when it was put together otherwise."""
    bench.upload(photos[:5])
    bench.drain()
    bench.finalise()
    bench.drain()
    monkeypatch.setattr("core.coverage.USUAL_SIDE_PX", 320)
    bench.upload(photos[5:])
    bench.drain()
    bench.finalise()
    bench.drain()
    assert bench.tiles() == {tuple(k): v for k, v in build(photos).tiles.items()}


@pytest.fixture(scope="module")
def two_drones(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[tuple[str, bytes]], Tiles]:
    """Five photos of each of two drones, in turns, and the oracle's tiles."""
    out = tmp_path_factory.mktemp("drones")
    params = FlightParams(drones=2, lines=1, per_line=5, width_px=480, height_px=360, seed=8)
    simulate(params, out, jobs=2, truth=False)
    found = [(p.name, p.read_bytes()) for p in sorted(out.glob("images/*"))]
    photos = [photo for pair in zip(found[:5], found[5:], strict=True) for photo in pair]
    return photos, {tuple(k): v for k, v in build(photos).tiles.items()}  # type: ignore[misc]


@pytest.mark.parametrize("seed", range(4))
def test_drones_in_turns_and_an_end_that_comes_early_give_the_oracles_tiles(
    bench: Any, two_drones: tuple[list[tuple[str, bytes]], Tiles], seed: int
) -> None:
    """Photos come while tasks of all kinds are under way, and so does the wish to finish."""
    (photos, expected), chance = two_drones, random.Random(seed)
    left = photos if seed % 2 else photos[::-1]
    while left:
        count = chance.randint(1, 4)
        bench.upload(left[:count])
        left = left[count:]
        for _ in range(min(chance.randrange(3 * count), len(bench.queue))):
            name, args = bench.queue.pop(chance.randrange(len(bench.queue)))
            bench.handle(name, *args)
    bench.finalise()
    bench.drain(chance)
    assert bench.state == "final"
    assert bench.tiles() == expected


def test_the_live_map_comes_to_rest_after_every_photo(
    bench: Any, photos: list[tuple[str, bytes]], expected: Tiles
) -> None:
    """A photo far from a dirty tile must not keep that tile dirty."""
    for photo in photos:
        bench.upload([photo])
        bench.drain()
        with bench.db.read() as tx:
            desk = backlog.of(tx, bench.mission_id, 30)
            assert missions.progress(tx, bench.mission_id).idle
        assert (desk.in_flight, desk.to_render, desk.to_publish) == (0, 0, 0)
        assert bench.frame_states()[photo[0]] == "fused"
    bench.finalise()
    bench.drain()
    assert bench.tiles() == expected


def test_a_photo_whose_ground_is_shown_is_on_the_map_as_soon_as_it_is_posed(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.upload(photos[:8])
    bench.drain()
    sequence = bench.modules["sequence"]
    monkeypatch.setattr(sequence, "FEW", 2)  # few photos are solved all together otherwise
    # As in the middle of a large map, all of whose tiles there are full.
    monkeypatch.setattr(sequence.Known, "grown", lambda *_: {})
    bench.upload([("again.jpg", photos[4][1] + b"\0")])
    while bench.frame_states()["again.jpg"] not in ("posed", "fused"):
        name, args = bench.queue.pop(0)
        bench.handle(name, *args)
    assert bench.frame_states()["again.jpg"] == "fused"


def test_everything_once_more_changes_no_row(bench: Any, photos: list[tuple[str, bytes]]) -> None:
    bench.upload(photos[:4])
    log: list[tuple[str, tuple[Any, ...]]] = []
    send = bench.send

    def remember(name: str, *args: Any, priority: int | None = None) -> bool:
        log.append((name, args))
        return bool(send(name, *args))

    for name in ("ingest", "match", "sequence", "fuse", "publish"):
        bench.modules[name].send = remember
    bench.drain()
    bench.finalise()
    bench.drain()
    before = rows(bench)
    with bench.db.read() as tx:
        revision = missions.get(tx, bench.mission_id).revision
    for name, args in log:
        bench.handle(name, *args)
    bench.drain()
    assert rows(bench) == before
    with bench.db.read() as tx:
        assert missions.get(tx, bench.mission_id).revision == revision


def test_two_frames_that_arrive_at_once_are_matched_exactly_once(
    bench: Any, photos: list[tuple[str, bytes]]
) -> None:
    bench.upload(photos[:2])
    ids = [frame_id_of(data) for _, data in photos[:2]]
    for frame_id in ids:
        bench.handle("ingest", bench.mission_id, frame_id)  # both are ready before either is matched
    computed: list[tuple[str, str]] = []
    match = bench.modules["match"]
    really = match.computed
    match.computed = lambda m, metas, pair: computed.append(pair) or really(m, metas, pair)
    try:
        for frame_id in [*ids, *ids]:
            bench.handle("match", bench.mission_id, frame_id)
    finally:
        match.computed = really
    assert computed == [tuple(sorted(ids))]


def test_a_photo_that_fails_to_be_read_is_rejected_in_the_end(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def explode(*_: Any) -> None:
        raise MemoryError("no room")

    monkeypatch.setattr(bench.modules["ingest"], "extract", explode)
    bench.upload(photos[:1])
    assert bench.drain() < 20
    with bench.db.read() as tx:
        row = frames.list(tx, bench.mission_id)[0]
    assert (row.state, row.reason_code) == ("rejected", "internal")
    assert "no room" in (row.reason or "")


def test_a_full_disk_costs_no_photo_however_long_it_lasts(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OutOfDisk

    bench.upload(photos[:1])
    frame_id = frame_id_of(photos[0][1])
    with monkeypatch.context() as away:
        away.setattr(type(bench.modules["app"].store), "put", full)
        for _ in range(9):
            with pytest.raises(OutOfDisk):
                bench.modules["ingest"].ingest(bench.mission_id, frame_id)
    assert bench.frame_states() == {photos[0][0]: "received"}
    bench.drain()
    assert bench.frame_states() == {photos[0][0]: "fused"}


@pytest.mark.parametrize("when", ["before reading", "before drawing", "before the final map"])
def test_a_photo_that_is_lost_from_the_store_is_named_and_the_map_goes_on_without_it(
    bench: Any, photos: list[tuple[str, bytes]], when: str
) -> None:
    store, shelf = bench.modules["app"].store, bench.modules["fuse"].shelf
    name, data = photos[2]
    key = f"missions/{bench.mission_id}/photos/{frame_id_of(data)}"

    def lose() -> None:
        store.delete(key)
        shelf.pictures.clear()

    bench.upload(photos[:5])
    if when == "before reading":
        lose()
    while when == "before drawing" and bench.queue[0][0] != "fuse":
        task, args = bench.queue.pop(0)
        bench.handle(task, *args)
    if when == "before drawing":
        lose()
    bench.drain()
    if when == "before the final map":
        lose()
    bench.finalise()
    bench.drain()
    assert bench.state == "final"
    with bench.db.read() as tx:
        (row,) = frames.list(tx, bench.mission_id, "rejected")
    assert (row.name, row.reason_code) == (name, "photo_lost")
    rest = [p for p in photos[:5] if p[0] != name]
    assert bench.frame_states() == {p[0]: "fused" for p in rest} | {name: "rejected"}
    assert bench.tiles() == {tuple(k): v for k, v in build(rest).tiles.items()}
    store.put(key, data)  # it is uploaded again
    with bench.db.write() as tx:
        assert frames.retry(tx, bench.mission_id, row.id)
    bench.send("ingest", bench.mission_id, row.id)
    bench.drain()
    bench.finalise()
    bench.drain()
    assert bench.tiles() == {tuple(k): v for k, v in build(photos[:5]).tiles.items()}


def test_a_torn_photo_is_rejected_at_once_and_the_mission_ends(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    data = photos[3][1]
    torn = ("torn.jpg", data[: len(data) * 2 // 3])
    bench.upload([*photos[:3], torn])
    bench.finalise()
    bench.drain(random.Random(5))
    assert bench.state == "final"
    assert bench.frame_states() == {p[0]: "fused" for p in photos[:3]} | {"torn.jpg": "rejected"}
    with bench.db.read() as tx:
        reasons = [f.reason_code for f in frames.list(tx, bench.mission_id, "rejected")]
    assert reasons == [TruncatedImage.code]
    assert bench.tiles() == {tuple(k): v for k, v in build(photos[:3]).tiles.items()}


def test_a_mission_without_photos_or_without_a_place_ends_too(bench: Any) -> None:
    bench.finalise()
    bench.drain()
    assert bench.state == "final"
    grey = BytesIO()
    Image.new("RGB", (320, 240), (90, 99, 80)).save(grey, "JPEG")
    bench.upload([("nowhere.jpg", grey.getvalue())])
    bench.drain()
    bench.finalise()
    bench.drain()
    assert bench.state == "final"
    with bench.db.read() as tx:
        assert [f.state for f in frames.list(tx, bench.mission_id)] == ["waiting"]
    with bench.db.write() as tx:
        exports.request(tx, bench.mission_id, "mosaic.tif")
    bench.handle("export", bench.mission_id, "mosaic.tif")
    with bench.db.read() as tx:
        row = exports.get(tx, bench.mission_id, "mosaic.tif")
    assert row is not None
    assert row.state == "failed"
    assert "No photo" in (row.error or "")


def test_a_sequencer_that_was_replaced_writes_nothing(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = bench.modules["sequence"]
    bench.upload(photos[:3])
    for _ in range(6):
        name, args = bench.queue.pop(0)
        bench.handle(name, *args)
    lay_out = sequence.solving.lay_out

    def slowly(*args: Any, **more: Any) -> Any:
        with bench.db.write() as tx:  # meanwhile the lease has run out and another one has it
            assert leases.acquire(tx, bench.mission_id, "another", 60, now=2e12) is not None
        return lay_out(*args, **more)

    monkeypatch.setattr(sequence.solving, "lay_out", slowly)
    with pytest.raises(LeaseLost):
        bench.handle("sequence", bench.mission_id)
    with bench.db.read() as tx:
        assert not poses.load(tx, bench.mission_id).placed
        assert missions.get(tx, bench.mission_id).generation == 0


def test_gnss_mode_matches_nothing_and_equals_the_oracle(
    modules: dict[str, Any], bench: Any, photos: list[tuple[str, bytes]]
) -> None:
    with bench.db.write() as tx:
        bench.mission_id = missions.create(tx, "gnss", "gnss", 320).id
    bench.upload(photos[:4])
    bench.drain()
    bench.finalise()
    bench.drain()
    with bench.db.read() as tx:
        assert pairs.summary(tx, bench.mission_id).total == 0
    found = build(photos[:4], 320, "gnss")
    assert {f.pose.source for f in found.layout.frames.values()} == {"gnss"}
    assert bench.tiles() == {tuple(k): v for k, v in found.tiles.items()}


def test_a_lost_race_to_publish_is_run_again(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    publish = bench.modules["publish"]
    overviews = publish._with_overviews
    raced = []

    def slowly(*args: Any) -> Any:
        changes = overviews(*args)
        if not raced:
            raced.append(True)
            bench.handle("publish", bench.mission_id)  # another worker is faster
        return changes

    monkeypatch.setattr(publish, "_with_overviews", slowly)
    bench.upload(photos[:2])
    bench.drain()
    assert raced
    assert set(bench.frame_states().values()) == {"fused"}


def test_the_oracle_itself_does_not_depend_on_the_order(
    photos: list[tuple[str, bytes]], oracle: Mosaic
) -> None:
    turned = build(photos[::-1])
    assert turned.tiles == oracle.tiles
    assert {f.pose.source for f in oracle.layout.frames.values()} == {"visual"}
