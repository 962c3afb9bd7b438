"""What the global solve costs on one thread: python -m tests.bench.solver [photos …]

Simulated flights with 2 m GPS noise whose correspondences are projected ground points, with `--pairs` matched
pairs a photo. One line of JSON a flight: CPU seconds of the best of some runs, sigmas included; the peak
memory of the process; errors against the truth.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from collections.abc import Sequence

for library in ("OMP", "OPENBLAS", "NUMBA"):
    os.environ[f"{library}_NUM_THREADS"] = "1"

import numpy as np  # noqa: E402
from scipy.spatial import cKDTree  # noqa: E402

from core.matching import MatchCounts, PairMatch  # noqa: E402
from core.pose_graph import GraphFrame, solve  # noqa: E402
from core.simulation import FlightParams, Shot, plan_flight  # noqa: E402
from tests.flights.missions import Mission, center_errors_m, frame_id, meta_of, rms, sigmas_m  # noqa: E402

POINTS, NOISE_PX, FEWEST = 45, 0.7, 15


def matched(rng: np.random.Generator, base_m: float, pair: Sequence[tuple[str, Shot]]) -> PairMatch | None:
    """Points of the ground that both photos show, with noise; None where they share too little."""
    (low, a), (high, b) = sorted(pair, key=lambda named: named[0])
    side = a.pose.center[2] - base_m
    middle = (a.pose.center + b.pose.center)[:2] / 2
    xy = middle + rng.uniform(-0.8 * side, 0.8 * side, (6 * POINTS, 2))
    ground = np.column_stack((xy, np.full(len(xy), base_m)))
    uv = [s.pose.pixels(s.camera, ground) for s in (a, b)]
    size = np.array([a.camera.width, a.camera.height])
    seen = np.flatnonzero(np.all([((u > 5) & (u < size - 5)).all(1) for u in uv], axis=0))[:POINTS]
    if len(seen) < FEWEST:
        return None
    first, second = ((u[seen] + rng.normal(0, NOISE_PX, (len(seen), 2))).astype(np.float32) for u in uv)
    return PairMatch(low, high, True, "ok", first, second, MatchCounts(final=len(seen)))


def flight(photos: int, pairs: float) -> tuple[Mission, list[PairMatch]]:
    """A flight and the matches of its nearest photos, `pairs` a photo."""
    params = FlightParams(frames=photos, drones=1, gps_noise_m=2.0, cars=0, seed=1)
    plan, rng = plan_flight(params), np.random.default_rng(1)
    shots = {frame_id(s): s for s in plan.shots}
    named = list(shots.items())
    tree = cKDTree(np.array([s.pose.center[:2] for s in shots.values()]))
    apart, near = tree.query(tree.data, k=min(15, photos))
    away = {
        (min(i, j), max(i, j)): float(apart[i, column])
        for i in range(photos)
        for column, j in enumerate(near[i].tolist())
        if i != j
    }
    matches = []
    for i, j in sorted(away, key=lambda p: (away[p], p)):
        found = matched(rng, params.base_alt_m, (named[i], named[j]))
        if found is not None:
            matches.append(found)
        if len(matches) >= pairs * photos:
            break
    frames = tuple(GraphFrame(k, s.name, meta_of(params, s)) for k, s in shots.items())
    return Mission(plan, shots, frames, {}), matches


def main() -> None:
    """Reads the arguments and prints one line of JSON a flight."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", nargs="*", type=int, default=[200, 1000, 2000, 5000])
    parser.add_argument("--pairs", type=float, default=6.0)
    parser.add_argument("--runs", type=int, default=3)
    options = parser.parse_args()
    small, few = flight(50, options.pairs)
    solve(small.frames, few)  # compiled from here on
    for photos in options.photos:
        mission, matches = flight(photos, options.pairs)
        seconds = []
        for _ in range(options.runs):
            start = time.process_time()
            solution = solve(mission.frames, matches)
            seconds.append(time.process_time() - start)
        errors = center_errors_m(mission, solution)
        figures = {
            "photos": photos,
            "pairs": len(matches),
            "cpu_s": round(min(seconds), 3),
            "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
            "linearisations": solution.steps,
            "center_rms_m": round(rms(errors), 3),
            "within_3_sigma": round(float((np.abs(errors / sigmas_m(mission, solution)) < 3).mean()), 3),
        }
        print(json.dumps(figures), flush=True)


if __name__ == "__main__":
    main()
