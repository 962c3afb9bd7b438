"""Each step of matching a pair (Zhao 2020, 3.2; Avola 2019, eq. 2) on keypoints whose truth is known.

Landmarks are projected into two photos of a simulated flight; what a step may keep and what it must drop is
then known landmark by landmark.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

from core.features import Features
from core.geometry import Array
from core.matching import MatchParams, PairMatch, match_pair
from core.simulation import Flight, FlightParams, Shot, look_down, plan_flight
from tests.flights.landmarks import LandmarkParams, features

LOW, HIGH = "0" * 32, "f" * 32
PLAN = FlightParams(frames=6, drones=1, lines=1, forward_overlap=0.6, seed=3)
EVERYTHING = MatchParams(max_final=10_000)
AT_ONCE = replace(EVERYTHING, strongest=10_000)
"""Without a first look at the strongest keypoints."""
SEEDS = (3, 4, 5)


@dataclass(frozen=True)
class Couple:
    """Two photos in a row, and where the ground that one shows lies in the other."""

    flight: Flight
    first: Shot
    second: Shot
    low: Features
    high: Features

    def match(self, params: MatchParams = EVERYTHING) -> PairMatch:
        cameras = self.first.camera, self.second.camera
        return match_pair(LOW, self.low, HIGH, self.high, *cameras, params)

    def expected(self, uv: Array) -> Array:
        """Pixels (N, 2) of the first photo → of the second, over the true relief."""
        return self.second.pose.pixels(self.second.camera, self.flight.ground(self.first, uv.astype(float)))

    def errors_px(self, found: PairMatch) -> Array:
        return np.asarray(np.linalg.norm(self.expected(found.uv_low) - found.uv_high, axis=1))

    def off_line_px(self, found: PairMatch) -> Array:
        """How far each match lies from its true epipolar line, pixels of the second photo."""
        a = self.first.pose
        rays = self.first.camera.rays(found.uv_low.astype(float)) @ a.world_R_cam.T
        near, far = (self.second.pose.pixels(self.second.camera, a.center + s * rays) for s in (50.0, 75.0))
        along = (far - near) / np.linalg.norm(far - near, axis=1)[:, None]
        miss = found.uv_high - near
        return np.asarray(np.abs(miss[:, 0] * along[:, 1] - miss[:, 1] * along[:, 0]))

    def common(self) -> int:
        """How many landmarks both photos found: ground truth of what a perfect matcher gets."""
        there = self.expected(self.low.keypoints)
        apart = np.linalg.norm(there[:, None] - self.high.keypoints[None], axis=2)
        return int((apart.min(1) < 3.5).sum())


@cache
def couple(
    params: FlightParams = PLAN, seen: LandmarkParams | None = None, turn_deg: float | None = None
) -> Couple:
    """The second and third photo of a strip; `turn_deg`: how the third is turned against the second."""
    flight = plan_flight(params)
    shots = list(flight.shots)
    if turn_deg is not None:
        for k, heading_deg in ((1, 0.0), (2, turn_deg)):
            level = replace(shots[k].pose, world_R_cam=look_down(np.radians(heading_deg)))
            shots[k] = replace(shots[k], pose=level)
        flight = replace(flight, shots=tuple(shots))
    found = features(flight, seen)
    return Couple(flight, shots[1], shots[2], found[1], found[2])


# ---- the vote on the relative turn


@pytest.mark.parametrize("turn_deg", [0.0, 41.0, 90.0, 137.0, 180.0, 181.0, 269.0, 359.0])
def test_the_vote_finds_any_turn_and_keeps_the_share_that_tells_it(turn_deg: float) -> None:
    share = 0.2  # of the keypoints' turns mean nothing, so (1 − 0.2)² of the matches tell the truth
    c = (
        couple(replace(PLAN, width_px=900, height_px=900), LandmarkParams(900, odd_turns=share), turn_deg)
        .match(AT_ONCE)
        .counts
    )
    honest = (1 - share) ** 2
    by_chance = (1 - honest) * 4 / 36  # 2 bins of 36 to either side
    assert c.tentative > 150
    assert c.voted / c.tentative == pytest.approx(honest + by_chance, abs=0.1)


def test_turns_that_mean_nothing_agree_by_chance_only() -> None:
    c = couple(PLAN, LandmarkParams(800, odd_turns=1.0)).match(AT_ONCE).counts
    assert c.tentative > 150
    assert c.voted / c.tentative == pytest.approx(4 / 36, abs=0.07)


def test_what_the_vote_drops_guided_matching_brings_back() -> None:
    c = couple(PLAN, LandmarkParams(odd_turns=0.3)).match().counts
    assert c.voted < 0.7 * c.tentative
    assert c.guided > 1.3 * c.voted


# ---- the first look


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("relief_m", [0.0, 8.0])
def test_looking_at_the_strongest_first_finds_what_looking_at_all_at_once_does(
    relief_m: float, seed: int
) -> None:
    c = couple(replace(PLAN, relief_m=relief_m, seed=seed), LandmarkParams(1000))
    first, all_at_once = c.match(), c.match(AT_ONCE)
    assert first.accepted
    assert all_at_once.accepted
    assert first.counts.tentative < 0.6 * all_at_once.counts.tentative
    found, expected = (
        {(*p, *q) for p, q in zip(m.uv_low.tolist(), m.uv_high.tolist(), strict=True)}
        for m in (first, all_at_once)
    )
    assert len(found & expected) > 0.9 * max(len(found), len(expected))
    assert np.percentile(c.off_line_px(first), 97) < 2.0 * PLAN.width_px / 640 + 2 * 0.7


def test_what_the_strongest_do_not_tell_all_may() -> None:
    c = couple(replace(PLAN, forward_overlap=0.25), LandmarkParams(1000))
    few = c.match(replace(EVERYTHING, strongest=60))
    assert few.accepted
    assert few.counts == c.match(AT_ONCE).counts


# ---- the cross check


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("twins", [0.3, 0.8])
def test_each_keypoint_has_one_partner_though_most_look_alike(twins: float, seed: int) -> None:
    c = couple(replace(PLAN, seed=seed), LandmarkParams(800, twins=twins))
    found = c.match()
    assert found.accepted
    for side in (found.uv_low, found.uv_high):
        assert len(np.unique(side, axis=0)) == len(side)
    assert (c.errors_px(found) < 6).mean() > 0.97


@pytest.mark.parametrize("twins", [0.0, 0.6])
def test_swapped_roles_give_the_same_matches(twins: float) -> None:
    there = couple(PLAN, LandmarkParams(twins=twins))
    back = Couple(there.flight, there.second, there.first, there.high, there.low)
    one, other = there.match(), back.match()
    pairs = {(*p, *q) for p, q in zip(one.uv_low.tolist(), one.uv_high.tolist(), strict=True)}
    swapped = {(*q, *p) for p, q in zip(other.uv_low.tolist(), other.uv_high.tolist(), strict=True)}
    assert one.counts.tentative == pytest.approx(other.counts.tentative, rel=0.1)  # the ratio has a direction
    assert len(pairs & swapped) > 0.93 * max(len(pairs), len(swapped))


def test_nothing_but_twins_is_no_pair() -> None:
    found = couple(PLAN, LandmarkParams(twins=1.0)).match()
    assert not found.accepted


# ---- the fundamental matrix, and matching anew in windows


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("relief_m", [0.0, 8.0])
def test_all_that_is_accepted_lies_on_its_epipolar_line(relief_m: float, seed: int) -> None:
    c = couple(replace(PLAN, relief_m=relief_m, seed=seed))
    found = c.match()
    assert found.accepted
    # 2 px of a copy of 640, and a pixel of noise in the two photos
    limit = 2.0 * PLAN.width_px / 640 + 2 * 0.7
    assert np.percentile(c.off_line_px(found), 97) < limit
    assert np.median(c.off_line_px(found)) < 1.2


@pytest.mark.parametrize("seed", SEEDS)
def test_windows_find_again_most_of_what_both_photos_saw(seed: int) -> None:
    # dull descriptors: half of the true pairs fail the ratio test at first
    c = couple(replace(PLAN, seed=seed), LandmarkParams(800, twins=0.5, descriptor_noise=0.4))
    found = c.match()
    true = int((c.errors_px(found) < 6).sum())
    assert found.counts.tentative < 0.75 * c.common()
    assert found.counts.guided > 1.2 * found.counts.homography
    assert true > 0.8 * c.common()
    assert true > 0.97 * len(found.uv_low)


def test_a_wider_window_accepts_nothing_further_off_its_line() -> None:
    c = couple(replace(PLAN, relief_m=8.0))
    wide = c.match(replace(EVERYTHING, window_px=20.0, foreground_px=20.0))
    usual = c.match()
    assert wide.counts.guided > usual.counts.guided  # hills stand out from the planes, and are on their lines
    assert np.percentile(c.off_line_px(wide), 97) < 2.0 * PLAN.width_px / 640 + 2 * 0.7


# ---- the foreground


RHO_PX = MatchParams().foreground_px * PLAN.width_px / 640  # of the photo itself


def herded(c: Couple, step_px: float) -> tuple[Couple, Array]:
    """A herd on 7 m of ground that moves by `step_px` along the epipolar lines, and whether a keypoint of the
    first photo (K,) is one of it. No fundamental matrix sees such a move.
    """
    uv, there = c.low.keypoints, c.high.keypoints
    common = ((c.expected(uv) > 0) & (c.expected(uv) < (c.first.camera.width, c.first.camera.height))).all(1)
    centre = uv[common].mean(0)
    way = c.expected(centre[None])[0] - centre
    along = way / np.linalg.norm(way)
    grazing = np.linalg.norm(there - c.expected(centre[None]), axis=1) < 60
    moved = there + np.where(grazing[:, None], step_px * along, 0.0).astype(np.float32)
    member = np.linalg.norm(c.low.keypoints - centre, axis=1) < 60
    return replace(c, high=replace(c.high, keypoints=moved)), member


def of_the_herd(c: Couple, member: Array, found: PairMatch) -> int:
    chosen = {tuple(p) for p in c.low.keypoints[member > 0].tolist()}
    return sum(tuple(p) in chosen for p in found.uv_low.tolist())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("rhos", [2.2, 4.0, 8.0, 20.0])
def test_what_moves_by_more_than_rho_is_left_out_and_the_ground_kept(rhos: float, seed: int) -> None:
    still = couple(replace(PLAN, seed=seed), LandmarkParams(2500, noise_px=0.5))
    moving, member = herded(still, rhos * RHO_PX)
    before, after = still.match(), moving.match()
    assert of_the_herd(still, member, before) > 4
    assert of_the_herd(moving, member, after) <= 1
    kept = after.counts.final - of_the_herd(moving, member, after)
    assert kept > 0.97 * (before.counts.final - of_the_herd(still, member, before))
    if rhos < 3:  # without the filter they would be in
        lenient = moving.match(replace(EVERYTHING, foreground_px=60.0, window_px=60.0))
        assert of_the_herd(moving, member, lenient) > 4


@pytest.mark.parametrize("seed", SEEDS)
def test_cars_that_drive_are_no_ground(seed: int) -> None:
    quiet = couple(replace(PLAN, seed=seed), LandmarkParams())
    busy = couple(replace(PLAN, cars=80, seed=seed), LandmarkParams(on_a_car=25))
    assert len(busy.low.keypoints) > len(quiet.low.keypoints) + 20
    found = busy.match()
    assert found.accepted
    assert busy.errors_px(found).max() < RHO_PX + 1.5
    assert found.counts.final > 0.85 * quiet.match().counts.final


@pytest.mark.parametrize("rho_px", [0.5, 1.0, 2.0])
def test_rho_bounds_how_far_matches_lie_from_the_plane(rho_px: float) -> None:
    c = couple(PLAN, LandmarkParams(800, noise_px=1.0))
    found = c.match(replace(EVERYTHING, foreground_px=rho_px))
    # on level ground the true homography is the plane; the fitted one is within half a pixel of it
    assert c.errors_px(found).max() < (rho_px + 0.5) * PLAN.width_px / 640
