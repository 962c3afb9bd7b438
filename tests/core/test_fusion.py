"""Photos of a known ground, drawn back onto that ground."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from core.fusion import FrameIndex, FusionParams, overlapping, render
from core.geometry import Array, Camera, Pose, PosedFrame, World
from core.grid import MercatorGrid, UtmGrid, utm_epsg
from core.warp import warp

Rgb = NDArray[np.uint8]

WORLD = World(50.8, -0.1, 30.0)
ZOOM = 20
GROUND_H_M = 5.0
GROUND_GSD_M = 0.047
SIDE_PX = 1536


def ground() -> Rgb:
    """A smooth random picture of the ground, SIDE_PX square, north up, centred on the world's origin."""
    rng = np.random.default_rng(4)
    out = np.full((SIDE_PX, SIDE_PX, 3), 120.0, np.float32)
    for knots, contrast in ((6, 20), (24, 16), (96, 14), (SIDE_PX // 4, 10)):
        noise = rng.normal(0, contrast, (knots, knots, 3)).astype(np.float32)
        out += cv2.resize(noise, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_CUBIC)
    return np.clip(out, 20, 235).astype(np.uint8)


def at(picture: Rgb, xy: Array, shape: tuple[int, int]) -> Rgb:
    """The ground's colours at world x, y."""
    x = (xy[:, 0] / GROUND_GSD_M + SIDE_PX / 2 - 0.5).reshape(shape).astype(np.float32)
    y = (SIDE_PX / 2 - 0.5 - xy[:, 1] / GROUND_GSD_M).reshape(shape).astype(np.float32)
    return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT), np.uint8)


def rotation(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """Straight down with the picture's top to the north, then turned."""
    down = np.diag([1.0, -1.0, -1.0])
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    about_z = np.array([[cy, sy, 0], [-sy, cy, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return np.asarray(about_z @ down @ about_x @ about_y)


class Album:
    """Photos in memory that count how often they were asked for."""

    def __init__(self) -> None:
        self.photos: dict[str, Rgb] = {}
        self.reads: list[str] = []

    def photo(self, frame_id: str) -> Rgb:
        self.reads.append(frame_id)
        return self.photos[frame_id]

    def thumb(self, frame_id: str) -> Rgb:
        photo = self.photos[frame_id]
        scale = 128 / max(photo.shape[:2])
        size = (round(photo.shape[1] * scale), round(photo.shape[0] * scale))
        return np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA), np.uint8)


CAMERA = Camera(360, 270, 760.0, 181.0, 133.0, -0.06, 0.02)


def shoot(picture: Rgb, frame: PosedFrame) -> Rgb:
    """What the camera sees of the ground."""
    camera = frame.camera
    ys, xs = np.mgrid[0 : camera.height, 0 : camera.width]
    points = frame.pose.ground(camera, np.column_stack((xs.ravel(), ys.ravel())).astype(float))
    return at(picture, points[:, :2], (camera.height, camera.width))


def flight(picture: Rgb, tilt: float = 0.08, noise: float = 0.3) -> tuple[list[PosedFrame], Album]:
    """Five lines of six frames, overlapping by 60% and 50%, yawed, tilted, up and down."""
    rng = np.random.default_rng(11)
    frames, album = [], Album()
    for line in range(5):
        for k in range(6):
            centre = np.array([(k - 2.5) * 6.7, (line - 2) * 6.3, GROUND_H_M + 35.0]) + rng.normal(
                0, noise, 3
            )
            turn = rotation(np.pi * (line % 2) + rng.normal(0, 0.1), *rng.normal(0, tilt, 2))
            pose = Pose(turn, centre, GROUND_H_M)
            frame = PosedFrame(f"{int(rng.integers(2**60)):032x}", CAMERA, pose)
            frames.append(frame)
            album.photos[frame.frame_id] = shoot(picture, frame)
    return frames, album


def middle(width: int, height: int, zoom: int = ZOOM) -> MercatorGrid:
    """A grid around the world's origin, from a multiple of 16 px on."""
    cols, rows = MercatorGrid(zoom, 0, 0, 1, 1).from_world(WORLD, [[0.0, 0.0]], GROUND_H_M)
    col0, row0 = (int(v[0] - n / 2) // 16 * 16 for v, n in ((cols, width), (rows, height)))
    return MercatorGrid(zoom, col0, row0, width, height)


def truth(picture: Rgb, grid: MercatorGrid | UtmGrid) -> Rgb:
    cols, rows = np.meshgrid(grid.col0 + np.arange(grid.width), grid.row0 + np.arange(grid.height))
    xy = grid.to_world(WORLD, cols.ravel(), rows.ravel(), GROUND_H_M)
    return at(picture, xy, (grid.height, grid.width))


def coverage(frames: list[PosedFrame], grid: MercatorGrid) -> NDArray[np.bool_]:
    """The pixels that lie inside of some photo, projected one by one."""
    cols, rows = np.meshgrid(grid.col0 + np.arange(grid.width), grid.row0 + np.arange(grid.height))
    xy = grid.to_world(WORLD, cols.ravel(), rows.ravel(), GROUND_H_M)
    points = np.column_stack((xy, np.full(len(xy), GROUND_H_M)))
    seen = np.zeros(len(xy), bool)
    for frame in frames:
        uv = frame.pose.pixels(frame.camera, points)
        seen |= ((uv >= 0) & (uv <= (frame.camera.width - 1, frame.camera.height - 1))).all(1)
    return seen.reshape(grid.height, grid.width)


@pytest.fixture(scope="module")
def picture() -> Rgb:
    return ground()


@pytest.fixture(scope="module")
def flown(picture: Rgb) -> tuple[list[PosedFrame], Album]:
    return flight(picture)


@pytest.mark.parametrize(("sampling", "mean"), [("linear", 0.8), ("cubic", 0.75)])
def test_the_mosaic_is_the_ground(
    picture: Rgb, flown: tuple[list[PosedFrame], Album], sampling: str, mean: float
) -> None:
    frames, album = flown
    grid = middle(640, 512)
    drawn = render(grid, WORLD, frames, album, FusionParams(sampling=sampling))  # type: ignore[arg-type]
    assert (drawn[..., 3] == 255).all()
    off = np.abs(drawn[..., :3].astype(int) - truth(picture, grid))
    assert off.mean() < mean
    assert np.percentile(off, 99) <= 3
    # Free of bias, seams included: what is left is sampling.
    smooth = cv2.GaussianBlur(drawn[..., :3].astype(np.float32) - truth(picture, grid), (0, 0), 6)
    assert np.abs(smooth).max() < 2.5


def test_utm_windows_show_the_same_ground(picture: Rgb, flown: tuple[list[PosedFrame], Album]) -> None:
    frames, album = flown
    east, north = 0.0, 0.0
    plane = UtmGrid(utm_epsg(WORLD.lat_deg, WORLD.lon_deg), 0.0, 1e7, 0.05, 1, 1)
    east, north = (float(v[0]) for v in plane.from_world(WORLD, [[0.0, 0.0]], GROUND_H_M))
    grid = plane.window(round(east) - 203, round(north) - 177, 401, 333)
    drawn = render(grid, WORLD, frames, album)
    assert np.abs(drawn[..., :3].astype(int) - truth(picture, grid)).mean() < 1.6
    part = render(grid.window(grid.col0 + 37, grid.row0 + 101, 200, 99), WORLD, frames, album)
    assert np.array_equal(part, drawn[101:200, 37:237])


@pytest.mark.parametrize("bands", [3, 4, 5, 6])
def test_tiles_drawn_apart_fit_to_the_last_bit(flown: tuple[list[PosedFrame], Album], bands: int) -> None:
    frames, album = flown
    # Wider than the flight: the mosaic's own border crosses the tiles too.
    whole, params = middle(1280, 1024), FusionParams(bands=bands)
    drawn = render(whole, WORLD, frames, album, params)
    assert 0 < (drawn[..., 3] == 0).mean() < 0.6
    index = FrameIndex(frames, params)
    for row in (0, 512):
        for col in (0, 640):
            tile = whole.window(whole.col0 + col, whole.row0 + row, 640, 512)
            alone = render(tile, WORLD, index.overlapping(tile, WORLD), album, params)
            assert np.array_equal(alone, drawn[row : row + 512, col : col + 640])


@pytest.mark.parametrize("bands", [3, 4, 5, 6])
def test_what_was_not_warped_is_not_read(
    flown: tuple[list[PosedFrame], Album], monkeypatch: pytest.MonkeyPatch, bands: int
) -> None:
    """Cells outside of `needed` hold whatever memory held: no pixel may depend on it."""
    frames, album = flown
    grid, params, rng = middle(1280, 512), FusionParams(bands=bands), np.random.default_rng(1)
    clean = render(grid, WORLD, frames, album, params)
    spoilt = []

    def junk(
        photo: Rgb, places: NDArray[np.int32], needed: NDArray[np.bool_], cell_px: int, *rest: Any
    ) -> Rgb:
        out = warp(photo, places, needed, cell_px, *rest)
        idle = ~np.kron(needed, np.ones((cell_px, cell_px), bool))
        out[idle] = rng.integers(0, 256, (int(idle.sum()), 3))
        spoilt.append(int(idle.sum()))
        return out

    monkeypatch.setattr("core.layers.warp", junk)
    assert np.array_equal(render(grid, WORLD, frames, album, params), clean)
    assert sum(spoilt) > 100_000


def test_odd_windows_fit_too(flown: tuple[list[PosedFrame], Album]) -> None:
    frames, album = flown
    whole = middle(640, 512)
    drawn = render(whole, WORLD, frames, album)
    for col, row, width, height in ((0, 0, 1, 1), (317, 203, 7, 1), (5, 300, 129, 83), (639, 511, 1, 1)):
        part = render(whole.window(whole.col0 + col, whole.row0 + row, width, height), WORLD, frames, album)
        assert np.array_equal(part, drawn[row : row + height, col : col + width])


def test_the_order_of_the_frames_does_not_matter(flown: tuple[list[PosedFrame], Album]) -> None:
    frames, album = flown
    grid = middle(256, 256)
    first = render(grid, WORLD, frames, album)
    rng = np.random.default_rng(0)
    for _ in range(3):
        shuffled = [frames[k] for k in rng.permutation(len(frames))]
        assert np.array_equal(render(grid, WORLD, shuffled, album), first)
        assert np.array_equal(render(grid, WORLD, overlapping(grid, WORLD, shuffled), album), first)


def test_only_photos_that_win_are_read(flown: tuple[list[PosedFrame], Album]) -> None:
    frames, album = flown
    grid = middle(128, 128)
    grid = grid.window(grid.col0 - 400, grid.row0 - 320, 128, 128)
    album.reads.clear()
    render(grid, WORLD, frames, album)
    seen = overlapping(grid, WORLD, frames)
    assert len(seen) < len(frames)
    assert len(album.reads) == len(set(album.reads)) < len(seen)


def test_frames_without_a_visual_pose_stay_behind(flown: tuple[list[PosedFrame], Album]) -> None:
    frames, album = flown
    ghosts = []
    for frame in frames[:12]:
        ghost_id = "f" + frame.frame_id[1:]
        ghosts.append(replace(frame, frame_id=ghost_id, pose=replace(frame.pose, source="gnss")))
        album.photos[ghost_id] = np.zeros_like(album.photos[frame.frame_id])
    grid = middle(640, 256)
    album.reads.clear()
    mixed = render(grid, WORLD, [*frames, *ghosts], album)
    assert not {g.frame_id for g in ghosts} & set(album.reads)
    assert (mixed[..., 3] == 255).all()


def test_alpha_ends_where_the_photos_end(flown: tuple[list[PosedFrame], Album]) -> None:
    frames, album = flown
    frames = [frames[0], frames[1], frames[9], frames[29]]
    grid = middle(1280, 1024)
    drawn = render(grid, WORLD, frames, album)
    assert set(np.unique(drawn[..., 3])) == {0, 255}
    assert not drawn[drawn[..., 3] == 0].any()
    seen = coverage(frames, grid).astype(np.uint8)
    alpha = drawn[..., 3] > 0
    kernel = np.ones((3, 3), np.uint8)
    assert not (alpha & (cv2.dilate(seen, kernel) == 0)).any()
    missing = (cv2.erode(seen, kernel) > 0) & ~alpha
    # A corner of a photo that pokes out by less than a cell may be rounded off.
    assert missing.mean() < 2e-4


def test_no_fringe_at_the_border() -> None:
    """A ground of one colour stays that colour up to the last pixel, whatever lies beyond."""
    plain = np.full((SIDE_PX, SIDE_PX, 3), (200, 150, 90), np.uint8)
    frames, album = flight(plain)
    drawn = render(middle(1280, 1024), WORLD, frames, album)
    inside = drawn[drawn[..., 3] > 0]
    assert len(inside) > 400_000
    assert np.abs(inside[:, :3].astype(int) - (200, 150, 90)).max() <= 1


def two_frames(left: Rgb, right: Rgb) -> tuple[list[PosedFrame], Album]:
    """Two frames side by side that share a third of their ground."""
    camera, album, frames = Camera(360, 270, 760.0, 179.5, 134.5), Album(), []
    for name, x, photo in (("a", -5.5, left), ("b", 5.5, right)):
        frames.append(PosedFrame(name, camera, Pose(rotation(0.0), np.array([x, 0, 40.0]), GROUND_H_M)))
        album.photos[name] = photo
    return frames, album


def test_tone_flows_over_a_seam() -> None:
    """Two exposures meet in a slope, not in a step."""
    dark, bright = np.full((270, 360, 3), 100, np.uint8), np.full((270, 360, 3), 140, np.uint8)
    frames, album = two_frames(dark, bright)
    grid = middle(480, 64)
    row = render(grid, WORLD, frames, album)[32, :, 0].astype(int)
    assert (np.diff(row) >= 0).all()
    assert np.abs(np.diff(row)).max() <= 2
    assert row[8] == 100
    assert row[-8] == 140
    gains = [(120 / 136) / (level / (256 - level)) for level in (100.5, 140.5)]
    balanced = [replace(f, gain=(g,) * 3) for f, g in zip(frames, gains, strict=True)]
    even = render(grid, WORLD, balanced, album)[..., :3].astype(int)
    assert np.abs(even - 120).max() <= 1


def test_falloff_of_the_lens_is_lifted() -> None:
    falloff = (-0.5, -0.2, -0.1) * 3
    camera = Camera(360, 270, 760.0, 179.5, 134.5, falloff=falloff)
    ys, xs = np.mgrid[0:270, 0:360]
    rho2 = 4 * ((xs - 179.5) ** 2 + (ys - 134.5) ** 2) / (360**2 + 270**2)
    dim = np.exp(rho2 * (falloff[0] + rho2 * (falloff[1] + rho2 * falloff[2])))
    light = 180 / 76 * dim
    photo = np.repeat((256 * light / (1 + light))[..., None], 3, axis=2).astype(np.uint8)
    frames, album = two_frames(photo, photo)
    frames = [replace(f, camera=camera) for f in frames]
    grid = middle(520, 240)
    drawn = render(grid, WORLD, frames, album)
    lit = drawn[drawn[..., 3] > 0][:, :3].astype(int)
    assert np.abs(lit - 180).mean() < 1.5
    assert lit.min() > 170
    plain = [replace(f, camera=replace(camera, falloff=())) for f in frames]
    assert render(grid, WORLD, plain, album)[..., 0][drawn[..., 3] > 0].min() < 150


def test_the_side_that_the_sun_lights_is_evened_out() -> None:
    """Photos whose east is brighter, the ray's length and all, show an even ground."""
    sun = (0.0,) * 9 + (0.6, 0.0) * 3
    camera = Camera(360, 270, 760.0, 179.5, 134.5, falloff=sun)
    ys, xs = np.mgrid[0:270, 0:360]
    east = (xs - 179.5) / np.sqrt((xs - 179.5) ** 2 + (ys - 134.5) ** 2 + 760.0**2)
    light = 100 / 156 * np.exp(0.6 * east)
    photo = np.repeat((256 * light / (1 + light))[..., None], 3, axis=2).astype(np.uint8)
    frames, album = two_frames(photo, photo)
    grid = middle(520, 240)
    drawn = render(grid, WORLD, [replace(f, camera=camera) for f in frames], album)
    shown = drawn[drawn[..., 3] > 0][:, :3].astype(int)
    assert np.abs(shown - 100).mean() < 1
    assert np.abs(shown - 100).max() <= 3
    plain = render(grid, WORLD, frames, album)
    assert np.ptp(plain[plain[..., 3] > 0][:, 0].astype(int)) > 12


def test_what_only_one_photo_sees_leaves_no_ghost_in_the_other() -> None:
    """A black thing in the loser's picture does not darken the winner's; a plain average would."""
    clear = np.full((270, 360, 3), 150, np.uint8)
    blocked = clear.copy()
    blocked[90:180, 15:50] = 10  # near this photo's edge, where the other one sees better
    frames, album = two_frames(clear, blocked)
    grid = middle(480, 128)
    drawn = render(grid, WORLD, frames, album, FusionParams(tone_tolerance=12))[..., 0].astype(int)
    naive = render(grid, WORLD, frames, album, FusionParams(tone_tolerance=1e6))[..., 0].astype(int)
    half = drawn[:, :230]
    assert np.abs(half - 150).mean() < 0.4 * np.abs(naive[:, :230] - 150).mean()
    assert half.min() > naive[:, :230].min() + 8


def test_overviews_do_not_alias(picture: Rgb, flown: tuple[list[PosedFrame], Album]) -> None:
    """Four times coarser than the photos, the mosaic is the ground's mean, not every fourth pixel."""
    frames, album = flown
    fine = middle(640, 512)
    coarse = MercatorGrid(ZOOM - 2, fine.col0 // 4, fine.row0 // 4, 160, 128)
    drawn = render(coarse, WORLD, frames, album)[8:-8, 8:-8, :3].astype(int)
    fine = MercatorGrid(ZOOM, coarse.col0 * 4, coarse.row0 * 4, 640, 512)
    mean = cv2.resize(truth(picture, fine), (160, 128), interpolation=cv2.INTER_AREA)[8:-8, 8:-8].astype(int)
    assert np.abs(drawn - mean).mean() < 2.5


def test_each_frame_lies_on_its_own_plane(picture: Rgb) -> None:
    frames, album = flight(picture, tilt=0.0, noise=0.0)
    raised = [
        replace(
            f,
            pose=replace(f.pose, center=f.pose.center + np.array([0, 0, 50.0]), ground_h_m=GROUND_H_M + 50.0),
        )
        for f in frames
    ]
    grid = middle(256, 256)
    low, high = (render(grid, WORLD, each, album).astype(int) for each in (frames, raised))
    # 50 m up the plumb lines stand 8 ppm farther apart: the same picture but for that.
    assert np.abs(low - high).mean() < 0.1


def test_flat_rays_and_wrong_sides_are_not_drawn() -> None:
    frames, album = two_frames(*(np.full((270, 360, 3), v, np.uint8) for v in (100, 140)))
    oblique = replace(frames[0], pose=replace(frames[0].pose, world_R_cam=rotation(0.3, 1.35)))
    below = replace(frames[1], pose=replace(frames[1].pose, center=np.array([0.0, 0.0, -20.0])))
    grid = middle(256, 256)
    assert not render(grid, WORLD, [below], album).any()
    index = FrameIndex([oblique, below])
    for col in range(-2048, 2048, 1024):
        tile = grid.window(grid.col0 + col, grid.row0 - 2048, 256, 256)
        every = render(tile, WORLD, [oblique, below], album)
        assert np.array_equal(render(tile, WORLD, index.overlapping(tile, WORLD), album), every)
    far = FusionParams(max_view_deg=89.9)
    near = render(grid.window(grid.col0, grid.row0 - 1500, 256, 256), WORLD, [oblique], album)
    wide = render(grid.window(grid.col0, grid.row0 - 1500, 256, 256), WORLD, [oblique], album, far)
    assert (near[..., 3] > 0).sum() <= (wide[..., 3] > 0).sum()


def test_the_index_misses_no_frame_that_matters(flown: tuple[list[PosedFrame], Album]) -> None:
    frames, album = flown
    index = FrameIndex(frames)
    whole = middle(1536, 1280)
    for row in range(0, 1280, 256):
        for col in range(0, 1536, 256):
            tile = whole.window(whole.col0 + col, whole.row0 + row, 256, 256)
            some = index.overlapping(tile, WORLD)
            everything = render(tile, WORLD, frames, album)
            assert np.array_equal(render(tile, WORLD, some, album), everything)


def test_nothing_gives_nothing() -> None:
    grid = middle(64, 32)
    assert FrameIndex([]).overlapping(grid, WORLD) == []
    drawn = render(grid, WORLD, [], Album())
    assert drawn.shape == (32, 64, 4)
    assert not drawn.any()
