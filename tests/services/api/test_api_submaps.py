"""Submaps, ties and pairs over HTTP."""

from __future__ import annotations

import numpy as np
import pytest
from fastapi.testclient import TestClient

from core.frame import FrameMeta
from core.geometry import Pose
from services.api.context import Services
from services.catalog import frames, leases, missions, pairs, poses
from services.catalog.pairs import PairResult
from services.catalog.poses import Placed, PoseUpdate
from services.catalog.tiles import TileBox

DOWN = np.diag([1.0, -1.0, -1.0])
IDS = [f"{i:032x}" for i in range(6)]
GRAPH = {
    "submaps": [
        {"index": 0, "submap": 0, "frames": 3, "drone": "North", "georeferenced_by": "gps"},
        {"index": 1, "submap": 0, "frames": 2, "drone": "South", "georeferenced_by": "tie"},
        {"index": 2, "submap": None, "frames": 1, "drone": "South", "georeferenced_by": "none"},
    ],
    "ties": [
        {
            "low": 0, "high": 1, "strength": 36.1, "frames": 5, "points": 211, "angle_deg": 10.0,
            "accepted": True,
        }
    ],
    "tried_pairs": 7,
    "dropped_pairs": 1,
}  # fmt: skip


def mission_of(url: str) -> str:
    return url.rsplit("/", 1)[1]


def pose(services: Services, mission_id: str, homes: dict[str, int], **change: object) -> None:
    with services.db.write() as tx:
        epoch = leases.acquire(tx, mission_id, "test", 60) or 0
        placed = []
        for i, (frame_id, submap) in enumerate(homes.items()):
            frames.receive(tx, mission_id, frame_id, f"{i}.jpg", 1, "image/jpeg", 800, 600)
            frames.mark_ready(tx, mission_id, frame_id, FrameMeta(800, 600))
            frames.mark_matched(tx, mission_id, frame_id)
            source = "gnss" if submap else "visual"
            at = Pose(DOWN, np.array([30.0 * i, 0.0, 60.0]), 0.0, source, submap)  # type: ignore[arg-type]
            placed.append(Placed(frame_id, "one", at, TileBox(19, 1, 1, 1, 1)))
        poses.save(tx, mission_id, epoch, PoseUpdate(placed=placed, **change))  # type: ignore[arg-type]
        leases.release(tx, mission_id, "test", epoch)


def match(services: Services, mission_id: str, verdicts: dict[tuple[int, int], str]) -> None:
    with services.db.write() as tx:
        keys = [(IDS[i], IDS[j]) for i, j in verdicts]
        pairs.claim(tx, mission_id, None, keys)
        done = [
            PairResult(*key, why == "ok", why, 20 if why == "ok" else 0, {"tentative": 30}, None)
            for key, why in zip(keys, verdicts.values(), strict=True)
            if why
        ]
        pairs.record(tx, mission_id, done)


def test_a_new_mission_has_no_submaps(api: TestClient, mission_url: str) -> None:
    nothing = {"tried_pairs": 0, "dropped_pairs": 0, "solved_frames": 0, "waiting": 0}
    empty = nothing | {"maps": [], "submaps": [], "ties": []}
    assert api.get(f"{mission_url}/submaps").json() == empty
    assert api.get(f"{mission_url}/pairs").json() == {"pairs": [], "next": None}
    report = api.get(f"{mission_url}/report").json()
    assert (report["submaps"], report["ties"], report["pairs"]["reasons"]) == ([], [], {})


def test_submaps_are_those_of_the_last_solve_and_maps_are_as_of_now(
    api: TestClient, services: Services, mission_url: str
) -> None:
    mission_id = mission_of(mission_url)
    pose(services, mission_id, dict.fromkeys(IDS[:3], 0) | {IDS[3]: 4}, submaps=GRAPH, solved_frames=4)
    pose(services, mission_id, {IDS[4]: 0}, waiting={IDS[3]: None})
    said = api.get(f"{mission_url}/submaps").json()
    assert said == GRAPH | {
        "maps": [
            {"submap": 0, "frames": 4, "sources": {"visual": 4}},
        ],
        "waiting": 1,
        "solved_frames": 4,
    }
    report = api.get(f"{mission_url}/report").json()
    assert {k: report[k] for k in GRAPH} == GRAPH


def test_every_pair_says_why(api: TestClient, services: Services, mission_url: str) -> None:
    verdicts = {(0, 1): "ok", (0, 2): "too_ambiguous", (1, 2): "ok", (2, 3): "no_common_turn", (3, 4): ""}
    match(services, mission_of(mission_url), verdicts)
    said = api.get(f"{mission_url}/pairs").json()["pairs"]
    assert [(p["low"], p["high"], p["reason"] or "") for p in said] == [
        (IDS[i], IDS[j], why) for (i, j), why in verdicts.items()
    ]
    assert [p["state"] for p in said] == ["done"] * 4 + ["claimed"]
    assert said[0] | {"low": "", "high": ""} == {
        "low": "", "high": "", "state": "done", "accepted": True, "reason": "ok", "points": 20,
        "counts": {"tentative": 30},
    }  # fmt: skip
    assert api.get(f"{mission_url}/report").json()["pairs"] == {
        "total": 5, "done": 4, "accepted": 2, "reasons": {"no_common_turn": 1, "ok": 2, "too_ambiguous": 1},
    }  # fmt: skip
    of_2 = api.get(f"{mission_url}/pairs?frame_id={IDS[2]}").json()["pairs"]
    assert [(p["low"], p["high"]) for p in of_2] == [(IDS[0], IDS[2]), (IDS[1], IDS[2]), (IDS[2], IDS[3])]
    good = api.get(f"{mission_url}/pairs?accepted=true&frame_id={IDS[2]}").json()["pairs"]
    assert [(p["low"], p["high"]) for p in good] == [(IDS[1], IDS[2])]


@pytest.mark.parametrize("limit", [1, 2, 3, 5])
def test_pages_of_pairs_have_no_gap_and_no_repeat(
    api: TestClient, services: Services, mission_url: str, limit: int
) -> None:
    match(
        services,
        mission_of(mission_url),
        {(0, 1): "ok", (0, 5): "ok", (1, 2): "ok", (1, 3): "ok", (4, 5): ""},
    )
    seen, after = [], ""
    while True:
        page = api.get(f"{mission_url}/pairs?limit={limit}{after}").json()
        assert len(page["pairs"]) <= limit
        seen += [(p["low"], p["high"]) for p in page["pairs"]]
        if page["next"] is None:
            break
        after = f"&after={page['next']}"
    assert seen == [(IDS[i], IDS[j]) for i, j in ((0, 1), (0, 5), (1, 2), (1, 3), (4, 5))]


def test_missions_that_are_not_there_have_none(api: TestClient, services: Services, mission_url: str) -> None:
    for what in ("submaps", "pairs"):
        answer = api.get(f"/api/v1/missions/nobody/{what}")
        assert (answer.status_code, answer.json()["code"]) == (404, "mission_not_found")
    assert api.get(f"{mission_url}/pairs?after=x").status_code == 422
    with services.db.write() as tx:
        missions.delete(tx, mission_of(mission_url))
    assert api.get(f"{mission_url}/submaps").status_code == 404
