"""Lists of pairs and counts of maps, on every backend."""

from __future__ import annotations

import numpy as np

from core.geometry import Pose
from services.catalog import frames, leases, pairs, poses
from services.catalog.pairs import PairResult
from services.catalog.poses import Placed, PoseUpdate
from services.catalog.tiles import TileBox
from services.database import Database

KEYS = [("a", "b"), ("a", "c"), ("b", "c"), ("b", "d")]


def test_pairs_are_listed_in_order_by_frame_and_by_verdict(db: Database, mission_id: str) -> None:
    with db.write() as tx:
        pairs.claim(tx, mission_id, None, reversed(KEYS))
        pairs.record(
            tx, mission_id, [PairResult(*k, k != KEYS[1], "ok", 9, {"final": 9}, None) for k in KEYS[:3]]
        )
    with db.read() as tx:
        every = pairs.list(tx, mission_id, 9)
        assert [(p.low, p.high) for p in every] == KEYS
        assert [(p.done, p.accepted, p.counts) for p in every[2:]] == [
            (True, True, {"final": 9}), (False, False, {}),
        ]  # fmt: skip
        assert pairs.list(tx, mission_id, 2, after=KEYS[0]) == every[1:3]
        assert pairs.list(tx, mission_id, 9, after=("a", "z")) == every[2:]
        assert pairs.list(tx, mission_id, 9, frame_id="c") == every[1:3]
        assert pairs.list(tx, mission_id, 9, accepted=True) == [every[0], every[2]]
        assert pairs.list(tx, mission_id, 9, accepted=False) == [every[1], every[3]]
        assert pairs.keys_of(tx, mission_id, ["a", "d"]) == [KEYS[0], KEYS[1], KEYS[3]]
        assert pairs.keys_of(tx, mission_id, []) == []
        assert pairs.verdicts(tx, mission_id, KEYS[1:]) == {KEYS[1]: False, KEYS[2]: True}


def test_maps_are_counted_by_the_source_of_their_poses(db: Database, mission_id: str) -> None:
    sources = {"a": ("visual", 0), "b": ("visual", 0), "c": ("gnss", 2), "d": ("gnss", 0)}
    with db.write() as tx:
        epoch = leases.acquire(tx, mission_id, "test", 60) or 0
        for k in sources:
            frames.receive(tx, mission_id, k, k, 1, "image/jpeg", 9, 9)
        placed = [
            Placed(k, "one", Pose(np.eye(3), np.zeros(3), 0.0, source, submap), TileBox(3, 1, 1, 1, 1))  # type: ignore[arg-type]
            for k, (source, submap) in sources.items()
        ]
        poses.save(tx, mission_id, epoch, PoseUpdate(placed=placed, submaps={"submaps": [], "ties": []}))
    with db.read() as tx:
        assert poses.maps(tx, mission_id) == {0: {"gnss": 1, "visual": 2}, 2: {"gnss": 1}}
