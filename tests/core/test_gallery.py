"""A growing mission's pictures: those near some others, and ties between maps while drones fly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.frame import GpsFix
from core.gallery import Gallery, apart
from core.neighbours import Sighting, metres, peculiar
from core.ties import TieParams, live_ties

RNG = np.random.default_rng(5)
FAR = TieParams(per_frame=2, per_tie=8)


def flight(n: int = 60, without_gps: int = 7) -> list[Sighting]:
    """Pictures along a line, each much like the one beside it on the other drone's line 40 m away."""
    looks = RNG.normal(size=(n // 2, 64)) + 2.0
    found = []
    for k in range(n):
        words = looks[k % (n // 2)] + 0.2 * RNG.normal(size=64)
        fix = GpsFix(47.0 + 0.00036 * (k >= n // 2), 8.0 + 0.0004 * (k % (n // 2)))
        named = f"{(k * 7919) % 9973:05d}"
        found.append(Sighting(named, float(k), named, f"drone {k >= n // 2}", fix, np.float32(words)))
    return [replace(s, gps=None) if k % 9 == without_gps else s for k, s in enumerate(found)]


def gallery_of(sightings: list[Sighting]) -> Gallery:
    gallery = Gallery()
    gallery.add(sightings)
    return gallery


def test_those_near_are_those_within_reach_and_those_without_gps() -> None:
    frames = flight()
    gallery = gallery_of(frames)
    located = [k for k, f in enumerate(frames) if f.gps is not None]
    at = dict(zip((frames[k].frame_id for k in located), metres(frames, located), strict=True))
    for seeker in frames:
        here = at.get(seeker.frame_id)
        expected = {
            f.frame_id
            for f in frames
            if here is None or f.frame_id not in at or np.hypot(*(at[f.frame_id] - here)) <= 200.5
        }
        assert gallery.within([seeker.frame_id], 200.5) == expected
    some = [f.frame_id for f in frames[3:6]]
    assert gallery.within(some, 90.0) == set().union(*(gallery.within([k], 90.0) for k in some))


def test_a_gallery_grows_to_what_it_would_have_been_at_once() -> None:
    frames = flight(400)
    at_once, grown = gallery_of(frames), Gallery()
    for sighting in frames:
        grown.add([sighting, frames[0]])
    ids = [f.frame_id for f in frames]
    assert grown.row_of == at_once.row_of
    np.testing.assert_array_equal(grown.words(ids), at_once.words(ids))
    np.testing.assert_array_equal(grown.average, at_once.average)
    assert grown.within(ids[:3], 100.0) == at_once.within(ids[:3], 100.0)


def test_pictures_are_set_apart_as_in_the_final_search() -> None:
    frames = flight()
    gallery = gallery_of(frames)
    found = apart(gallery.words(f.frame_id for f in frames), gallery.average)
    np.testing.assert_allclose(found, peculiar(np.stack([f.words for f in frames])), atol=2e-3)


def test_ties_are_found_between_maps_alone_whatever_the_order_of_arrival() -> None:
    frames = flight()
    homes = {f.frame_id: f.drone for f in frames}
    seekers = [f.frame_id for f in frames]
    found = live_ties(seekers, gallery_of(frames), homes, [], FAR)
    assert 0 < len(found) <= FAR.per_tie
    assert all(homes[a] != homes[b] for a, b in found)
    twin = {f.frame_id: frames[(k + 30) % 60].frame_id for k, f in enumerate(frames)}
    assert all(twin[a] == b for a, b in found)
    shuffled = [frames[k] for k in RNG.permutation(len(frames))]
    assert live_ties(seekers[::-1], gallery_of(shuffled), homes, [], FAR) == found
    again = live_ties(seekers, gallery_of(frames), homes, found, FAR)
    assert again
    assert not set(again) & set(found)


def test_one_map_and_maps_out_of_reach_ask_for_nothing() -> None:
    frames = [f for f in flight() if f.gps is not None]
    seekers = [f.frame_id for f in frames]
    assert live_ties(seekers, gallery_of(frames), dict.fromkeys(seekers, 0), [], FAR) == []
    homes = {f.frame_id: f.drone for f in frames}
    near = replace(FAR, reach_m=30.0)
    assert live_ties(seekers, gallery_of(frames), homes, [], near) == []
    assert live_ties(seekers, gallery_of(frames), homes, [], FAR)
