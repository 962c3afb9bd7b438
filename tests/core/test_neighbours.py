"""Candidates: a function of the set of frames that finds partners by place, by time and by looks."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np

from core.frame import GpsFix
from core.gallery import Gallery
from core.neighbours import NeighbourParams, Pair, Sighting, candidates

METRE = 1 / 111_320


def flight(rows: int = 6, columns: int = 9, noise_m: float = 0.0, seed: int = 0) -> list[Sighting]:
    """Serpentine lines 40 m apart, a frame every 25 m; looks that change smoothly with the place."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(64, 2)) / 60
    phase = rng.uniform(0, 2 * np.pi, 64)
    frames = []
    for k in range(rows * columns):
        row, column = divmod(k, columns)
        east, north = 25.0 * (column if row % 2 == 0 else columns - 1 - column), 40.0 * row
        words = np.cos(directions @ (east, north) + phase) + 0.1 * rng.normal(size=64)
        at = np.array((east, north)) + noise_m * rng.normal(size=2)
        frames.append(
            Sighting(
                frame_id=f"{(k * 7919) % 100003:032x}",
                captured_s=1000.0 + 2 * k,
                name=f"IMG_{k:04d}.JPG",
                drone="one",
                gps=GpsFix(50 + at[1] * METRE, 8 + at[0] * METRE / np.cos(np.radians(50)), 100.0),
                words=(words / np.linalg.norm(words)).astype(np.float32),
            )
        )
    return frames


def place(k: int, columns: int = 9) -> np.ndarray:
    row, column = divmod(k, columns)
    return np.array((25.0 * (column if row % 2 == 0 else columns - 1 - column), 40.0 * row))


def key(a: Sighting, b: Sighting) -> Pair:
    return min(a.frame_id, b.frame_id), max(a.frame_id, b.frame_id)


def next_to_each_other(frames: list[Sighting]) -> set[Pair]:
    """Pairs whose true places are at most 47.2 m apart: the eight around each frame."""
    return {
        key(frames[i], frames[j])
        for i in range(len(frames))
        for j in range(i)
        if np.linalg.norm(place(i) - place(j)) < 47.3
    }


def connected(frames: list[Sighting], pairs: set[Pair]) -> bool:
    reached, todo = {frames[0].frame_id}, [frames[0].frame_id]
    while todo:
        at = todo.pop()
        for a, b in pairs:
            for here, there in ((a, b), (b, a)):
                if here == at and there not in reached:
                    reached.add(there)
                    todo.append(there)
    return len(reached) == len(frames)


def test_pairs_are_sorted_unique_and_low_id_first() -> None:
    pairs = candidates(flight())
    assert pairs == sorted(set(pairs))
    assert all(low < high for low, high in pairs)


def test_the_order_of_input_does_not_matter() -> None:
    frames = flight(noise_m=10)
    expected = candidates(frames)
    for seed in range(5):
        shuffled = random.Random(seed).sample(frames, len(frames))
        assert candidates(shuffled) == expected


def test_good_gps_finds_every_neighbour_within_a_bounded_number_of_pairs() -> None:
    frames = [replace(f, captured_s=None, drone=f.name) for f in flight()]
    pairs = candidates(frames)
    assert next_to_each_other(frames) <= set(pairs)
    assert len(pairs) <= 12 * len(frames)


def test_a_dense_line_does_not_hide_the_next_line() -> None:
    frames = flight()
    fix = frames[0].gps
    assert fix is not None
    lines = [
        replace(
            frames[k],
            captured_s=None,
            drone=str(k),
            words=np.zeros(64, np.float32),
            gps=replace(fix, lon_deg=8 + (k % 25) * 2 * METRE, lat_deg=50 + (k // 25) * 40 * METRE),
        )
        for k in range(50)
    ]
    pairs = set(candidates(lines, NeighbourParams(alike=0)))
    across = {(a, b) for a in range(25) for b in range(25, 50) if key(lines[a], lines[b]) in pairs}
    assert {a for a, _ in across} == set(range(25))


def test_gps_sixty_metres_off_still_finds_true_neighbours() -> None:
    frames = flight(noise_m=60)
    found = set(candidates(frames)) & next_to_each_other(frames)
    assert connected(frames, found)
    assert len(found) > 0.5 * len(next_to_each_other(frames))


def test_frames_without_gps_find_partners_by_looks_alone() -> None:
    frames = [replace(f, gps=None, captured_s=None, drone=f.name) for f in flight()]
    found = set(candidates(frames)) & next_to_each_other(frames)
    assert connected(frames, found)


def test_one_frame_without_gps_among_others_with_it() -> None:
    frames = flight()
    frames[30] = replace(frames[30], gps=None, captured_s=None, drone="another")
    mine = {p for p in candidates(frames) if frames[30].frame_id in p}
    assert len(mine & next_to_each_other(frames)) >= 3


def test_time_ties_frames_of_one_drone_and_no_others() -> None:
    blank = np.zeros(64, np.float32)
    frames = [replace(f, gps=None, words=blank, drone="ab"[k % 2]) for k, f in enumerate(flight())]
    pairs = set(candidates(frames, NeighbourParams(alike=0, alike_without_gps=0, before_and_after=2)))
    expected = {key(frames[i], frames[i + s]) for s in (2, 4) for i in range(len(frames) - s)}
    assert pairs == expected


def test_identical_fixes_are_tolerated_and_do_not_blot_out_the_rest() -> None:
    frames = flight()
    stuck = [replace(f, gps=frames[20].gps) if 18 <= k <= 32 else f for k, f in enumerate(frames)]
    pairs = candidates(stuck)
    assert connected(stuck, set(pairs))
    assert len(pairs) <= 13 * len(stuck)
    all_the_same = [replace(f, gps=frames[0].gps) for f in frames]
    assert connected(all_the_same, set(candidates(all_the_same)))


def test_few_frames() -> None:
    frames = flight()
    assert candidates([]) == []
    assert candidates(frames[:1]) == []
    assert candidates(frames[:2]) == [key(frames[0], frames[1])]
    assert candidates([frames[0], frames[0]]) == []
    assert partners_of(frames[0], []) == []


def partners_of(new: Sighting, others: list[Sighting], params: NeighbourParams | None = None) -> list[Pair]:
    """As they come: first the others, then the new one."""
    gallery = Gallery()
    gallery.add([*others, new])
    return gallery.partners(new.frame_id, params)


def test_live_partners_are_of_the_new_frame_only_and_those_of_all_frames_at_once() -> None:
    frames = flight(noise_m=5)
    gallery = Gallery()
    gallery.add(random.Random(2).sample(frames, len(frames)))
    each = {f.frame_id: gallery.partners(f.frame_id) for f in frames}
    for frame_id, found in each.items():
        assert found == sorted(set(found))
        assert all(frame_id in pair and pair[0] < pair[1] for pair in found)
    union = {pair for found in each.values() for pair in found}
    assert union == set(candidates(frames)) >= next_to_each_other(frames)


def test_each_reason_alone_finds_live_what_it_finds_in_all_frames_at_once() -> None:
    frames = [replace(f, drone="ab"[k % 2]) for k, f in enumerate(flight(noise_m=5))]
    none = NeighbourParams(nearest=0, sectors=0, before_and_after=0, alike=0, alike_without_gps=0)
    lost = [replace(f, gps=None) for f in frames]
    for some, params in (
        (lost, replace(none, before_and_after=2)),
        (lost, replace(none, alike_without_gps=5)),
        (frames, replace(none, nearest=4)),
        (frames, replace(none, nearest=1, sectors=8)),
        (frames, replace(none, alike=3)),
    ):
        gallery = Gallery()
        gallery.add(some[::-1])
        found = {pair for f in some for pair in gallery.partners(f.frame_id, params)}
        assert found == set(candidates(some, params)) != set()


def test_live_partners_do_not_depend_on_the_order_of_arrival() -> None:
    frames = [replace(f, gps=None) if k % 5 == 0 else f for k, f in enumerate(flight(noise_m=20))]
    new, others = frames[31], frames[:31] + frames[32:]
    found = partners_of(new, others)
    assert partners_of(new, others[::-1]) == partners_of(new, frames) == found


def test_a_drone_that_hovers_is_one_position_and_does_not_hide_the_others() -> None:
    frames = flight(rows=20, noise_m=2)
    stuck = [replace(f, gps=frames[20].gps) if 10 <= k <= 160 else f for k, f in enumerate(frames)]
    fix_of = {f.frame_id: f.gps for f in stuck}
    params = NeighbourParams(nearest=3, sectors=4, before_and_after=0, alike=0)
    gallery = Gallery()
    gallery.add(stuck)
    for frame in stuck:
        found = gallery.partners(frame.frame_id, params)
        elsewhere = {fix_of[k] for pair in found for k in pair} - {frame.gps}
        assert params.nearest <= len(elsewhere) <= params.nearest + params.sectors
        assert len(found) <= len(elsewhere) + 2


def test_frames_across_the_date_line_are_near() -> None:
    a, b, *_ = flight()
    west = replace(a, gps=GpsFix(0.0, -179.99999), captured_s=None, drone="w")
    east = replace(b, gps=GpsFix(0.0, 179.99999), captured_s=None, drone="e")
    far = [
        replace(f, gps=GpsFix(0.0, 179.9 - k * 1e-3), captured_s=None, drone=f.name)
        for k, f in enumerate(flight()[2:])
    ]
    params = NeighbourParams(nearest=1, sectors=0, alike=0)
    assert key(west, east) in candidates([west, east, *far], params)
    assert key(west, east) in partners_of(west, [east, *far], params)


def test_a_lost_fix_far_away_changes_nobody_elses_partners() -> None:
    frames = flight(noise_m=5)
    stray = replace(frames[0], frame_id="f" * 32, gps=GpsFix(0.0, 0.0), captured_s=None, drone="x")
    params = NeighbourParams(alike=0)
    assert partners_of(frames[31], [stray, *frames], params) == partners_of(frames[31], frames, params)
