"""The match graph: which frames are tied, by which correspondences, and into which submaps they fall."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from core.compiled import compiled
from core.geometry import Array, Camera
from core.matching import PairMatch
from core.pose_graph.model import PoseParams
from core.pose_graph.residuals import Edges, IntArray
from core.pose_graph.sparse import ComplexArray

GRID = 8
_AT_ONCE = 1024
"""Pairs thinned together: all of a mission's points are several times as many as are kept."""


def edges_of(
    matches: Sequence[PairMatch],
    index: dict[str, int],
    cameras: Sequence[Camera],
    camera: IntArray,
    params: PoseParams,
) -> Edges:
    """The accepted matches between frames of `index` (frame id → row), sorted, thinned to even coverage."""
    chosen = {
        (m.low, m.high): m
        for m in matches
        if m.accepted and m.low in index and m.high in index and len(m.uv_low) >= params.min_points
    }
    ordered = [chosen[key] for key in sorted(chosen)]
    pairs = np.array([(index[m.low], index[m.high]) for m in ordered], np.int64).reshape(-1, 2)
    axis = np.array([(c.cx, c.cy) for c in cameras]).reshape(-1, 2)[camera]
    size = np.array([(c.width, c.height) for c in cameras], float).reshape(-1, 2)[camera]
    blocks = range(0, len(ordered), _AT_ONCE)
    thin = [_thinned(ordered[k : k + _AT_ONCE], size[pairs[k : k + _AT_ONCE, 0]], params) for k in blocks]
    kept = np.concatenate([count for count, _ in thin]) if thin else np.zeros(0, np.int64)
    uv = np.concatenate([points for _, points in thin]) if thin else np.zeros((0, 4))
    edge = np.repeat(np.arange(len(ordered)), kept)
    uv -= np.column_stack((axis[pairs[edge, 0]], axis[pairs[edge, 1]]))
    starts = np.concatenate(([0], np.cumsum(kept))).astype(np.int64)
    return Edges(pairs, starts, uv, np.minimum(1.0, params.independent_points / np.maximum(kept, 1)), camera)


def _thinned(some: Sequence[PairMatch], size: Array, params: PoseParams) -> tuple[IntArray, Array]:
    """How many points of each pair are kept, and which: (M, 4) pixels. `size` (E, 2) of the first photos."""
    edge = np.repeat(np.arange(len(some)), [len(m.uv_low) for m in some])
    low, high = np.concatenate([m.uv_low for m in some]), np.concatenate([m.uv_high for m in some])
    keep = spread(low / size[edge], edge, params.points_per_edge)
    kept = np.bincount(edge[keep], minlength=len(some)).astype(np.int64)
    return kept, np.column_stack((low[keep], high[keep])).astype(float)


def spread(where: Array, group: IntArray, limit: int) -> NDArray[np.int64]:
    """Indices of at most `limit` points of each group, taken in turn from the cells of a grid, ascending.

    `where`: (M, 2) in the unit square. `group`: (M,) ascending from 0.
    """
    cell = np.clip(where * GRID, 0, GRID - 1).astype(np.int64) @ (1, GRID)
    starts = np.searchsorted(group, np.arange(int(group[-1]) + 2 if len(group) else 1))
    keep = np.zeros(len(cell), bool)
    _take_turns(cell, starts, limit, keep)
    return np.flatnonzero(keep)


@compiled
def _take_turns(cell: IntArray, starts: IntArray, limit: int, keep: NDArray[np.bool_]) -> None:
    """Flag in `keep` the first points of all cells, then the second ones …, `limit` in each group."""
    for k in range(len(starts) - 1):
        taken, turn = 0, 1
        while taken < min(limit, starts[k + 1] - starts[k]):
            seen = np.zeros(GRID * GRID, np.int64)
            for m in range(starts[k], starts[k + 1]):
                seen[cell[m]] += 1
                if seen[cell[m]] == turn and taken < limit:
                    keep[m] = True
                    taken += 1
            turn += 1


def submaps(n: int, pairs: IntArray, ranks: Sequence[object]) -> IntArray:
    """Each frame's submap (N,): 0 = the one with most frames, ties by the smallest of `ranks` in it."""
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    size = np.bincount(label, minlength=count)
    first: dict[int, object] = {}
    for k in sorted(range(n), key=lambda k: ranks[k]):  # type: ignore[arg-type,return-value]
        first.setdefault(int(label[k]), len(first))
    order = sorted(range(count), key=lambda c: (-size[c], first[c]))
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    return np.asarray(rank[label])


def flat_rays(edges: Edges, cameras: Sequence[Camera], level: Array) -> tuple[ComplexArray, ComplexArray]:
    """The points of all pairs as x − iy of their rays, turned by each frame's `level` (N, 3, 3)."""
    rows = np.repeat(np.arange(len(edges)), np.diff(edges.starts))
    out = []
    for side in range(2):
        frame = edges.pairs[rows, side]
        ray = np.empty((len(rows), 3))
        for c, cam in enumerate(cameras):
            mine = edges.camera[frame] == c
            ray[mine] = cam.rays(edges.uv[mine, 2 * side : 2 * side + 2] + (cam.cx, cam.cy))
        turned = np.einsum("nij,nj->ni", level[frame], ray)
        down = np.maximum(turned[:, 2], 0.1)
        out.append(turned[:, 0] / down - 1j * turned[:, 1] / down)
    return out[0], out[1]
