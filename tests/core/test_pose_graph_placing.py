"""New frames are placed among posed ones, which stay where they are."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from core.pose_graph import GraphFrame, Solution, place, solve
from tests.flights.strips import (
    HEIGHT_M,
    Flight,
    fly,
    route_errors,
    shape_error_m,
    sources,
    without_gps,
    wrong_matches,
)


def by_id(frames: Iterable[GraphFrame]) -> dict[str, GraphFrame]:
    """As `place` is told of them."""
    return {f.frame_id: f for f in frames}


def live(flight: Flight, first: int) -> tuple[Solution, Solution]:
    """Solved with the first frames, and with the others placed one by one."""
    ids = [f.frame_id for f in flight.frames]
    before = solution = solve(flight.frames[:first], flight.matches)
    for k in range(first, len(ids)):
        known = set(ids[: k + 1])
        ties = [m for m in flight.matches if ids[k] in (m.low, m.high) and {m.low, m.high} <= known]
        solution = place(solution, by_id(flight.frames[: k + 1]), [ids[k]], ties)
    return before, solution


def test_placed_frames_fit_and_posed_ones_stay() -> None:
    flight = fly()
    before, after = live(flight, 36)
    assert len(after.poses) == 48
    assert sources(after) == ["visual"]
    assert all(after.poses[k] is p for k, p in before.poses.items())
    assert shape_error_m(flight, after)[0] < 0.3


def test_placing_does_not_depend_on_the_order_of_anything() -> None:
    flight, rng = fly(), np.random.default_rng(2)
    base = solve(flight.frames[:36], flight.matches)
    new = [f.frame_id for f in flight.frames[36:]]
    one = place(base, by_id(flight.frames), new, flight.matches)
    other = place(
        base,
        by_id(flight.frames[k] for k in rng.permutation(48)),
        set(new),
        [flight.matches[k] for k in rng.permutation(len(flight.matches))],
    )
    assert {k: p.center.tobytes() for k, p in one.poses.items()} == {
        k: p.center.tobytes() for k, p in other.poses.items()
    }


def test_a_wrong_match_does_not_misplace_a_new_frame() -> None:
    flight = fly()
    new = flight.frames[30].frame_id
    rest = [m for m in flight.matches if new not in (m.low, m.high)]
    base = solve([f for f in flight.frames if f.frame_id != new], rest)
    wrong = [m for m in wrong_matches(flight, 400) if new in (m.low, m.high)][:3]
    placed = place(base, by_id(flight.frames), [new], [*flight.matches, *wrong])
    clean = place(base, by_id(flight.frames), [new], flight.matches)
    assert wrong
    np.testing.assert_allclose(placed.poses[new].center, clean.poses[new].center, atol=0.3)


def test_a_new_frame_that_ties_to_nothing_falls_back_or_is_refused() -> None:
    flight = fly()
    base = solve(flight.frames[:40], flight.matches)
    blind = replace(flight.frames[41], meta=replace(flight.frames[41].meta, gps=None))
    frames = [*flight.frames[:41], blind]
    placed = place(base, by_id(frames), [frames[40].frame_id, blind.frame_id], [])
    assert placed.poses[frames[40].frame_id].source == "gnss"
    assert placed.unplaced[blind.frame_id] == "not_placeable"


def test_frames_are_placed_in_a_map_without_gps() -> None:
    flight = without_gps(fly()).with_meta(lambda _, m: replace(m, relative_alt_m=HEIGHT_M))
    before, after = live(flight, 36)
    assert sources(after) == ["vision-only"]
    assert len(after.poses) == 48
    assert all(after.poses[k] is p for k, p in before.poses.items())
    assert route_errors(flight, after)[0] < 0.01
    assert all(p.sigma_m for p in after.poses.values())


class _NotAll(UserDict[str, Any]):
    """Whom one may ask for by name, but not go through."""

    def __iter__(self) -> Iterator[str]:
        raise AssertionError("all were gone through")


def test_placing_looks_at_matched_frames_only() -> None:
    flight = fly(8, 25)
    base = solve(flight.frames[:190], flight.matches)
    new = flight.frames[195].frame_id
    ties = [m for m in flight.matches if new in (m.low, m.high)]
    near = {new} | {m.low for m in ties} | {m.high for m in ties}
    some = by_id(f for f in flight.frames if f.frame_id in near)
    fewer = place(replace(base, poses={k: p for k, p in base.poses.items() if k in near}), some, [new], ties)
    everyone = replace(base, poses=_NotAll(base.poses))
    whole = place(everyone, _NotAll(by_id(flight.frames)), [new], ties)
    assert whole.poses[new].center.tobytes() == fewer.poses[new].center.tobytes()
