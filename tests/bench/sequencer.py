"""What the one owner of a mission costs a photo, while the mission grows: its real code on its real database.

Photos are points on the ground, projected with noise into all photos that see them; no picture is drawn, and
no tile, but their rows go all their way. Around each of `--at` photos come one by one and then in fives, as
they do at ten a second; else in large batches.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from core.features import Features
from core.simulation import FlightParams, Shot, plan_flight
from tests.bench.solver import matched
from tests.bench.stages import Spent, Stages, stages
from tests.flights.missions import frame_id, meta_of

Line = dict[str, Any]
AROUND, FIVE, BATCH = 20, 5, 25
PAIRS, WORDS = 8, 1024
"""A photo is matched with so many of those nearest to it; the length of its words."""
NONE = np.zeros((0, 2), np.float32)


@dataclass(frozen=True)
class Photo:
    """One photo to come. `world`: photos of different ones never match."""

    frame_id: str
    params: FlightParams
    shot: Shot
    world: int


def photos(frames: int, drones: int, apart: bool) -> list[Photo]:
    """All photos by the time of capture. `apart`: drones over the same place whose ground looks otherwise."""
    plan = FlightParams(frames=frames, drones=drones, gps_noise_m=2.0, cars=0, seed=1)
    each = replace(plan, frames=frames // drones, drones=1)
    plans = [replace(each, seed=k + 1) for k in range(drones)] if apart else [plan]
    found = []
    for number, params in enumerate(plans):
        for shot in plan_flight(params).shots:
            named = replace(shot, name=f"{number}-{shot.name}", drone=shot.drone + number)
            found.append(Photo(frame_id(named), params, named, number))
    return sorted(found, key=lambda p: (p.shot.captured_s, p.frame_id))


@dataclass
class Grown:
    """A mission into which photos come; the clocks of its stages tell what that costs."""

    stages: Stages
    mission_id: str
    there: dict[str, Photo] = field(default_factory=dict)
    chance: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def matched(self, photo: Photo) -> None:
        """From upload to matched."""
        from services.catalog import frames
        from workers.photos import features_key

        key, meta = (self.mission_id, photo.frame_id), meta_of(photo.params, photo.shot)
        self.stages.store.put(features_key(*key), self._features(photo).to_bytes())
        with self.stages.db.write() as tx:
            frames.receive(tx, *key, photo.shot.name, 1000, "image/jpeg", meta.width, meta.height)
            frames.mark_ready(tx, *key, meta)
        near = sorted(self.there.values(), key=lambda p: (self._away_m(p, photo), p.frame_id))[:PAIRS]
        self.there[photo.frame_id] = photo
        self._match([(p.frame_id, photo.frame_id) for p in near])
        with self.stages.db.write() as tx:
            frames.mark_matched(tx, *key)

    def posed(self) -> None:
        """The sequencer, and all that it asks for, until nothing is left to do."""
        self.stages.send("sequence", self.mission_id)
        while self.stages.queue:
            for _, args in self.stages.taken("match"):
                self._match(args[2])
                self.stages.send("sequence", self.mission_id)
            for _, args in self.stages.taken("fuse"):
                self._drawn(args[1])
            self.stages.taken("publish")
            for _, args in self.stages.taken("sequence"):
                self.stages.handle("sequence", *args)

    def _match(self, wanted: Sequence[Sequence[str]]) -> None:
        """The rows of a match task."""
        from services.catalog import pairs
        from services.catalog.pairs import PairResult

        results = []
        for low, high in sorted(sorted(pair) for pair in wanted):
            a, b = self.there[low], self.there[high]
            ends = ((low, a.shot), (high, b.shot))
            found = matched(self.chance, a.params.base_alt_m, ends) if a.world == b.world else None
            if found is None:
                results.append(PairResult(low, high, False, "too_few_matches", 0, {}, None))
            else:
                count = found.counts.final
                results.append(
                    PairResult(low, high, True, "ok", count, asdict(found.counts), found.to_bytes())
                )
        with self.stages.db.write() as tx:
            pairs.claim(tx, self.mission_id, None, [(r.low, r.high) for r in results])
            pairs.record(tx, self.mission_id, results)

    def _drawn(self, keys: Sequence[Sequence[int]]) -> None:
        """The rows of a fuse task and of what publishes it."""
        from services.catalog import backlog, missions, tiles
        from services.catalog.tiles import Render

        with self.stages.db.write() as tx:
            row = missions.get(tx, self.mission_id)
            wanted = backlog.unrendered(tx, self.mission_id, [(k[0], k[1], k[2]) for k in keys])
            done = [Render(k, t.generation, "none", f"{t.generation}") for k, t in wanted.items()]
            tiles.record_renders(tx, self.mission_id, done)
            tiles.publish(tx, self.mission_id, row.revision, done, done)
        self.stages.send("sequence", self.mission_id)

    @staticmethod
    def _away_m(a: Photo, b: Photo) -> float:
        return float(np.hypot(*(a.shot.pose.center - b.shot.pose.center)[:2]))

    def _features(self, photo: Photo) -> Features:
        """Words alike where the same ground is seen, in either world; no keypoints."""
        waves = np.random.default_rng(7).normal(0, 1 / 40, (2, WORDS))
        place = photo.shot.pose.center[:2] - np.array([0.0, 0.0])
        words = np.cos(place @ waves + 7.0 * waves[0]) + self.chance.normal(0, 0.7, WORDS)
        words = (words / np.linalg.norm(words)).astype(np.float32)
        thumb = np.full((8, 8, 4), 128, np.uint8)
        return Features(NONE, NONE[:, 0], NONE[:, 0], np.zeros((0, 128), np.uint8), words, thumb)


def watched(made: Stages) -> None:
    """Books the parts of the sequencer's work that are worth a line."""
    from services.catalog import backlog, poses, tiles

    sequence, clocks = made.modules["sequence"], made.clocks
    for owner, name, label in (
        (backlog, "of", "backlog"),
        (sequence, "place", None),
        (sequence, "joined", None),
        (sequence.Known, "grown", None),
        (sequence, "held", "leases"),
        (sequence, "_due", "due"),
        (sequence.solving, "matches", None),
        (sequence.tying, "look", None),
        (sequence.tying, "tied", None),
        (poses, "save", None),
        (tiles, "fuse_frames", None),
        (tiles, "claim_dirty", None),
        (sequence, "_solved_again", "global solve"),
    ):
        clocks.watch(owner, name, label)


def serial_ms(frames: int, drones: int, apart: bool, at: Sequence[int]) -> Line:
    """Milliseconds of the sequencer a photo, mean over the photos around each of `at`."""
    everyone = photos(max(frames, max(at) + AROUND), drones, apart)
    with tempfile.TemporaryDirectory(prefix="orthostream-bench-") as folder:
        made = stages(Path(folder))
        watched(made)
        from services.catalog import missions

        with made.db.write() as tx:
            grown = Grown(made, missions.create(tx, "bench").id)
        kind = "never tied" if apart else "side by side"
        head: Line = {"bench": "sequencer", "photos": len(everyone), "drones": drones, "maps": kind}
        return head | _run(grown, everyone, at)


def _run(grown: Grown, everyone: list[Photo], at: Sequence[int]) -> Line:
    clocks, found, solves = grown.stages.clocks, dict[str, Line](), Spent()

    def come(count: int, at_a_time: int) -> Line:
        clocks.clear()
        some = [everyone.pop(0) for _ in range(min(count, len(everyone)))]
        for k, photo in enumerate(some, 1):
            grown.matched(photo)
            if k % at_a_time == 0 or k == len(some):
                grown.posed()
        solved = clocks.of("global solve")
        solves.count, solves.cpu_s = solves.count + solved.count, solves.cpu_s + solved.cpu_s
        return _figures(clocks.spent, len(some)) if some else {}

    number = len(everyone)
    for n in sorted(at):
        come(n - AROUND - (number - len(everyone)), BATCH)
        found[str(n)] = {"one by one": come(AROUND, 1), "in fives": come(AROUND, FIVE)}
    come(len(everyone), BATCH)
    return {"at": found, "global solves": solves.count, "their cpu_s": round(solves.cpu_s, 2)}


def _figures(spent: dict[str, Spent], photos: int) -> Line:
    """`serial`: the sequencer without the global solves."""
    all_of_it, solves = spent.get("sequence", Spent()), spent.get("global solve", Spent())
    serial = Spent(all_of_it.cpu_s - solves.cpu_s, all_of_it.wall_s - solves.wall_s)
    parts = {name: s.ms(photos)["cpu_ms"] for name, s in sorted(spent.items())}
    return {"serial": serial.ms(photos), "cpu_ms": parts}
