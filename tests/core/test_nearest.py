"""The compiled loops against the same thing said slowly, with everything held against everything."""

from __future__ import annotations

import numpy as np
import pytest

from core.nearest import Keypoints, Limits, agreeing, around, in_common, in_windows, mutual, supporting

SIDE = 320.0
SHIFT = np.array([[1.0, 0.0, 40.0], [0.0, 1.0, -15.0], [0.0, 0.0, 1.0]])


def keypoints(seed: int, count: int = 300) -> Keypoints:
    rng = np.random.default_rng(seed)
    looks = (rng.gamma(0.6, 60.0, (count, 128))).clip(0, 255).astype(np.uint8)
    return Keypoints(
        xy=rng.uniform(-SIDE, SIDE, (count, 2)).astype(np.float32),
        turn=rng.uniform(0, 2 * np.pi, count).astype(np.float32),
        size=rng.uniform(2, 20, count).astype(np.float32),
        looks=looks,
        length=np.linalg.norm(looks.astype(np.float32), axis=1),
    )


def moved(seed: int, turn_rad: float = 0.0, wrong: float = 0.2) -> tuple[Keypoints, Keypoints, np.ndarray]:
    """Two pictures of the same points, shifted; where the first's are in the second. A share is wrong."""
    a = keypoints(seed)
    rng = np.random.default_rng(seed + 100)
    place = rng.permutation(len(a.xy))
    looks = np.where(rng.random(len(a.xy)) < wrong, 0, a.looks.T).T + rng.integers(0, 9, a.looks.shape)
    looks = looks.clip(0, 255).astype(np.uint8)
    xy = a.xy + (SHIFT[:2, 2] + rng.normal(0, 0.5, a.xy.shape)).astype(np.float32)
    columns = xy, (a.turn + np.float32(turn_rad)) % np.float32(2 * np.pi), a.size, looks
    xy, turn, size, looks = (np.ascontiguousarray(column[place]) for column in columns)
    b = Keypoints(xy, turn, size, looks, np.linalg.norm(looks.astype(np.float32), axis=1))
    return a, b, np.argsort(place)


def unit(k: Keypoints) -> np.ndarray:
    return np.asarray(k.looks / k.length[:, None], np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_mutual_is_each_others_best_and_clearly_better_than_the_second(seed: int) -> None:
    a, b, _ = moved(seed, wrong=0.5)
    similarity = unit(a) @ unit(b).T
    ratio = 0.92
    expected = []
    for i, row in enumerate(similarity):
        j, second = int(row.argmax()), float(np.sort(row)[-2])
        if similarity[:, j].argmax() == i and 1 - row[j] < ratio**2 * (1 - second):
            expected.append([i, j])
    assert 50 < len(expected) < len(similarity)
    assert mutual(similarity, ratio).tolist() == expected


@pytest.mark.parametrize("turn_rad", [0.0, 1.0, 3.1, 6.2])
def test_those_that_agree_are_turned_alike(turn_rad: float) -> None:
    a, b, there = moved(5, turn_rad)
    true = np.column_stack((np.arange(len(there)), there))
    false = np.column_stack((np.arange(len(there)), np.roll(there, 7)))
    agree = agreeing(np.concatenate((true, false)), a, b, 36)
    assert agree[: len(true)].all()
    assert agree[len(true) :].mean() < 0.25


def test_around_finds_what_is_there_and_nothing_elsewhere() -> None:
    a, b, there = moved(6, turn_rad=0.5)
    for reach in (3.0, 30.0):
        found = around(SHIFT, reach, 0.9, 0.5, a, b)
        assert len(found) > 0.7 * len(there)  # a fifth has lost its looks
        assert (there[found[:, 0]] == found[:, 1]).all()
    assert len(around(SHIFT, 30.0, 0.9, 2.5, a, b)) == 0
    elsewhere = SHIFT + np.array([[0, 0, 50.0], [0, 0, 0], [0, 0, 0]])
    assert len(around(elsewhere, 30.0, 0.9, 0.5, a, b)) < 0.1 * len(there)  # loners


def test_windows_hold_what_lies_within_the_limits() -> None:
    a, b, there = moved(7)
    limits = Limits(5.0, 1.0, 2.0, 0.75)
    off = np.linalg.norm(a.xy + SHIFT[:2, 2] - b.xy[there], axis=1)
    alike = (unit(a) * unit(b)[there]).sum(1)
    expected = np.flatnonzero((off < limits.plane) & (alike > limits.cosine))
    found = in_windows(SHIFT[None], np.zeros((3, 3)), a, b, limits)
    assert 100 < len(expected) < len(there)
    assert set(expected.tolist()) >= set(found[:, 0].tolist())
    assert len(found) > 0.95 * len(expected)  # a stranger may lie nearer
    assert (there[found[:, 0]] == found[:, 1]).all()
    twice = in_windows(np.stack((SHIFT, SHIFT)), np.zeros((3, 3)), a, b, limits)
    assert twice.tolist() == found.tolist()


def test_epipolar_lines_leave_out_what_is_off_them() -> None:
    a, b, there = moved(8)
    cross = np.array([[0.0, 0.0, -15.0], [0.0, 0.0, -40.0], [15.0, 40.0, 0.0]])  # lines along the shift
    strict = Limits(5.0, 2.0, 0.2, 0.75)
    along = SHIFT[:2, 2] / np.linalg.norm(SHIFT[:2, 2])
    apart = b.xy[there] - a.xy
    off = np.abs(apart[:, 0] * along[1] - apart[:, 1] * along[0])
    found = in_windows(SHIFT[None], cross, a, b, strict)
    assert len(found) > 20
    assert (off[found[:, 0]] < strict.line + 1e-3).all()
    pairs = np.column_stack((np.arange(len(there)), there))
    on_lines, on_planes = supporting(pairs, SHIFT[None], cross, a, b, strict)
    assert on_lines == (off < strict.line).sum()
    near = np.linalg.norm(apart - SHIFT[:2, 2], axis=1) < strict.plane
    assert on_planes == (near & (off < strict.line)).sum()


def test_in_common_is_what_the_other_picture_can_show() -> None:
    a, b, there = moved(9)
    pairs = np.column_stack((np.arange(len(there)), there))
    far = SHIFT + np.array([[0, 0, SIDE], [0, 0, 0], [0, 0, 0]])
    assert in_common(SHIFT, np.linalg.inv(SHIFT), a, b, pairs)[1] > 0.95 * len(there)
    both, keypoints_there = in_common(far, np.linalg.inv(far), a, b, pairs)
    assert 0.3 * len(there) < keypoints_there < 0.7 * len(there)
    assert both < 0.3 * len(there)
