"""Ties between maps, looked for while drones still fly: a few pairs for every frame."""

from __future__ import annotations

from collections import OrderedDict

from core.gallery import Gallery
from core.neighbours import Sighting
from core.pose_graph import GraphFrame
from core.ties import live_ties
from services.catalog import pairs
from services.catalog.pairs import Key as PairKey
from workers.app import db
from workers.photos import shelf
from workers.posing import Known

LOOKING = 32
"""Frames that look for ties at a time."""
_REMEMBERED = 8

_galleries: OrderedDict[str, Gallery] = OrderedDict()


def sighting(mission_id: str, frame: GraphFrame) -> Sighting:
    """A frame as the search for partners sees it."""
    meta, words = frame.meta, shelf.words_of(mission_id, frame.frame_id)
    return Sighting(frame.frame_id, meta.captured_s, frame.name, meta.drone, meta.gps, words)


def look(mission_id: str, known: Known) -> list[PairKey]:
    """Pairs that may tie two maps, for some frames that have not looked yet; they are kept as `tries`."""
    homes = known.homes
    if homes.maps < 2:
        known.untried.clear()
        return []
    seekers = sorted(known.untried)[:LOOKING]
    known.untried -= set(seekers)
    with db.read() as tx:
        tried = pairs.keys_of(tx, mission_id, seekers)
    gallery = _gallery(mission_id)
    gallery.add(
        sighting(mission_id, known.seen[k])
        for k in sorted(k for k in known.seen if k not in gallery.row_of and k in homes)
    )
    found = live_ties(seekers, gallery, homes, tried)
    known.tries |= set(found)
    return found


def _gallery(mission_id: str) -> Gallery:
    """What this process has seen of the mission's pictures."""
    gallery = _galleries.pop(mission_id, None) or Gallery()
    while len(_galleries) >= _REMEMBERED:
        _galleries.popitem(last=False)
    _galleries[mission_id] = gallery
    return gallery


def tied(mission_id: str, known: Known) -> bool:
    """Whether a pair that was tried, and is matched by now, ties two maps."""
    with db.read() as tx:
        verdicts = pairs.verdicts(tx, mission_id, known.tries)
    known.tries -= verdicts.keys()
    homes = known.homes
    return any(good and homes.get(a) != homes.get(b) for (a, b), good in verdicts.items())
