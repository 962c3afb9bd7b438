"""What the one owner of a mission costs a photo, while the mission grows: its real code on its real database.

Photos are projected landmarks (`tests.flights.landmarks`), matched by the program's own stage; tiles are not
drawn, but their rows go all their way. Around each of `--at` photos come one by one and then in fives, as
they do at ten a second; else in large batches.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from core.features import Features
from core.simulation import FlightParams, Shot, plan_flight
from tests.bench.stages import Spent, Stages, stages
from tests.flights.landmarks import LandmarkParams, features
from tests.flights.missions import frame_id, meta_of

Line = dict[str, Any]
AROUND, FIVE, BATCH = 20, 5, 25


@dataclass(frozen=True)
class Photo:
    """One photo to come."""

    frame_id: str
    params: FlightParams
    shot: Shot
    features: Features


def photos(frames: int, drones: int, apart: bool) -> list[Photo]:
    """All photos by the time of capture. `apart`: drones over the same place whose ground looks otherwise."""
    plan = FlightParams(frames=frames, drones=drones, gps_noise_m=2.0, cars=0, seed=1)
    plans = [plan]
    if apart:
        each = replace(plan, frames=frames // drones, drones=1)
        plans = [replace(each, seed=k + 1) for k in range(drones)]
    found = [
        photo for number, params in enumerate(plans, 1) for photo in _flown(params, number if apart else 0)
    ]
    return sorted(found, key=lambda p: (p.shot.captured_s, p.frame_id))


def _flown(params: FlightParams, drone: int) -> Iterator[Photo]:
    flight = plan_flight(params)
    for shot, seen in zip(flight.shots, features(flight, LandmarkParams(keypoints=300)), strict=True):
        named = replace(shot, name=f"{drone}-{shot.name}", drone=drone) if drone else shot
        yield Photo(frame_id(named), params, named, seen)


@dataclass
class Grown:
    """A mission into which photos come; `clocks` of the stages tell what that cost."""

    stages: Stages
    mission_id: str

    def matched(self, photo: Photo) -> None:
        """From upload to matched, by the stage itself but for the photo's reading."""
        from services.catalog import frames
        from workers.photos import features_key

        self.stages.store.put(features_key(self.mission_id, photo.frame_id), photo.features.to_bytes())
        meta = meta_of(photo.params, photo.shot)
        size = (meta.width, meta.height)
        with self.stages.db.write() as tx:
            key = (self.mission_id, photo.frame_id)
            frames.receive(tx, *key, photo.shot.name, 1000, "image/jpeg", *size)
            frames.mark_ready(tx, *key, meta)
        self.stages.handle("match", self.mission_id, photo.frame_id)

    def posed(self) -> None:
        """The sequencer, and all that it asks for, until nothing is left to do."""
        self.stages.send("sequence", self.mission_id)
        while self.stages.queue:
            for _, args in self.stages.taken("match"):
                self.stages.handle("match", *args)
            for _, args in self.stages.taken("fuse"):
                self._drawn(args[1])
            self.stages.taken("publish")
            for _, args in self.stages.taken("sequence"):
                self.stages.handle("sequence", *args)

    def _drawn(self, keys: Sequence[Sequence[int]]) -> None:
        """The rows of a fuse task and of what publishes it, without a picture."""
        from services.catalog import backlog, missions, tiles
        from services.catalog.tiles import Render

        with self.stages.db.write() as tx:
            row = missions.get(tx, self.mission_id)
            wanted = backlog.unrendered(tx, self.mission_id, [(k[0], k[1], k[2]) for k in keys])
            done = [Render(k, t.generation, "none", f"{t.generation}") for k, t in wanted.items()]
            tiles.record_renders(tx, self.mission_id, done)
            tiles.publish(tx, self.mission_id, row.revision, done, done)
        self.stages.send("sequence", self.mission_id)


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
    parts = {name: s.ms(photos)["cpu_ms"] for name, s in sorted(spent.items()) if name != "match"}
    return {"serial": serial.ms(photos), "match": spent["match"].ms(photos), "cpu_ms": parts}
