"""What all poses of a mission are solved from: its photos, their matches, and how bright they are."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Mapping

from core.glance import Glance, glance
from core.matching import PairMatch
from core.mosaic import Layout, lay_out, solved
from core.pose_graph import Solution
from core.scale import KnownScale
from core.submaps import SubmapGraph
from core.ties import Canonical
from services.catalog import pairs
from services.tables import Mission
from workers import surveyed
from workers.app import db, settings
from workers.photos import BytesLru, shelf
from workers.posing import Known

_glances = BytesLru(settings.photo_cache_bytes // 2)
"""A sequencer draws no tiles: what others hold photos with holds the glances of every solve."""
_OVERHEAD_BYTES = 400
_TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's


def matches(mission_id: str, touching: Collection[str] | None) -> list[PairMatch]:
    """The accepted matches, of all pairs or of those of some frames, by (low, high)."""
    with db.read() as tx:
        if touching is None:
            return [PairMatch.from_bytes(m) for m in pairs.all_accepted(tx, mission_id)]
        return [PairMatch.from_bytes(m) for m in pairs.accepted(tx, mission_id, touching)]


def glances(mission_id: str) -> Callable[[str], Glance]:
    """A frame's glance by its id. That raises ObjectNotFound."""

    def look(frame_id: str) -> Glance:
        def load() -> tuple[Glance, int]:
            found = glance(shelf.features_of(mission_id, frame_id).thumb)
            return found, found.colours.nbytes + _OVERHEAD_BYTES

        found: Glance = _glances.get((mission_id, frame_id), load)
        return found

    return look


def again(mission: Mission, known: Known) -> tuple[Solution, SubmapGraph]:
    """All poses, from what is matched by now."""
    accepted = matches(mission.id, None) if mission.mode == "visual" else []
    accepted = [m for m in accepted if {m.low, m.high} <= known.seen.keys()]  # one's photo may be lost
    seen, points = [known.seen[k] for k in sorted(known.seen)], surveyed.points_of(mission.id)
    return solved(seen, Canonical((), (), tuple(accepted)), KnownScale.from_json(mission.scale), points)


def laid_out(
    mission: Mission, camera_keys: Mapping[str, str], found: Solution, before: Layout | None = None
) -> Layout:
    """Where and how bright every frame is drawn. Raises ObjectNotFound."""
    _settle()
    side, mode = mission.drawn_side, mission.mode
    layout = lay_out(found, camera_keys, glances(mission.id), side, before, mode)
    _settle()
    return layout


def _settle() -> None:
    """Hand back what a solve of thousands of photos took, which the allocator would keep for the next one."""
    if _TRIM is not None:
        _TRIM(0)
