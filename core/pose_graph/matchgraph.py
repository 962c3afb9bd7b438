"""The match graph: which frames are tied, by which correspondences, and into which submaps they fall."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from core.geometry import Array, Camera
from core.matching import PairMatch
from core.pose_graph.averaging import ComplexArray
from core.pose_graph.model import PoseParams
from core.pose_graph.residuals import Edges, IntArray

GRID = 8


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
    pairs, uv, counts = [], [], []
    for key in sorted(chosen):
        m = chosen[key]
        i, j = index[m.low], index[m.high]
        first, second = cameras[camera[i]], cameras[camera[j]]
        low, high = np.asarray(m.uv_low, float), np.asarray(m.uv_high, float)
        keep = spread(low, first, params.points_per_edge)
        uv.append(np.column_stack((low[keep] - (first.cx, first.cy), high[keep] - (second.cx, second.cy))))
        pairs.append((i, j))
        counts.append(len(keep))
    size = np.array(counts, np.int64)
    return Edges(
        np.array(pairs, np.int64).reshape(-1, 2),
        np.concatenate(([0], np.cumsum(size))).astype(np.int64),
        np.concatenate(uv) if uv else np.zeros((0, 4)),
        np.minimum(1.0, params.independent_points / np.maximum(size, 1)),
        camera,
    )


def spread(uv: Array, camera: Camera, limit: int) -> NDArray[np.int64]:
    """Indices of at most `limit` of the points (M, 2), taken in turn from the cells of a grid, ascending."""
    if len(uv) <= limit:
        return np.arange(len(uv))
    cell = np.clip(uv / (camera.width, camera.height) * GRID, 0, GRID - 1).astype(np.int64) @ (1, GRID)
    order = np.argsort(cell, kind="stable")
    ranked = cell[order]
    begin = np.searchsorted(ranked, ranked)
    turn = np.empty(len(uv), np.int64)
    turn[order] = np.arange(len(uv)) - begin
    return np.sort(np.lexsort((np.arange(len(uv)), cell, turn))[:limit])


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
    """The points of all pairs as x − iy of their rays, turned level by each frame's rotation `level` (N, 3, 3)."""
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
