"""What a process keeps is bounded by bytes, and overviews of quarters are reductions of their children."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest
import simplejpeg
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


class _Album:
    """An object store of 5,000 small photos; ten pictures, again and again."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        pictures = rng.integers(0, 256, (10, 6, 8, 3)).astype(np.uint8).repeat(16, 1).repeat(16, 2)
        self.photos = [
            simplejpeg.encode_jpeg(np.ascontiguousarray(p), quality=85, colorspace="RGB") for p in pictures
        ]
        self.tile = _tile(1, hole=False)

    def get(self, key: str) -> bytes:
        return self.tile if "/tiles/" in key else self.photos[int(key.rsplit("/", 1)[1]) % 10]


@pytest.mark.usefixtures("modules")
def test_five_thousand_frames_and_their_tiles_stay_within_the_settings() -> None:
    """What Python really holds, as tracemalloc counts it; on the way that the stages take."""
    from workers.photos import MissionPhotos, PhotoShelf
    from workers.pictures import Pictures

    photo_bytes, tile_bytes = 4_000_000, 12_000_000
    store = _Album()
    shelf = PhotoShelf.of(store, photo_bytes)
    pictures = Pictures(store, tile_bytes)
    mission = MissionPhotos(shelf, "m", None)
    tracemalloc.start()
    before, most = tracemalloc.get_traced_memory()[0], 0
    for k in range(5000):
        for frame in (k, max(k - 1, 0), max(k - 30, 0)):
            assert mission.photo(str(frame)).shape == (96, 128, 3)
        if k % 10 == 0:
            pictures.get(f"m/tiles/{k}")
        if k % 50 == 49:
            most = max(most, tracemalloc.get_traced_memory()[0] - before)
    tracemalloc.stop()
    assert shelf.pictures.held_bytes <= photo_bytes
    assert pictures.held.held_bytes <= tile_bytes
    # A sixteenth each for features and thumbnails, two for words: here only photos and tiles are held.
    limit = photo_bytes * 12 / 16 + tile_bytes
    assert 0.9 * limit <= most <= 1.1 * limit


@pytest.mark.usefixtures("modules")
def test_a_photo_of_which_too_little_was_kept_is_decoded_again() -> None:
    from core.parts import Share, Window
    from workers.photos import MissionPhotos, PhotoShelf

    shelf = PhotoShelf.of(_Album(), 40_000)  # too small for one whole photo
    mission = MissionPhotos(shelf, "m", None, lambda frame_id: Share(0.25, 0.25, 0.5, 0.5))
    whole = MissionPhotos(PhotoShelf.of(_Album(), 4_000_000), "m", None).photo("1")
    for asked, held in (
        ((40, 30, 50, 40), (32, 24, 64, 48)),  # what it will probably show holds it
        ((60, 30, 70, 40), (32, 24, 70, 48)),
        ((60, 30, 70, 40), (32, 24, 70, 48)),
        ((0, 0, 128, 96), (0, 0, 128, 96)),
    ):
        part = mission.part("1", lambda width, height, asked=asked: Window(*asked))
        assert part.window == Window(*held)
        left, top, right, bottom = held
        assert np.array_equal(part.pixels, whole[top:bottom, left:right])
        assert shelf.pictures.held_bytes == part.pixels.nbytes
