"""Filling what a map does not show yet: nothing stays open, nothing is drawn twice, what is shown stays."""

import cv2
import numpy as np

from core.coverage import block_grid, blocks, pass_pixels, tiles_under
from core.fusion import FrameIndex, render
from core.geometry import Camera, Pose, PosedFrame, World
from core.patching import CELL_PX, FADE_PX, fill_block, lay
from core.pyramid import decode

WORLD = World(47.0, 8.0, 400.0)
ZOOM = 21
CAMERA = Camera(400, 300, 420.0, 200.0, 150.0, -0.05, 0.01)
DOWN = np.diag([1.0, -1.0, -1.0])


class Album:
    """Smooth photos, all different."""

    def photo(self, frame_id):
        rng = np.random.default_rng(int(frame_id))
        coarse = rng.integers(40, 220, (6, 8, 3)).astype(np.uint8)
        return cv2.resize(coarse, (400, 300), interpolation=cv2.INTER_CUBIC)

    def thumb(self, frame_id):
        return cv2.resize(self.photo(frame_id), (128, 96), interpolation=cv2.INTER_AREA)


def flight():
    """Four lines of five photos, 70% and 60% overlap, as they are taken."""
    rng = np.random.default_rng(3)
    frames = []
    for k in range(20):
        line, step = divmod(k, 5)
        along = step if line % 2 == 0 else 4 - step
        center = np.array([along * 12.0, line * 12.0, 42.0]) + rng.normal(0, 0.4, 3)
        frames.append(PosedFrame(str(k), CAMERA, Pose(DOWN, center, 0.0)))
    return frames


def alpha_of(grid, shown):
    """What a block shows, per pixel."""
    alpha = np.zeros((grid.height, grid.width), np.uint8)
    for tile, picture in shown.items():
        top, left = tile.y * 512 - grid.row0, tile.x * 512 - grid.col0
        alpha[top : top + 512, left : left + 512] = 0 if picture is None else picture[..., 3]
    return alpha


def test_a_map_that_is_filled_photo_by_photo_has_no_holes_and_costs_little_more_than_one_pass():
    frames, album = flight(), Album()
    under = [tiles_under(frame, WORLD, ZOOM) for frame in frames]
    shown = dict.fromkeys(set().union(*under))
    spent = 0
    for k in range(len(frames)):
        index = FrameIndex(frames[: k + 1])
        for block in blocks(under[k]):
            filled = fill_block({tile: shown[tile] for tile in block}, WORLD, index, album)
            spent += filled.pixels
            shown |= {t: None if e is None else decode(e[0]) for t, e in filled.changed.items()}
    index = FrameIndex(frames)
    missing = 0
    for block in blocks(shown):
        again = fill_block({tile: shown[tile] for tile in block}, WORLD, index, album)
        assert (again.changed, again.pixels) == ({}, 0)
        grid = block_grid(block)
        whole = render(grid, WORLD, index.overlapping(grid, WORLD), album)[..., 3]
        alpha = alpha_of(grid, {tile: shown[tile] for tile in block})
        for tile in set(grid.tiles()) - set(block):
            top, left = tile.y * 512 - grid.row0, tile.x * 512 - grid.col0
            whole[top : top + 512, left : left + 512] = 0
        missing += int(((whole > 0) & (alpha == 0)).sum())
    seen = sum(int((alpha_of(block_grid([t]), {t: p}) > 0).sum()) for t, p in shown.items())
    assert missing < 0.02 * seen  # slivers along the photos' edges
    assert spent < 0.9 * pass_pixels(shown)


def test_what_is_shown_fades_into_what_is_new_and_stays_as_it_was_beyond():
    shown = np.zeros((64, 128, 4), np.uint8)
    shown[:, :80] = (100, 100, 100, 255)
    fresh = np.full((64, 128, 4), (200, 150, 50, 255), np.uint8)
    fresh[:, 120:] = 0
    before = shown.copy()
    lay(shown, fresh)
    assert (shown[:, : 80 - FADE_PX - 1] == before[:, : 80 - FADE_PX - 1]).all()
    assert (shown[:, 80:] == fresh[:, 80:]).all()
    ramp = shown[32, 80 - FADE_PX : 81, 0].astype(int)
    assert (np.diff(ramp) >= 0).all()
    assert np.diff(ramp).max() <= 100 / FADE_PX * 2


def test_where_the_fresh_picture_shows_nothing_the_old_one_stays():
    shown = np.full((32, 32, 4), (10, 20, 30, 255), np.uint8)
    shown[:, 16:] = 0
    before = shown.copy()
    lay(shown, np.zeros_like(shown))
    assert (shown == before).all()


def test_only_the_wanted_cells_are_drawn_as_in_the_whole_picture():
    frames, album = flight(), Album()
    block = blocks(tiles_under(frames[7], WORLD, ZOOM))[0]
    grid = block_grid(block)
    near = FrameIndex(frames).overlapping(grid, WORLD)
    whole = render(grid, WORLD, near, album)
    only = np.zeros((grid.height // CELL_PX, grid.width // CELL_PX), bool)
    rng = np.random.default_rng(1)
    only[5:9, 3:20] = only[12:14, 12:14] = True
    only |= rng.uniform(size=only.shape) < 0.02
    part = render(grid, WORLD, near, album, only=only)
    pixels = np.kron(only, np.ones((CELL_PX, CELL_PX), bool))
    assert (part[pixels] == whole[pixels]).all()
    assert (part[..., 3] > 0).sum() < (whole[..., 3] > 0).sum()
