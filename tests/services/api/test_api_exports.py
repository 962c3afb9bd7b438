"""Exports by name and CRS: what is offered, what is refused, what the workers are asked for."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from core.errors import BadCrs
from services.api import exports as routes
from services.api.context import Services
from services.api.sweep import Sweep
from services.catalog import exports, missions
from services.export_names import NAMES, crs_of, mosaic_in
from services.queue import PRIORITIES
from services.settings import Settings


def test_everything_offered_can_be_asked_for(api: TestClient, mission_url: str, sent: Any) -> None:
    offered = [e["name"] for e in api.get(f"{mission_url}/exports").json()["exports"]]
    assert offered == list(NAMES)
    for name in offered:
        assert api.get(f"{mission_url}/exports/{name}").status_code == 202
    assert [task[2] for task in sent.tasks] == offered


def test_the_mosaic_in_another_crs_is_a_file_of_its_own(api: TestClient, mission_url: str, sent: Any) -> None:
    url = f"{mission_url}/exports/mosaic.tif"
    for crs in ("EPSG:3857", "EPSG:4326", "EPSG:32632"):
        wanted = api.get(url, params={"crs": crs})
        assert wanted.status_code == 202
        assert api.get(wanted.json()["url"]).json() == wanted.json()
    assert api.get(url).status_code == 202
    names = [task[2] for task in sent.tasks]
    assert len(set(names)) == 4
    assert [crs_of(name) for name in names] == ["EPSG:3857", "EPSG:4326", "EPSG:32632", None]


@pytest.mark.parametrize(
    ("name", "crs", "code"),
    [
        ("mosaic.tif", "EPSG:99999", "bad_crs"),  # there is none
        ("mosaic.tif", "EPSG:5773", "bad_crs"),  # heights
        ("mosaic.tif", "EPSG:4978", "bad_crs"),  # geocentric
        ("mosaic.tif", "EPSG:4979", "bad_crs"),  # with a height
        ("tiles.zip", "EPSG:3857", "bad_crs"),
        ("mosaic.tif", "+proj=utm", "invalid_request"),
        ("mosaic.tif", "EPSG:٣٨٥٧", "invalid_request"),
    ],
)
def test_a_crs_that_no_map_has_is_refused(
    api: TestClient, mission_url: str, sent: Any, name: str, crs: str, code: str
) -> None:
    refused = api.get(f"{mission_url}/exports/{name}", params={"crs": crs})
    assert (refused.status_code, refused.json()["code"]) == (422, code)
    assert not sent.tasks


@given(st.one_of(st.text(), st.integers(1000, 40_000).map(lambda n: f"EPSG:{n}")))
def test_a_crs_goes_through_the_name_or_is_refused(crs: str) -> None:
    try:
        name = mosaic_in(crs)
    except BadCrs:
        return
    assert crs_of(name) == f"EPSG:{int(crs.removeprefix('EPSG:'))}"
    assert name not in NAMES


def make(services: Services, mission_url: str, name: str, data: bytes) -> None:
    """What a worker does once the file was asked for."""
    mission_id = mission_url.rsplit("/", 1)[1]
    with services.db.write() as tx:
        wanted = exports.get(tx, mission_id, name)
        assert wanted is not None
        key = f"missions/{mission_id}/exports/{wanted.requested_at}/{name}"
        before = wanted.object_key
        services.store.put(key, data)
        assert exports.finish(tx, mission_id, name, wanted.revision, key, len(data), "image/tiff")
    if before:
        services.store.delete(before)


def publish(services: Services, mission_url: str) -> None:
    with services.db.write() as tx:
        missions.get(tx, mission_url.rsplit("/", 1)[1]).revision += 1


def test_a_name_that_is_no_file_is_not_found(api: TestClient, mission_url: str, sent: Any) -> None:
    for name in ("passwd", "mosaic.epsg3857.tif", "mosaic.tif.lock", "%F0%9F%94%A5.tif"):
        refused = api.get(f"{mission_url}/exports/{name}")
        assert (refused.status_code, refused.json()["code"]) == (404, "export_not_found")
        assert all(known in refused.json()["detail"] for known in NAMES)
    assert not sent.tasks


def test_who_has_the_newest_file_is_told_so(api: TestClient, services: Services, mission_url: str) -> None:
    url = f"{mission_url}/exports/mosaic.tif"
    api.get(url)
    make(services, mission_url, "mosaic.tif", b"first")
    etag = api.get(url).headers["etag"]
    for offered in (etag, f"W/{etag}", f'"other", {etag}', "*"):
        for method in ("GET", "HEAD"):
            same = api.request(method, url, headers={"if-none-match": offered})
            assert (same.status_code, same.content, same.headers["etag"]) == (304, b"", etag)
    publish(services, mission_url)
    assert api.get(url, params={"retry": True}).status_code == 202
    make(services, mission_url, "mosaic.tif", b"later")
    later = api.get(url, headers={"if-none-match": etag})
    assert (later.status_code, later.content) == (200, b"later")


def test_a_download_that_broke_off_goes_on_while_the_map_grows(
    api: TestClient, services: Services, mission_url: str, sent: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rest of the same file for as long as it is there, the whole of the newer one from then on."""
    monkeypatch.setattr(routes, "_FRESH_S", 0.0)
    url, first, later = f"{mission_url}/exports/mosaic.tif", b"0123456789", b"abcdefghij"
    api.get(url)
    make(services, mission_url, "mosaic.tif", first)
    begun = api.get(url, headers={"range": "bytes=0-3"})
    resume = {"range": "bytes=4-", "if-range": begun.headers["etag"]}
    publish(services, mission_url)
    asked = len(sent.tasks)
    assert (rest := api.get(url, headers=resume)).status_code == 206
    assert begun.content + rest.content == first
    assert len(sent.tasks) == asked
    assert api.get(url).status_code == 202  # somebody else wants it as it is now
    assert api.get(url, headers=resume).content == first[4:]
    make(services, mission_url, "mosaic.tif", later)
    whole = api.get(url, headers=resume)
    assert (whole.status_code, whole.content) == (200, later)


@pytest.mark.parametrize(
    ("asked", "status", "part"),
    [
        ("bytes=0-", 206, slice(0, 10)),
        ("bytes=-0", 416, None),
        ("bytes=-", 200, slice(0, 10)),
        ("bytes=7-3", 200, slice(0, 10)),
        ("bytes=10-", 416, None),
        ("bytes=-99", 206, slice(0, 10)),
        (f"bytes={'9' * 5000}-", 200, slice(0, 10)),
        ("bytes=٣-", 200, slice(0, 10)),
        ("lines=1-2", 200, slice(0, 10)),
    ],
    ids=range(9),
)
def test_odd_ranges(
    api: TestClient, services: Services, mission_url: str, asked: str, status: int, part: slice | None
) -> None:
    url, data = f"{mission_url}/exports/mosaic.tif", b"0123456789"
    api.get(url)
    make(services, mission_url, "mosaic.tif", data)
    answer = api.get(url, headers={"range": asked.encode()})
    assert answer.status_code == status
    assert answer.content == (b"" if part is None else data[part])
    told = api.head(url, headers={"range": asked.encode()})
    assert (told.status_code, told.headers["content-length"]) == (200, "10")


def test_a_file_is_of_a_few_seconds_ago_until_the_map_is_final(
    api: TestClient, services: Services, mission_url: str
) -> None:
    """Or a map that is published all the while, drawn or sharpened, could never be fetched."""
    url = f"{mission_url}/exports/tiles.pmtiles"
    for state in ("open", "finalising", "sharpening", "final"):
        with services.db.write() as tx:
            missions.get(tx, mission_url.rsplit("/", 1)[1]).state = state
        publish(services, mission_url)
        api.get(url)
        if state != "final":
            make(services, mission_url, "tiles.pmtiles", state.encode())
            publish(services, mission_url)
            assert api.get(url).content == state.encode()
        else:
            assert api.get(url).status_code == 202
        with services.db.write() as tx:
            row = exports.get(tx, mission_url.rsplit("/", 1)[1], "tiles.pmtiles")
            assert row is not None
            row.finished_at = (row.finished_at or 0) - 20
        assert api.get(url).status_code == 202


def test_short_files_go_before_photos_that_come_and_long_ones_wait_for_so_long_only(
    api: TestClient, services: Services, settings: Settings, mission_url: str, sent: Any
) -> None:
    for name in NAMES:
        api.get(f"{mission_url}/exports/{name}")
    first = {task[2]: p for task, p in zip(sent.tasks, sent.priorities, strict=True)}
    waits = {name for name, priority in first.items() if priority > PRIORITIES["ingest"]}
    assert waits == {"mosaic.tif", "map.kmz"}
    sent.tasks.clear(), sent.priorities.clear()
    with services.db.write() as tx:
        for row in exports.list(tx, mission_url.rsplit("/", 1)[1]):
            row.woken_at = row.requested_at = 0.0
    Sweep(settings, services.db, services.store, sent, services.uploads).once()
    assert {task[2] for task in sent.tasks} == set(NAMES)
    assert max(sent.priorities) < PRIORITIES["ingest"]
