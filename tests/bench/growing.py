"""What drawing costs a photo while the mission grows, and what is kept in memory meanwhile.

Real photos on a real database and store, with the true poses of a simulated flight: the stages fuse and
publish are the program's own. Photos come in batches, smaller ones around each of `--at`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil

from core.coverage import mission_zoom, tiles_under
from core.features import Features
from core.geometry import PosedFrame, World
from core.mosaic import Layout
from core.simulation import Flight, FlightParams, Shot, plan_flight
from tests.bench.ground import Texture, texture
from tests.bench.stages import Spent, Stages, stages
from tests.flights.missions import frame_id, meta_of

Line = dict[str, Any]
AROUND, BATCH, LIVE = 10, 24, 5
WORDS = 1024


@dataclass
class Drawn:
    """A mission whose photos are placed where they were taken, and drawn."""

    stages: Stages
    mission_id: str
    epoch: int
    flight: Flight
    ground: Texture
    known: Any

    def arrive(self, shots: Sequence[Shot]) -> None:
        """Photos from upload to posed; their tiles are dirty then."""
        from services.catalog import frames, poses
        from workers.photos import features_key, photo_key
        from workers.posing import update_of

        for shot in shots:
            key, meta = (self.mission_id, frame_id(shot)), meta_of(self.flight.params, shot)
            picture = self.ground.photo(self.flight, shot)
            self.stages.store.put(photo_key(*key), _jpeg(picture))
            self.stages.store.put(features_key(*key), _features(picture).to_bytes())
            with self.stages.db.write() as tx:
                frames.receive(tx, *key, shot.name, 1000, "image/jpeg", meta.width, meta.height)
                frames.mark_ready(tx, *key, meta)
                frames.mark_matched(tx, *key)
        new = {f.frame_id: f for f in map(self._placed, shots)}
        after = _with(self.known.layout, new)
        dirty = self.known.grown(after, set(new))
        keys = dict.fromkeys(after.frames, "camera")
        with self.stages.db.write() as tx:
            poses.save(
                tx, self.mission_id, self.epoch, replace(update_of(after, keys, set(new)), dirty=dirty)
            )
        self.known.layout = after
        self.stages.queue.append(("fuse", (self.mission_id, sorted(dirty))))

    def draw(self) -> None:
        """All that is dirty, until it is shown."""
        while tasks := self.stages.taken("fuse", "publish"):
            for name, args in tasks:
                self.stages.handle(name, *args)
        self.stages.queue.clear()

    def _placed(self, shot: Shot) -> PosedFrame:
        """In a world whose origin is the flight's; the map lies a little turned, which costs nothing."""
        e, n = self.flight.origin
        pose = replace(shot.pose, center=shot.pose.center - (e, n, 0.0), sigma_m=(0.1, 0.1, 0.2))
        return PosedFrame(frame_id(shot), shot.camera, pose)


def _with(layout: Layout, new: dict[str, PosedFrame]) -> Layout:
    zoom = layout.zoom or mission_zoom(new.values(), layout.world, None)
    assert zoom is not None
    under = {k: frozenset(tiles_under(f, layout.world, zoom)) for k, f in new.items()}
    cameras = {"camera": next(iter(new.values())).camera}
    return replace(
        layout, zoom=zoom, cameras=cameras, frames={**layout.frames, **new}, under={**layout.under, **under}
    )


def _jpeg(picture: Any) -> bytes:
    return bytes(cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1])


def _features(picture: Any) -> Features:
    """A thumbnail, and words as long as real ones; no keypoints, for nothing is matched."""
    h, w = picture.shape[:2]
    thumb = cv2.resize(picture, (128, 128 * h // w), interpolation=cv2.INTER_AREA)
    thumb = np.dstack((thumb, np.full(thumb.shape[:2], 128, np.uint8)))
    none = np.zeros((0, 2), np.float32)
    return Features(
        none, none[:, 0], none[:, 0], np.zeros((0, 128), np.uint8), np.ones(WORDS, np.float32), thumb
    )


@contextmanager
def mission(frames: int, **settings: Any) -> Iterator[Drawn]:
    """An empty mission and the flight of its photos."""
    params = FlightParams(frames=frames, drones=1, width_px=640, height_px=480, seed=1)
    flight = plan_flight(params)
    with tempfile.TemporaryDirectory(prefix="orthostream-bench-") as folder:
        made = stages(Path(folder), **settings)
        from services.catalog import leases, missions
        from workers.posing import Known

        with made.db.write() as tx:
            mission_id = missions.create(tx, "bench").id
            epoch = leases.acquire(tx, mission_id, "bench", 1e6)
        layout = Layout(World(params.lat_deg, params.lon_deg), None, {}, {}, {}, {})
        assert epoch is not None
        yield Drawn(made, mission_id, epoch, flight, texture(flight.gsd_m), Known(0, layout, 0))


def drawing_ms(frames: int, at: Sequence[int]) -> Line:
    """Milliseconds of fuse and publish a photo, mean over the photos around each of `at`; bytes kept."""
    with mission(frames) as drawn:
        clocks, windows, found = (
            drawn.stages.clocks,
            [range(n - AROUND, n + AROUND) for n in at],
            dict[str, Line](),
        )
        edges = {edge for w in windows for edge in (w.start, w.stop)} | {frames}
        kept, waiting = _Kept(drawn.stages), list[Shot]()
        for k, shot in enumerate(drawn.flight.shots):
            inside = next((w for w in windows if k in w), None)
            waiting.append(shot)
            if len(waiting) < (LIVE if inside else BATCH) and k + 1 not in edges:
                continue
            drawn.arrive(waiting)
            drawn.draw()
            kept.look()
            waiting = []
            if inside is None or k + 1 == inside.stop:
                if inside is not None:
                    found[str(k + 1 - AROUND)] = _figures(clocks.spent, len(inside))
                clocks.clear()
        return {"bench": "growing", "photos": frames, "at": found, "memory": kept.figures()}


def _figures(spent: dict[str, Spent], photos: int) -> Line:
    both = ("fuse", "publish")
    together = Spent(sum(spent[n].cpu_s for n in both), sum(spent[n].wall_s for n in both))
    return {n: spent[n].ms(photos) for n in both} | {"together": together.ms(photos)}


class _Kept:
    """The bytes that this process keeps of photos and tiles, looked at after every batch."""

    def __init__(self, made: Stages) -> None:
        from workers.photos import shelf

        settings, fuse, publish = made.modules["app"].settings, made.modules["fuse"], made.modules["publish"]
        self._photos = [shelf.pictures, shelf.features, shelf.words, shelf.thumbs]
        self._tiles = [fuse.pictures.held, publish.quarters.held]
        self._limits = (settings.photo_cache_bytes, settings.tile_cache_bytes)
        self._process = psutil.Process()
        self._most, self._rss = [0, 0], list[int]()

    def look(self) -> None:
        for k, shelves in enumerate((self._photos, self._tiles)):
            self._most[k] = max(self._most[k], sum(s.held_bytes for s in shelves))
        self._rss.append(self._process.memory_info().rss)

    def figures(self) -> Line:
        """`of_setting`: the most that was kept at any time, over what the setting allows."""
        names = ("photos", "tiles")
        kept = {
            name: {
                "setting_mb": limit / 1e6,
                "most_mb": round(most / 1e6, 1),
                "of_setting": round(most / limit, 3),
            }
            for name, limit, most in zip(names, self._limits, self._most, strict=True)
        }
        rss = [round(r / 1e6) for r in self._rss]
        quarters = [rss[round((len(rss) - 1) * q / 4)] for q in range(5)]
        return kept | {"process_rss_mb_at_quarters": quarters}
