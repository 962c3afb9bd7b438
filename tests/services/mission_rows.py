"""Rows of a mission that grows, for the laws of leases, poses and tiles."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from sqlalchemy import select

from core.geometry import Camera, Pose
from services.catalog import frames, missions, poses, tiles
from services.catalog.poses import Placed, PoseUpdate
from services.catalog.tiles import Key, Render, TileBox
from services.database import Database
from services.tables import DirtyTile

Race = Callable[[int, Callable[[int], Any]], list[Any]]
CAMERA = Camera(4000, 3000, 2800.25, 1999.5, 1499.5, -0.01, 0.001)
Z = 18


def placed(frame_id: str, x: int = 0, east_m: float = 0.1, gain: float = 1.0) -> Placed:
    """A frame over tiles (x, 0) … (x + 1, 1)."""
    rotation = np.array([[0.6, 0.8, 0.0], [0.8, -0.6, 0.0], [0.0, 0.0, -1.0]])
    pose = Pose(rotation, np.array([east_m, 2.0 / 3, 80.0]), 1.25, "visual", 3, (0.1, 0.2, 0.3))
    return Placed(frame_id, "camera", pose, TileBox(Z, x, 0, x + 1, 1), (gain, 1.0, 0.9))


def dirty(*frames_x: int, priority: int = tiles.GROWN) -> dict[Key, int]:
    return {(Z, x + dx, y): priority for x in frames_x for dx in (0, 1) for y in (0, 1)}


def render(key: Key, generation: int, etag: str = "") -> Render:
    name = etag or f"g{generation}"
    return Render(key, generation, f"tiles/{key[1]}/{key[2]}/{name}", name, "image/jpeg", 100)


def save(db: Database, mission_id: str, epoch: int, change: PoseUpdate) -> int:
    with db.write() as tx:
        return poses.save(tx, mission_id, epoch, change)


def show(db: Database, mission_id: str, renders: Iterable[Render]) -> int:
    """Record these renders and publish all that is pending, as the publisher does."""
    with db.write() as tx:
        tiles.record_renders(tx, mission_id, list(renders))
    with db.read() as tx:
        revision = missions.get(tx, mission_id).revision
        pending = tiles.pending_renders(tx, mission_id)
    with db.write() as tx:
        return tiles.publish(tx, mission_id, revision, pending, pending)


def dirty_keys(db: Database, mission_id: str) -> set[Key]:
    with db.read() as tx:
        rows = tx.scalars(select(DirtyTile).where(DirtyTile.mission_id == mission_id))
        return {(d.z, d.x, d.y) for d in rows}


def states(db: Database, mission_id: str) -> dict[str, str]:
    with db.read() as tx:
        return {f.id: f.state for f in frames.list(tx, mission_id)}
