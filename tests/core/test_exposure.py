"""Gains and falloff are found from thumbs and poses alone."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from core.exposure import FEW, balance, balanced, fitted, light_apart
from core.geometry import Camera, Pose, PosedFrame, World

Rgb = NDArray[np.uint8]

WORLD = World(50.8, -0.1, 30.0)
CAMERA = Camera(1600, 1200, 1500.0, 799.5, 599.5)
FALLOFF = (-0.15, -0.1, 0.0, -0.1, -0.2, 0.05, -0.2, 0.0, -0.1)
DOWN = np.diag([1.0, -1.0, -1.0])


def albedo(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """A hilly grey ground with coloured waves, (N, 3), between 60 and 180."""
    x, y = xy.T
    base = 115 + 25 * np.sin(x / 9) * np.cos(y / 7) + 15 * np.sin((x + 2 * y) / 23)
    return np.asarray(np.column_stack((base, base + 12 * np.sin(x / 5), base - 10 * np.cos(y / 6))))


def thumb(
    frame: PosedFrame,
    gain: NDArray[np.float64],
    falloff: tuple[float, ...] = (),
    sun: tuple[float, float] = (0.0, 0.0),
) -> Rgb:
    """128 × 96 px of what the camera shows, its light multiplied by `gain` and dimmed by the lens.

    `sun`: the logarithm of the light that comes more for each unit that the ray goes east and north.
    """
    us, vs = np.meshgrid((np.arange(128) + 0.5) * 12.5 - 0.5, (np.arange(96) + 0.5) * 12.5 - 0.5)
    uv = np.column_stack((us.ravel(), vs.ravel()))
    colour = albedo(frame.pose.ground(frame.camera, uv)[:, :2])
    light = colour / (256 - colour) * gain
    if falloff:
        rho2 = 4 * ((uv - (CAMERA.cx, CAMERA.cy)) ** 2).sum(1) / (CAMERA.width**2 + CAMERA.height**2)
        powers = np.column_stack((rho2, rho2**2, rho2**3))
        light *= np.exp(powers @ np.reshape(falloff, (3, 3)).T)
    ray = frame.pose.ground(frame.camera, uv) - frame.pose.center
    light *= np.exp((ray / np.linalg.norm(ray, axis=1)[:, None])[:, :2] @ sun)[:, None]
    return np.floor(256 * light / (1 + light)).astype(np.uint8).reshape(96, 128, 3)


def turned(yaw_rad: float) -> NDArray[np.float64]:
    """A turn around the vertical."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def flight(lines: int = 4, per_line: int = 6) -> list[PosedFrame]:
    """Frames 17 × 13 m large, every 6 m along and across."""
    rng = np.random.default_rng(3)
    out = []
    for k in range(lines * per_line):
        line, place = divmod(k, per_line)
        centre = np.array([place * 6.0, line * 6.0, 16.0]) + rng.normal(0, 0.2, 3)
        out.append(PosedFrame(f"{int(rng.integers(2**60)):032x}", CAMERA, Pose(DOWN, centre, 0.0)))
    return out


def apart(lit: list[PosedFrame], lights: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
    """How the logarithms (N, 3) of the light in which the same ground is drawn differ from photo to photo.

    All alike may stay brighter or darker: what must go are the differences.
    """
    side = np.array([np.reshape(f.camera.falloff[9:], (3, 2)) @ f.pose.center[:2] / 16 for f in lit])
    left = np.log([np.multiply(f.gain, lights[f.frame_id]) for f in lit]) + side
    return np.asarray(left - left.mean(0))


def test_exposure_steps_are_found() -> None:
    frames, rng = flight(), np.random.default_rng(5)
    dimmed = {f.frame_id: np.exp(rng.normal(0, 0.1, 3)) for f in frames}
    lit = balanced(frames, WORLD, {f.frame_id: thumb(f, dimmed[f.frame_id]) for f in frames})
    left = apart(lit, dimmed)
    assert left.std() < 0.15 * np.log(list(dimmed.values())).std()
    assert np.abs(left).max() < 0.05


def test_a_camera_that_exposes_by_what_it_sees_is_understood() -> None:
    """Half as much light again over a forest as over a meadow beside it, white balance alike."""
    frames, rng = flight(5, 8), np.random.default_rng(15)
    lights = {f.frame_id: np.exp(rng.choice([-0.4, 0.0, 0.4]) + rng.normal(0, 0.1, 3)) for f in frames}
    lit = balanced(frames, WORLD, {f.frame_id: thumb(f, lights[f.frame_id]) for f in frames})
    assert np.abs(apart(lit, lights)).max() < 0.03
    # anchored: neither brighter nor darker as a whole
    assert np.log([f.gain for f in lit]).mean(0) == pytest.approx((0, 0, 0), abs=1e-4)


def test_tone_does_not_drift_along_a_line() -> None:
    """Errors of single photos do not add up; no more of a slope is left than lights by chance have."""
    frames, rng = flight(2, 40), np.random.default_rng(16)
    lights = {f.frame_id: np.exp(rng.normal(0, 0.2, 3)) for f in frames}
    lit = balanced(frames, WORLD, {f.frame_id: thumb(f, lights[f.frame_id]) for f in frames})
    assert np.abs(apart(lit, lights)).max() < 0.04
    left = np.log([np.multiply(f.gain, lights[f.frame_id]) for f in lit])
    along = np.array([f.pose.center[0] for f in lit])
    ends = np.polyfit(along, left, 1)[0] * np.ptp(along)
    assert np.abs(ends).max() < 3 * 0.2 * np.sqrt(12 / len(frames))


def test_the_falloff_of_the_lens_is_found() -> None:
    frames = flight()
    thumbs = {f.frame_id: thumb(f, np.ones(3), FALLOFF) for f in frames}
    lit = balanced(frames, WORLD, thumbs)
    assert len({f.camera for f in lit}) == 1
    rho2 = np.linspace(0, 0.9, 10)
    powers = np.column_stack((rho2, rho2**2, rho2**3))
    found = powers @ np.reshape(lit[0].camera.falloff[:9], (3, 3)).T
    assert np.abs(found - powers @ np.reshape(FALLOFF, (3, 3)).T).max() < 0.03
    assert np.abs(np.array([f.gain for f in lit]) - 1).max() < 0.03


def test_the_side_that_the_sun_lights_makes_no_map_with_a_dark_end() -> None:
    """Every photo is brighter in its north: matched edge to edge the map would get darker northwards."""
    frames = [
        replace(f, pose=replace(f.pose, world_R_cam=turned(k % 2 * np.pi) @ DOWN))
        for k, f in enumerate(flight(12, 5))
    ]
    sun = (-0.2, 0.5)
    lit = balanced(frames, WORLD, {f.frame_id: thumb(f, np.ones(3), FALLOFF, sun) for f in frames})
    assert np.reshape(lit[0].camera.falloff[9:], (3, 2)) == pytest.approx(np.tile(sun, (3, 1)), abs=0.05)
    north = np.array([f.pose.center[1] for f in lit])
    slope = np.polyfit(north - north.mean(), np.log([f.gain for f in lit]).mean(1), 1)[0]
    assert abs(slope) * np.ptp(north) < 0.05


def test_a_perfect_camera_is_left_alone() -> None:
    frames = flight()
    thumbs = {f.frame_id: thumb(f, np.ones(3)) for f in frames}
    for frame in balanced(frames, WORLD, thumbs):
        assert frame.gain == pytest.approx((1, 1, 1), abs=0.005)
        assert frame.camera.falloff == pytest.approx((0,) * 15, abs=0.02)


def test_what_one_frame_sees_alone_misleads_nobody() -> None:
    """A black roof in one photo, where its neighbours see bright ground, is no exposure."""
    frames = flight()
    thumbs = {f.frame_id: thumb(f, np.ones(3)) for f in frames}
    odd = frames[8].frame_id
    thumbs[odd] = thumbs[odd].copy()
    thumbs[odd][20:60, 30:80] = 12
    gains = balance(frames, WORLD, thumbs)
    assert gains[odd] == pytest.approx((1, 1, 1), abs=0.03)


def test_order_and_earlier_gains_do_not_matter() -> None:
    frames, rng = flight(), np.random.default_rng(6)
    thumbs = {f.frame_id: thumb(f, np.exp(rng.normal(0, 0.1, 3))) for f in frames}
    first = balanced(frames, WORLD, thumbs)
    shuffled = [frames[k] for k in rng.permutation(len(frames))]
    assert [(f.frame_id, f.gain, f.camera) for f in balanced(shuffled, WORLD, thumbs)] == [
        (f.frame_id, f.gain, f.camera) for f in first
    ]
    again = balanced(first, WORLD, thumbs)
    assert [(f.gain, f.camera) for f in again] == [(f.gain, f.camera) for f in first]


def test_two_cameras_have_two_lenses() -> None:
    frames = flight()
    other = replace(CAMERA, f_px=1510.0)
    mixed = [replace(f, camera=other) if k % 2 else f for k, f in enumerate(frames)]
    thumbs = {f.frame_id: thumb(f, np.ones(3), FALLOFF if f.camera == other else ()) for f in mixed}
    for frame in balanced(mixed, WORLD, thumbs):
        corner = np.exp(np.reshape(frame.camera.falloff[:9], (3, 3)).sum(1))
        expected = np.exp(np.reshape(FALLOFF, (3, 3)).sum(1)) if frame.camera.f_px > 1505 else np.ones(3)
        assert corner == pytest.approx(expected, abs=0.08)


def test_lonely_frames_and_no_frames() -> None:
    assert balanced([], WORLD, {}) == []
    assert balance([], WORLD, {}) == {}
    one = flight(1, 1)
    assert balance(one, WORLD, {one[0].frame_id: thumb(one[0], np.ones(3))}) == {
        one[0].frame_id: (1.0, 1.0, 1.0)
    }
    black = {f.frame_id: np.zeros((96, 128, 3), np.uint8) for f in flight()}
    assert set(balance(flight(), WORLD, black).values()) == {(1.0, 1.0, 1.0)}


def test_flat_rays_do_not_blow_up() -> None:
    frames = flight()
    pitch = np.radians(70)
    tilted = DOWN @ np.array(
        [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    )
    frames[3] = replace(frames[3], pose=replace(frames[3].pose, world_R_cam=tilted))
    thumbs = {f.frame_id: np.full((96, 128, 3), 100, np.uint8) for f in frames}
    gains = balance(frames, WORLD, thumbs)
    assert np.isfinite(np.array(list(gains.values()))).all()


def test_new_photos_suit_those_that_are_there() -> None:
    """Against the truth, not against another balance; and nothing about the known ones changes."""
    frames, rng = flight(), np.random.default_rng(7)
    lights = {f.frame_id: np.exp(rng.normal(0, 0.3, 3)) for f in frames}
    thumbs = {f.frame_id: thumb(f, lights[f.frame_id], FALLOFF, (0.1, 0.3)) for f in frames}
    lens = replace(CAMERA, falloff=(*FALLOFF, *(0.1, 0.3) * 3))
    even = [replace(f, camera=lens, gain=tuple(1 / lights[f.frame_id])) for f in frames]
    new, known = even[8:11], [*even[:8], *even[11:]]
    blank = [replace(f, gain=(1.0, 1.0, 1.0)) for f in new]
    found = fitted(blank, known, thumbs)
    assert [f.frame_id for f in found] == sorted(f.frame_id for f in new)
    for frame in found:
        assert np.log(np.multiply(frame.gain, lights[frame.frame_id])) == pytest.approx((0,) * 3, abs=0.02)
        assert frame.camera == lens
    shuffled = [known[k] for k in rng.permutation(len(known))]
    assert [f.gain for f in fitted(blank[::-1], shuffled, thumbs)] == [f.gain for f in found]


def test_many_new_photos_are_told_from_few_known_ones() -> None:
    """As when photos were waiting: nearly all of them see nobody whose light is known."""
    frames, rng = sorted(flight(), key=lambda f: f.pose.center[0]), np.random.default_rng(8)
    lights = {f.frame_id: np.exp(rng.normal(0, 0.3, 3)) for f in frames}
    thumbs = {f.frame_id: thumb(f, lights[f.frame_id]) for f in frames}
    known = [replace(f, gain=tuple(1 / lights[f.frame_id])) for f in frames[:4]]
    found = fitted(frames[4:], known, thumbs)
    assert len(found) > FEW
    left = np.log([np.multiply(f.gain, lights[f.frame_id]) for f in found])
    assert np.abs(left).max() < 0.06
    shuffled = fitted([frames[k] for k in 4 + rng.permutation(len(frames) - 4)], known, thumbs)
    assert [f.gain for f in shuffled] == [f.gain for f in found]


def test_a_new_photo_that_overlaps_nobody_keeps_its_light() -> None:
    near, far = flight(1, 1)[0], flight(1, 1)[0]
    far = replace(far, frame_id="far", pose=replace(far.pose, center=far.pose.center + 500.0))
    thumbs = {f.frame_id: thumb(f, np.full(3, 0.7)) for f in (near, far)}
    assert fitted([far], [near], thumbs)[0].gain == (1.0, 1.0, 1.0)
    assert fitted([far], [], thumbs)[0].gain == (1.0, 1.0, 1.0)


def test_how_differently_a_frame_is_lit_is_told_from_above() -> None:
    """No pixel's light changes by more than that, and one in a corner by about as much."""
    rng = np.random.default_rng(9)
    frame = flight(1, 1)[0]
    for _ in range(5):
        numbers = (
            *np.multiply(FALLOFF, rng.normal(0, 0.3)),
            *np.repeat(rng.normal(0, 0.2, 2)[None], 3, 0).ravel(),
        )
        other = replace(
            frame, gain=tuple(np.exp(rng.normal(0, 0.1, 3))), camera=replace(CAMERA, falloff=numbers)
        )
        u, v = np.meshgrid(np.linspace(0, 1599, 30), np.linspace(0, 1199, 30))
        uv = np.column_stack((u.ravel(), v.ravel()))
        ray = frame.pose.ground(CAMERA, uv) - frame.pose.center
        rho2 = 4 * ((uv - (CAMERA.cx, CAMERA.cy)) ** 2).sum(1) / (CAMERA.width**2 + CAMERA.height**2)
        lens = np.column_stack((rho2, rho2**2, rho2**3)) @ np.reshape(numbers[:9], (3, 3)).T
        side = (ray / np.linalg.norm(ray, axis=1)[:, None])[:, :2] @ np.reshape(numbers[9:], (3, 2)).T
        truth = np.abs(np.log(other.gain) - lens - side).max()
        assert 0.4 * light_apart(frame, other) < truth < 1.2 * light_apart(frame, other)
    assert light_apart(frame, frame) == 0
