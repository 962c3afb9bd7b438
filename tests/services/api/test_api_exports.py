"""Exports by name and CRS: what is offered, what is refused, what the workers are asked for."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st

from core.errors import BadCrs
from services.export_names import NAMES, crs_of, mosaic_in


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
        ("mosaic.epsg3857.tif", "EPSG:3857", "invalid_request"),
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
