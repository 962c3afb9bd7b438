"""Files are made of the map as it is, one at a time is kept, and nothing is left of what nobody wants."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pmtiles.reader import all_tiles

from services.catalog import exports, missions
from services.tables import Export


@pytest.fixture
def mapped(bench: Any, photos: list[tuple[str, bytes]]) -> Any:
    """A mission with three photos on its map."""
    bench.upload(photos[:3])
    bench.drain()
    return bench


def kept(bench: Any) -> list[str]:
    return list(bench.modules["app"].store.list(f"missions/{bench.mission_id}/exports/"))


def test_of_a_growing_map_only_the_newest_file_is_kept(mapped: Any, photos: list[tuple[str, bytes]]) -> None:
    first = mapped.export("tiles.pmtiles"), mapped.export("route.csv")
    assert kept(mapped) == sorted(str(row.object_key) for row in first)
    mapped.upload(photos[3:])
    mapped.drain()
    later = mapped.export("tiles.pmtiles")
    assert later.object_key != first[0].object_key
    assert kept(mapped) == sorted([str(later.object_key), str(first[1].object_key)])


def test_a_file_that_is_made_again_is_another_one(mapped: Any) -> None:
    """Also of the same map: a download would go on in it."""
    names = set()
    for _ in range(2):
        row = mapped.export("report.json")
        names.add(row.object_key)
        with mapped.db.write() as tx:
            exports.get(tx, mapped.mission_id, "report.json").state = "failed"
    assert len(names) == 2


def test_files_of_a_map_that_sharpens_have_no_holes(
    bench: Any, photos: list[tuple[str, bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are of the preview's zoom until the sharper one is whole, which readers take for all there is."""
    monkeypatch.setattr(bench.modules["publish"], "ENOUGH", 1)
    with bench.db.write() as tx:
        bench.mission_id = missions.create(tx, "sharpens", "visual", 256, backfill=True).id
    bench.upload(photos)
    bench.drain()
    bench.finalise()
    whole: set[tuple[int, int, int]] = set()
    partly = 0
    while bench.queue:
        name, args = bench.queue.pop(0)
        bench.handle(name, *args)
        if bench.state != "sharpening":
            continue
        shown = set(bench.tiles())
        whole = whole or shown
        if max(shown) > max(whole) and partly < 3:
            partly += 1
            assert tiles_in(bench, bench.export("tiles.pmtiles")) == whole
    assert partly
    assert max(bench.tiles()) > max(whole)
    assert tiles_in(bench, bench.export("tiles.pmtiles")) == set(bench.tiles())


def tiles_in(bench: Any, row: Export) -> set[tuple[int, int, int]]:
    with bench.modules["app"].store.open(row.object_key) as file:
        data = file.read()
    return {(z, x, y) for (z, x, y), _ in all_tiles(lambda start, length: data[start : start + length])}


@pytest.mark.parametrize("fails", [False, True])
def test_nothing_is_left_of_a_mission_that_was_deleted_while_its_file_was_made(
    mapped: Any, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    export, app = mapped.modules["export"], mapped.modules["app"]

    def deleted_meanwhile(path: Path, mission: Any, _wanted: Any) -> None:
        path.write_bytes(b"late")
        with app.db.write() as tx:
            missions.delete(tx, mission.id)
        app.store.delete_prefix(f"missions/{mission.id}/")
        with app.db.write() as tx:
            missions.purge(tx, mission.id)
        assert not fails, "its photos are gone"

    complaints: list[str] = []

    def complain(said: str, **_: Any) -> None:
        complaints.append(said)

    for module in (export, app):
        monkeypatch.setattr(module, "log", SimpleNamespace(exception=complain, info=lambda *_, **__: None))
    monkeypatch.setitem(export.MAKERS, "route.csv", deleted_meanwhile)
    with mapped.db.write() as tx:
        exports.request(tx, mapped.mission_id, "route.csv")
    app._stages["export"](mapped.mission_id, "route.csv")
    assert not list(app.store.list(f"missions/{mapped.mission_id}/"))
    assert not complaints


@pytest.fixture
def full_disk(mapped: Any, monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """A disk with room for so many looks at it, and none from then on."""
    looks = {"left": 0}

    def free(_folder: Path) -> Any:
        looks["left"] -= 1
        return SimpleNamespace(free=0 if looks["left"] < 0 else 10**15)

    export = mapped.modules["export"]
    settings = export.settings.model_copy(update={"min_free_bytes": 1})
    monkeypatch.setattr(export, "settings", settings)
    monkeypatch.setattr("workers.pieces.disk_usage", free)
    return looks


@pytest.mark.parametrize("room", [0, 1])
@pytest.mark.parametrize("name", ["mosaic.tif", "map.kmz", "tiles.mbtiles"])
def test_a_file_leaves_the_disk_to_photos_and_database(
    mapped: Any, full_disk: dict[str, int], name: str, room: int
) -> None:
    """And says so, before it is begun or in the middle; what there was of it is gone."""
    full_disk["left"] = room
    row = mapped.export(name)
    assert (row.state, row.error) == ("failed", mapped.modules["export"].NO_ROOM)
    assert not kept(mapped)
    folder = mapped.modules["export"].FOLDER
    assert not [p for p in folder.glob(f"{mapped.mission_id}-*") if p.is_dir()]
    full_disk["left"] = 10**9
    assert mapped.export(name).state == "ready"
