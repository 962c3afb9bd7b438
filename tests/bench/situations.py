"""The situations of a flight whose truth is known: how far the poses are off, without drawing a picture.

Keypoints are projected landmarks (`tests.flights.landmarks`); neighbours, matching, submaps and poses are the
program's own. One core, some seconds a flight. Figures are root mean squares over all seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from core.geometry import Array
from core.pose_graph import PoseParams, Solution
from core.simulation import FlightParams
from tests.flights.landmarks import LandmarkParams
from tests.flights.missions import (
    Mission,
    center_errors_m,
    fitted,
    gps_bound_m,
    ground,
    height_errors,
    interrupted,
    mission,
    posed,
    rms,
    route_fit,
    route_length_m,
    sigmas_m,
)

Line = dict[str, Any]
Measure = Callable[[list[Mission]], Line]
SEEN = LandmarkParams(keypoints=300)
RELIEFS_M = (0.0, 2.0, 10.0)
SIGMA_RELIEFS_M = (0.0, 2.0, 10.0, 30.0)
SIGMA_FRAMES = 72


def situations(frames: int, seeds: Sequence[int], only: str = "") -> Iterator[Line]:
    """A line of figures for each situation whose name holds `only`, as soon as it is measured."""
    for name, params, measure in _all(frames):
        if only in name:
            yield _line(name, params, seeds, measure)


def _all(frames: int) -> Iterator[tuple[str, FlightParams, Measure]]:
    plan = FlightParams(frames=frames, drones=1, gps_noise_m=2.0)
    for relief_m in RELIEFS_M:
        yield f"2 m GPS, relief {relief_m:g} m", replace(plan, relief_m=relief_m), _accuracy
    low = replace(plan, forward_overlap=0.4, side_overlap=0.3)
    yield "2 m GPS, overlap 40/30", low, _togetherness
    yield "2 m GPS, three interruptions", plan, _interruptions
    blind = replace(plan, no_gps=1.0)
    yield "no GPS, three interruptions", blind, _interruptions
    for relief_m in RELIEFS_M[:2]:
        named = f"no GPS, first height known, relief {relief_m:g} m"
        yield named, replace(blind, relief_m=relief_m), _route
    for relief_m in SIGMA_RELIEFS_M:
        smaller = replace(plan, frames=SIGMA_FRAMES, relief_m=relief_m)
        yield f"sigma, 2 m GPS, relief {relief_m:g} m", smaller, _sigmas


def _line(name: str, params: FlightParams, seeds: Sequence[int], measure: Measure) -> Line:
    flights = [mission(replace(params, seed=seed), SEEN) for seed in seeds]
    head = {
        "situation": name,
        "frames": params.frames,
        "seeds": list(seeds),
        "matches": "projected landmarks",
    }
    return head | measure(flights)


def _accuracy(flights: list[Mission]) -> Line:
    """Of the ground that the pictures' middles show, metres; `by_seed` as it lies (raw)."""
    solved = [(m, m.solved()) for m in flights]
    pairs = [ground(m, s) for m, s in solved]
    errors = [found - truth for found, truth in pairs]
    every = np.concatenate(errors)
    east, north = np.sqrt((every**2).mean(0))
    return {
        "tied": _mean([len(posed(m, s)) / len(m.frames) for m, s in solved]),
        "rmse_m": {
            "raw": _round(rms(every)),
            "east": _round(east),
            "north": _round(north),
            "bias_removed": _round(rms(np.concatenate([e - e.mean(0) for e in errors]))),
            "similarity_removed": _pooled([fitted(*both).rms_m for both in pairs]),
        },
        "by_seed_m": [_round(rms(e)) for e in errors],
        "similarity_of_gps_alone_m": _pooled([gps_bound_m(m) for m in flights]),
    }


def _togetherness(flights: list[Mission]) -> Line:
    """The largest map's share of all frames."""
    shares = []
    for m in flights:
        solution = m.solved()
        shares.append(sum(solution.poses[k].submap == 0 for k in posed(m, solution)) / len(m.frames))
    return {"in_one_submap": _mean(shares), "worst": _round(min(shares))}


def _interruptions(flights: list[Mission]) -> Line:
    """Frames kept, maps that are left, and the trajectory's RMSE against that of the whole run.

    `trajectory_m`: as it lies (with GPS); `shape_m`: after the best similarity.
    """
    kept, maps, errors, shapes = [], [], [], []
    for m in flights:
        broken = interrupted(m, 3)
        runs = [(m, m.solved()), (broken, broken.solved())]
        kept.append(len(posed(*runs[1])) / len(m.frames))
        maps.append(len({p.submap for p in runs[1][1].poses.values()}))
        errors.append([rms(center_errors_m(*run)[:, :2]) for run in runs])
        shapes.append([route_fit(*run).rms_m for run in runs])
    located = any(meta.gps for meta in flights[0].meta.values())
    lines = {"trajectory_m": errors, "shape_m": shapes} if located else {"shape_m": shapes}
    return {"kept": _mean(kept), "maps": max(maps)} | {k: _against(np.array(v)) for k, v in lines.items()}


def _against(runs: Array) -> Line:
    whole, broken = np.sqrt((runs**2).mean(0))
    return {"whole": _round(whole), "interrupted": _round(broken), "ratio": _round(broken / whole)}


def _route(flights: list[Mission]) -> Line:
    """The route's shape as per cent of its length, heights as per cent of themselves."""
    shapes, heights, scales = [], [], []
    for m in flights:
        first = m.shots[next(iter(m.shots))].pose
        solution = m.solved(PoseParams(first_height_m=float(first.center[2] - first.ground_h_m)))
        fit = route_fit(m, solution)
        shapes.append(100 * fit.rms_m / route_length_m(m))
        heights.append(float(100 * np.sqrt((height_errors(m, solution) ** 2).mean())))
        scales.append(100 * (fit.scale - 1))
    return {
        "shape_rmse_percent": _pooled(shapes),
        "height_rmse_percent": _pooled(heights),
        "scale_percent": _pooled(scales),
    }


def _sigmas(flights: list[Mission]) -> Line:
    """The share of true errors of the centres within three of their stated sigmas."""
    in_sigmas = []
    for m in flights:
        solution: Solution = m.solved()
        in_sigmas.append(np.abs(center_errors_m(m, solution)) / sigmas_m(m, solution))
    every = np.concatenate(in_sigmas)
    return {
        "within_3_sigma": [_round(v) for v in (every < 3).mean(0)],
        "all_axes": _round((every < 3).mean()),
        "rms_in_sigmas": [_round(v) for v in np.sqrt((every**2).mean(0))],
    }


def _mean(values: Sequence[float]) -> float:
    return _round(float(np.mean(values)))


def _pooled(values: Sequence[float]) -> float:
    return _round(float(np.sqrt(np.square(values).mean())))


def _round(value: float) -> float:
    return float(f"{value:.4g}")
