"""The whole solution laid onto chosen surveyed points by a robust similarity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.checkpoints import Checkpoints, Observation, by_name, observations
from core.geometry import Pose, PosedFrame
from core.pose_graph.model import Solution

Places = NDArray[np.complex128]
"""Points of the plane as x + iy, (N,)."""


@dataclass(frozen=True, slots=True)
class AlignParams:
    """How far the survey may bend the solution. `sigma_m`: of a point in it, by relief and marking.

    `turn_sigma`: of the solution's own scale and (in radians) heading, so that points close together shift
    the map and only points far apart turn or scale it.
    """

    sigma_m: float = 0.1
    turn_sigma: float = 0.02
    rounds: int = 20


DEFAULT = AlignParams()


@dataclass(frozen=True, slots=True)
class Similarity:
    """x + iy → `shift` + `turn` · (x + iy − `about`) in the plane; heights above `level_m` scale along.

    `rise_m`: what is added to heights.
    """

    about: complex
    turn: complex
    shift: complex
    level_m: float
    rise_m: float

    def moved(self, pose: Pose) -> Pose:
        """The pose after it."""
        scale = abs(self.turn)
        c, s = self.turn.real / scale, self.turn.imag / scale
        new_R_old = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        x, y, z = (float(v) for v in pose.center)
        place = self.shift + self.turn * (complex(x, y) - self.about)
        return replace(
            pose,
            world_R_cam=np.array(new_R_old @ pose.world_R_cam, order="C"),
            center=np.array([place.real, place.imag, self._height(z)]),
            ground_h_m=self._height(pose.ground_h_m),
        )

    def _height(self, z_m: float) -> float:
        return self.level_m + abs(self.turn) * (z_m - self.level_m) + self.rise_m


def aligned(
    solution: Solution,
    names: Mapping[str, str],
    camera_keys: Mapping[str, str],
    checkpoints: Checkpoints,
    params: AlignParams = DEFAULT,
) -> Solution:
    """The solution with the used points where the survey says; as it is when none of them is seen.

    `names`: frame id → photo name; `camera_keys`: frame id → camera. One point shifts the map, more turn and
    scale it too. Heights follow unless the file gives all points the same one.
    """
    frames = by_name(
        (names[k], PosedFrame(k, solution.cameras[camera_keys[k]], solution.poses[k]))
        for k in sorted(solution.poses)
    )
    seen = observations(checkpoints, solution.world, frames)
    used = [o for o in seen if o.sighting.point in checkpoints.used]
    if not used:
        return solution
    fit = similarity(used, checkpoints.heights_tell, params)
    return replace(solution, poses={k: fit.moved(pose) for k, pose in solution.poses.items()})


def similarity(used: Sequence[Observation], heights_tell: bool, params: AlignParams = DEFAULT) -> Similarity:
    """From where the mosaic would show the points to where they are; every point counts once."""
    groups: dict[str, list[Observation]] = {}
    for o in used:
        groups.setdefault(o.sighting.point, []).append(o)
    each = [groups[point] for point in sorted(groups)]
    here = np.array([np.median([o.plane for o in group], axis=0) for group in each])
    there = np.array([np.median([o.at_plane for o in group], axis=0) for group in each])
    about, turn, shift = _robust(here @ (1, 1j), there @ (1, 1j), params)
    level_m = float(np.median([o.frame.pose.ground_h_m for o in used]))
    rises = [np.median([o.truth[2] - o.frame.pose.ground_h_m for o in group]) for group in each]
    return Similarity(about, turn, shift, level_m, float(np.median(rises)) if heights_tell else 0.0)


def _robust(here: Places, there: Places, params: AlignParams) -> tuple[complex, complex, complex]:
    """about, turn, shift of the best similarity, points far off weighing little (Cauchy)."""
    weights = np.ones(len(here))
    prior = (params.sigma_m / params.turn_sigma) ** 2
    about, turn, shift = 0j, 1 + 0j, 0j
    for _ in range(params.rounds):
        about = complex((weights * here).sum() / weights.sum())
        shift = complex((weights * there).sum() / weights.sum())
        a = here - about
        turn = 1 + complex(
            (weights * a.conj() * (there - shift - a)).sum() / ((weights * abs(a) ** 2).sum() + prior)
        )
        off = np.abs(there - shift - turn * a)
        scale = max(params.sigma_m, 1.4826 * float(np.median(off)))
        weights = 1 / (1 + (off / (2 * scale)) ** 2)
    return about, turn, shift
