"""Surveyed points over HTTP, and on the command line on their way there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from core.errors import BadCheckpoints
from services.api.context import Services
from services.cli.checkpoints import checkpoint_rows, read_survey
from services.tables import Frame

GCP = "EPSG:32632\n500000 5200000 7 100 200 a.jpg P1\n500050 5200000 8 300 200 a.jpg P2\n1 2 3 4 5 b.jpg\n"
NAMELESS = "1.00,2.00"


def test_points_are_sent_looked_at_and_taken_back(api: TestClient, mission_url: str) -> None:
    url = f"{mission_url}/checkpoints"
    missing = api.get(url)
    assert (missing.status_code, missing.json()["code"]) == (404, "checkpoints_not_found")
    sent = api.put(url, content=GCP, params={"use": ["P2", "P1"]})
    assert sent.status_code == 200, sent.text
    assert sent.json() == {"points": [NAMELESS, "P1", "P2"], "sightings": 3, "use": ["P1", "P2"]}
    assert api.get(url).json() == sent.json()
    assert api.put(url, content="\ufeff" + GCP).json()["use"] == []
    assert [api.delete(url).status_code for _ in range(2)] == [204, 204]
    assert api.get(url).status_code == 404
    assert api.put("/api/v1/missions/nobody/checkpoints", content=GCP).json()["code"] == "mission_not_found"


@pytest.mark.parametrize(
    ("content", "use", "word"),
    [
        (b"", [], "empty"),
        (b"\xff\xfe\x00", [], "UTF-8"),
        (b"EPSG:32632\n1 2 3", [], "Line 2"),
        (b"a field near Bonn\n1 2 3 4 5 a.jpg P1", [], "CRS"),
        (b"EPSG:32632\n500000 5200000 7 100 200 a.jpg P1", ["P9"], "P9"),
        (b"# " + b"x" * 8_000_000, [], "8 MB"),
    ],
)
def test_a_bad_file_is_a_problem_and_changes_nothing(
    api: TestClient, mission_url: str, content: bytes, use: list[str], word: str
) -> None:
    url = f"{mission_url}/checkpoints"
    api.put(url, content=GCP)
    refused = api.put(url, content=content, params={"use": use})
    assert refused.status_code == 422
    assert refused.headers["content-type"] == "application/problem+json"
    assert refused.json()["code"] == "bad_checkpoints"
    assert word in refused.json()["detail"]
    assert api.get(url).json()["sightings"] == 3


def test_only_points_that_move_poses_wake_the_sequencer(
    api: TestClient, services: Services, mission_url: str, sent: Any
) -> None:
    mission_id = mission_url.rsplit("/", 1)[1]
    with services.db.write() as tx:
        tx.add(
            Frame(
                mission_id=mission_id, id="f", name="a.jpg", size_bytes=1, state="posed", received_at=1.0,
                posed_at=2.0,
            )
        )  # fmt: skip
    sent.tasks.clear()
    api.put(f"{mission_url}/checkpoints", content=GCP)
    assert sent.tasks == []
    api.put(f"{mission_url}/checkpoints", content=GCP, params={"use": ["P1"]})
    api.delete(f"{mission_url}/checkpoints")
    assert sent.tasks == [("sequence", mission_id)] * 2


def test_names_on_the_command_line_are_parted_by_commas(tmp_path: Path) -> None:
    path = tmp_path / "gcp.txt"
    path.write_text(GCP)
    assert read_survey(None, []) is None
    for use, names in (
        ([], ()),
        (["P2,P1"], ("P1", "P2")),
        (["P2", " P1,"], ("P1", "P2")),
        ([NAMELESS, "P1"], (NAMELESS, "P1")),
    ):
        survey = read_survey(path, use)
        assert survey is not None
        assert (survey.content, survey.use) == (GCP, names)
    for where, use, word in ((path, ["P3"], "P3"), (None, ["P1"], "--gcp"), (tmp_path, [], "cannot be read")):
        with pytest.raises(BadCheckpoints, match=word):
            read_survey(where, use)


def test_the_summary_says_what_was_found() -> None:
    assert checkpoint_rows(None) == []
    points = [{"point": "P1", "used": True, "unseen": None}, {"point": "P2", "used": False, "unseen": None}]
    lost = [
        {"point": f"P{k}", "used": False, "unseen": why} for k, why in enumerate(("no_photo", "not_posed"))
    ]
    nothing: dict[str, Any] = {"points": lost, "poses": None, "mosaic": None}
    assert checkpoint_rows(nothing) == [
        ("checkpoints, not seen", "P0: none of their photos is in the mission"),
        ("checkpoints, not seen", "P1: none of their photos is on the map by its picture"),
    ]
    unknown = {"plane_debiased_m": None, "plane_similarity_m": None}
    poses = {"points": 1, "sightings": 4, "plane_raw_m": 1.234} | unknown
    mosaic = {"points": 1, "found": 0, "raw_m": None, "debiased_m": None, "similarity_m": None}
    assert checkpoint_rows({"points": points, "poses": poses, "mosaic": mosaic}) == [
        ("held by", "P1"),
        ("checkpoints, poses", "1 point in 4 photos: 1.23 m"),
        ("checkpoints, mosaic", "0 of 1 point found"),
    ]
    found = mosaic | {"points": 3, "found": 3, "raw_m": 0.5, "debiased_m": 0.25, "similarity_m": 0.1}
    said = dict(checkpoint_rows({"points": points, "poses": poses, "mosaic": found}))
    assert said["checkpoints, mosaic"] == (
        "3 of 3 points found: 0.50 m, 0.25 m less the mean shift, 0.10 m after a similarity"
    )
