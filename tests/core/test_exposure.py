"""Gains and falloff are found from thumbs and poses alone."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from core.exposure import balance, balanced
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


def thumb(frame: PosedFrame, gain: NDArray[np.float64], falloff: tuple[float, ...] = ()) -> Rgb:
    """128 × 96 px of what the camera shows, its light multiplied by `gain` and dimmed by the lens."""
    us, vs = np.meshgrid((np.arange(128) + 0.5) * 12.5 - 0.5, (np.arange(96) + 0.5) * 12.5 - 0.5)
    uv = np.column_stack((us.ravel(), vs.ravel()))
    colour = albedo(frame.pose.ground(frame.camera, uv)[:, :2])
    light = colour / (256 - colour) * gain
    if falloff:
        rho2 = 4 * ((uv - (CAMERA.cx, CAMERA.cy)) ** 2).sum(1) / (CAMERA.width**2 + CAMERA.height**2)
        powers = np.column_stack((rho2, rho2**2, rho2**3))
        light *= np.exp(powers @ np.reshape(falloff, (3, 3)).T)
    return np.floor(256 * light / (1 + light)).astype(np.uint8).reshape(96, 128, 3)


def flight(lines: int = 4, per_line: int = 6) -> list[PosedFrame]:
    """Frames 17 × 13 m large, every 6 m along and across."""
    rng = np.random.default_rng(3)
    out = []
    for k in range(lines * per_line):
        line, place = divmod(k, per_line)
        centre = np.array([place * 6.0, line * 6.0, 16.0]) + rng.normal(0, 0.2, 3)
        out.append(PosedFrame(f"{int(rng.integers(2**60)):032x}", CAMERA, Pose(DOWN, centre, 0.0)))
    return out


def test_exposure_steps_are_found() -> None:
    frames, rng = flight(), np.random.default_rng(5)
    dimmed = {f.frame_id: np.exp(rng.normal(0, 0.1, 3)) for f in frames}
    thumbs = {f.frame_id: thumb(f, dimmed[f.frame_id]) for f in frames}
    gains = balance(frames, WORLD, thumbs)
    left = np.array([np.log(gains[f.frame_id] * dimmed[f.frame_id]) for f in frames])
    given = np.array([np.log(dimmed[f.frame_id]) for f in frames])
    # All alike may stay brighter or darker: what must go are the differences.
    assert (left - left.mean(0)).std() < 0.15 * (given - given.mean(0)).std()
    assert np.abs(left - left.mean(0)).max() < 0.05


def test_a_camera_that_exposes_by_what_it_sees_is_understood() -> None:
    """Half as much light again over a forest as over a meadow beside it, white balance alike."""
    frames, rng = flight(5, 8), np.random.default_rng(15)
    lights = {f.frame_id: np.exp(rng.choice([-0.4, 0.0, 0.4]) + rng.normal(0, 0.1, 3)) for f in frames}
    thumbs = {f.frame_id: thumb(f, lights[f.frame_id]) for f in frames}
    gains = balance(frames, WORLD, thumbs)
    left = np.log([np.multiply(gains[k], lights[k]) for k in sorted(gains)])
    assert np.abs(left - left.mean(0)).max() < 0.03
    # anchored: neither brighter nor darker as a whole
    assert np.log(list(gains.values())).mean(0) == pytest.approx((0, 0, 0), abs=1e-4)


def test_tone_does_not_drift_along_a_line() -> None:
    frames, rng = flight(2, 40), np.random.default_rng(16)
    lights = {f.frame_id: np.exp(rng.normal(0, 0.2, 3)) for f in frames}
    gains = balance(frames, WORLD, {f.frame_id: thumb(f, lights[f.frame_id]) for f in frames})
    left = np.log([np.multiply(gains[f.frame_id], lights[f.frame_id]) for f in frames])
    ends = left[[0, 1, 40, 41]].mean(0) - left[[38, 39, 78, 79]].mean(0)
    assert np.abs(ends).max() < 0.05


def test_the_falloff_of_the_lens_is_found() -> None:
    frames = flight()
    thumbs = {f.frame_id: thumb(f, np.ones(3), FALLOFF) for f in frames}
    lit = balanced(frames, WORLD, thumbs)
    assert len({f.camera for f in lit}) == 1
    rho2 = np.linspace(0, 0.9, 10)
    powers = np.column_stack((rho2, rho2**2, rho2**3))
    found = powers @ np.reshape(lit[0].camera.falloff, (3, 3)).T
    assert np.abs(found - powers @ np.reshape(FALLOFF, (3, 3)).T).max() < 0.03
    assert np.abs(np.array([f.gain for f in lit]) - 1).max() < 0.03


def test_a_perfect_camera_is_left_alone() -> None:
    frames = flight()
    thumbs = {f.frame_id: thumb(f, np.ones(3)) for f in frames}
    for frame in balanced(frames, WORLD, thumbs):
        assert frame.gain == pytest.approx((1, 1, 1), abs=0.005)
        assert frame.camera.falloff == pytest.approx((0,) * 9, abs=0.02)


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
        corner = np.exp(np.reshape(frame.camera.falloff, (3, 3)).sum(1))
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
