"""What a process keeps is bounded by bytes, and overviews of quarters are reductions of their children."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from core.coverage import overview, pyramid, quarter, top_zoom
from core.grid import TileKey, children
from core.pyramid import decode, encode, reduce


@pytest.mark.usefixtures("modules")
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 12), st.integers(1, 60)), max_size=60), st.integers(0, 150))
def test_the_lru_holds_the_newest_and_not_more_than_it_may(uses: list[tuple[int, int]], limit: int) -> None:
    from workers.photos import BytesLru

    size_of = dict(uses)
    lru = BytesLru(limit)
    held: list[int] = []
    for key, _ in uses:
        made: list[int] = []
        value = lru.get(key, lambda key=key, made=made: (made.append(key) or f"value {key}", size_of[key]))
        assert value == f"value {key}"
        assert bool(made) == (key not in held)
        held = [k for k in held if k != key] + [key]
        while sum(size_of[k] for k in held) > limit and len(held) > 1:
            held.pop(0)
        assert lru.held_bytes == sum(size_of[k] for k in held)


def _tile(seed: int, hole: bool) -> bytes:
    picture = np.random.default_rng(seed).integers(0, 256, (512, 512, 4), np.uint8)
    picture[..., 3] = 255
    if hole:
        picture[100:300, 50:400, 3] = np.arange(350, dtype=np.uint8)
    encoded = encode(picture)
    assert encoded is not None
    return encoded[0]


def test_an_overview_is_the_reduction_of_its_children() -> None:
    tiles = [_tile(1, False), None, _tile(2, True), _tile(3, False)]
    made = overview([None if t is None else quarter(t) for t in tiles])
    assert made == encode(reduce([None if t is None else decode(t) for t in tiles]))
    assert overview([None] * 4) is None


def test_the_pyramid_ends_two_zooms_above_the_tile_that_shows_all() -> None:
    natives = {TileKey(12, 100, 200): _tile(1, False), TileKey(12, 103, 201): _tile(2, True)}
    above = pyramid(natives)
    assert top_zoom(natives) == 8
    assert {t.z for t in above} == {11, 10, 9, 8}
    everything = natives | above
    for tile, data in above.items():
        below = [decode(everything[c]) if c in everything else None for c in children(tile)]
        expected = encode(reduce(below))
        assert expected is not None
        assert data == expected[0]


def test_a_stage_goes_on_in_this_process_when_it_serves_the_next_one(
    modules: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    app, done, sent = modules["app"], list[Any](), list[Any]()
    monkeypatch.setattr(app, "_stages", {"match": lambda *args: done.append(args)})
    monkeypatch.setattr(app, "send", lambda *args: sent.append(args))
    app.go_on("match", "mission", "frame")
    app.go_on("sequence", "mission")
    assert done == [("mission", "frame")]
    assert sent == [("sequence", "mission")]
