"""Levenberg-Marquardt on the planar-restricted pose graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.geometry import Array
from core.pose_graph.elimination import Front, plan
from core.pose_graph.factor import Border, Factor, factorise, solution
from core.pose_graph.priors import Priors, add_priors
from core.pose_graph.residuals import Edges, Normal, State, linearise, retract

# A step of less than this share of the height above ground (95th percentile) moves no pixel of the map.
SETTLED = 1e-4
HELD = 1e12
# Share of the diagonal added at first, and at least after a step that failed: what only GPS holds weighs a
# millionth of what matches hold, and more than this would keep it from moving.
DAMPING, DAMPED, SINGULAR = 1e-8, 1e-6, 1e-4
# A step that promises less than this share of the least gain is not worth a linearisation.
FORESEEN = 0.5


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The optimum: `state`, its normal equations, how they are eliminated, linearisations done.

    `factor`: of these normal equations, where the last step was not worth taking.
    """

    state: State
    normal: Normal
    structure: tuple[Front, ...]
    steps: int
    factor: Factor | None = None

    @property
    def squared(self) -> Array:
        """(M, 2) residuals in sigmas, squared."""
        return self.normal.squared


def normal_equations(edges: Edges, priors: Priors, state: State, sigma_px: Array, scale: float) -> Normal:
    """Matches and priors together at `state`."""
    normal = linearise(edges, state, sigma_px, scale)
    extra = add_priors(priors, edges.pairs, state, normal)
    return Normal(
        normal.frame, normal.pair, normal.cross, normal.border, normal.frame_rhs, normal.border_rhs,
        normal.cost + extra, normal.squared,
    )  # fmt: skip


def adjust(
    edges: Edges,
    priors: Priors,
    start: State,
    sigma_px: Array,
    scale: float,
    steps: int,
    min_gain: float,
    held: NDArray[np.bool_] | None = None,
    structure: tuple[Front, ...] | None = None,
) -> Adjusted:
    """Minimise from `start`. `sigma_px` (C,), `scale` of the Cauchy loss in sigmas; `held` (N,) frames stay.

    Stops after `steps` linearisations, or when less than `min_gain` of the cost is left to gain: by the last
    step's gain, or by how wrongly that was foreseen. `structure`: the plan of these pairs, if there is one.
    """
    state, damping = start, DAMPING
    normal = normal_equations(edges, priors, state, sigma_px, scale)
    structure = structure or plan(len(start.R), edges.pairs)
    done = 1
    while done < steps:
        factor = _factor(structure, edges, normal, damping, held)
        if factor is None:
            damping = max(damping * 10, SINGULAR)
            done += 1
            continue
        frames, border = solution(factor, len(state.R))
        foreseen = 0.5 * float((frames * normal.frame_rhs).sum() + border @ normal.border_rhs)
        if foreseen < FORESEEN * min_gain * normal.cost:
            return Adjusted(state, normal, structure, done, factor)
        trial = retract(state, frames, border)
        tried = normal_equations(edges, priors, trial, sigma_px, scale)
        done += 1
        if np.isfinite(tried.cost) and tried.cost < normal.cost:
            gain = normal.cost - tried.cost
            moved = np.linalg.norm(trial.t - state.t, axis=1) / np.maximum(trial.t[:, 2] - trial.h, 0.1)
            state, normal, damping = trial, tried, damping * 0.1
            if min(gain, abs(gain - foreseen)) < min_gain * normal.cost or np.percentile(moved, 95) < SETTLED:
                break
        else:
            damping = max(damping * 30, DAMPED)
            if damping > 1e4:
                break
    return Adjusted(state, normal, structure, done)


def _factor(
    structure: tuple[Front, ...], edges: Edges, normal: Normal, damping: float, held: NDArray[np.bool_] | None
) -> Factor | None:
    diagonal = np.arange(normal.frame.shape[1])
    frame, pair, cross, rhs = normal.frame.copy(), normal.pair, normal.cross, normal.frame_rhs
    frame[:, diagonal, diagonal] *= 1 + damping
    border = normal.border.copy()
    border[np.diag_indices(len(border))] *= 1 + damping
    if held is not None:
        frame[held] = np.eye(len(diagonal)) * HELD
        rhs, cross = np.where(held[:, None], 0.0, rhs), np.where(held[:, None, None], 0.0, cross)
        still = held[edges.pairs[:, 0]] | held[edges.pairs[:, 1]]
        pair = np.where(still[:, None, None], 0.0, pair)
    return factorise(structure, frame, pair, rhs, Border(cross, border, normal.border_rhs))
