"""A frame that was read → its matches with neighbours that are there; or pairs that the final solve needs."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np
from sqlalchemy.orm import Session

from core.frame import FrameMeta
from core.gallery import Gallery
from core.matching import match_pair
from core.neighbours import NeighbourParams, Sighting
from core.vocabulary import LOOKS
from services.catalog import arrivals, backlog, frames, missions, pairs
from services.catalog.arrivals import Arrived
from services.catalog.pairs import Key, PairResult
from services.queue import send
from workers.app import Stopwatch, db, settings, stage
from workers.photos import shelf

LIVE = NeighbourParams(nearest=3, sectors=4, before_and_after=1, alike=1)
"""While photos come in, a few neighbours each hold them; the final solve asks for the pairs that it wants.

Who is near changes with every photo: what more is asked for now, nobody may want in the end.
"""
CALM_S = 0.5
LOOK_AGAIN_S = 60.0
"""So often all frames are looked for, lest one be missed for good that was written late."""
_REMEMBERED = 8


@dataclass(slots=True)
class _Mission:
    """What this process knows of one: its mode, which never changes, and the frames that were read."""

    mode: str
    metas: dict[str, FrameMeta] = field(default_factory=dict)
    gallery: Gallery = field(default_factory=Gallery)
    newest: float | None = None
    look_again: float = 0.0

    def look(self, tx: Session, mission_id: str, wanted: Collection[str]) -> None:
        """Take in what came since, and these frames; of those that are known nothing is read again."""
        now = time.monotonic()
        since = self.newest if now < self.look_again else None
        if since is None:
            self.look_again = now + LOOK_AGAIN_S
        for frame in arrivals.since(tx, mission_id, since, self.metas, wanted):
            self.metas[frame.frame_id] = frame.meta
            self.gallery.add([_sighting(frame)])
            self.newest = max(self.newest or 0.0, frame.ready_at)


def _sighting(frame: Arrived) -> Sighting:
    meta = frame.meta
    words = np.frombuffer(frame.looks, np.float16) if frame.looks else np.zeros(LOOKS)
    return Sighting(
        frame.frame_id, meta.captured_s, frame.name, meta.drone, meta.gps, words.astype(np.float32)
    )


_known: OrderedDict[str, _Mission] = OrderedDict()


@stage("match")
def match(mission_id: str, frame_id: str | None, wanted: Sequence[Key] = ()) -> None:
    """From ready to matched; without a frame id, the `wanted` pairs for the final solve."""
    clock = Stopwatch()
    with db.read() as tx:
        mission = _looked(tx, mission_id, {frame_id} if frame_id else {k for pair in wanted for k in pair})
        if frame_id is not None and not arrivals.is_ready(tx, mission_id, frame_id):
            send("sequence", mission_id)
            return
    if frame_id is not None:
        wanted = neighbours(mission.gallery, frame_id) if mission.mode == "visual" else []
    here = [(a, b) for a, b in wanted if a in mission.metas and b in mission.metas]  # one may be lost
    with db.write(durable=False) as tx:
        mine = pairs.claim(tx, mission_id, frame_id, here)
    results = [computed(mission_id, mission.metas, pair) for pair in mine]
    with db.write(durable=False) as tx:
        pairs.record(tx, mission_id, results)
        if frame_id is not None:
            frames.mark_matched(tx, mission_id, frame_id)
        clock.spend(tx, mission_id, "match")
        news = frame_id is None or backlog.is_news(tx, mission_id, frame_id, CALM_S, settings.workers)
    if news:
        send("sequence", mission_id)


def _looked(tx: Session, mission_id: str, wanted: Collection[str]) -> _Mission:
    """The mission, with all frames that were read by now."""
    mission = _known.pop(mission_id, None) or _Mission(missions.get(tx, mission_id).mode)
    while len(_known) >= _REMEMBERED:
        _known.popitem(last=False)
    _known[mission_id] = mission
    mission.look(tx, mission_id, wanted)
    return mission


def neighbours(gallery: Gallery, frame_id: str) -> list[Key]:
    """The pairs of one frame with those that are there."""
    return gallery.partners(frame_id, LIVE)


def computed(mission_id: str, metas: Mapping[str, FrameMeta], pair: Key) -> PairResult:
    """One pair, matched. `metas`: at least those of its frames."""
    low, high = (shelf.features_of(mission_id, f) for f in pair)
    cameras = [metas[f].camera() for f in pair]
    found = match_pair(pair[0], low, pair[1], high, cameras[0], cameras[1])
    matches = found.to_bytes() if found.accepted else None
    counts = asdict(found.counts)
    return PairResult(*pair, found.accepted, found.reason, found.counts.final, counts, matches)
