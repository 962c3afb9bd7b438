"""What one pair says of its two cameras over flat ground: their relative rotation, and the step between them.

A photo p = x − iy of a camera that is tilted by a = (w_y, w_x) away from level shows the ground as
z·(p + p·(a·p)) + c: a similarity and two numbers. Of a pair that makes the eight of a homography. They are
solved for as they stand, with a weak belief in level cameras, so that a pair of little parallax or few points
still has an answer, and only one (where decomposing a homography gives two, or none).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.compiled import compiled
from core.geometry import Array
from core.pose_graph.attitude import level_to_world
from core.pose_graph.averaging import Moments, ratios
from core.pose_graph.residuals import IntArray, rotations
from core.pose_graph.sparse import ComplexArray

# Variance of a correspondence, as a share of the height squared, over that of a camera's tilt, rad².
LEVEL = 1e-4
# Relief errs in patches: what a pair's points are worth.
INDEPENDENT = 4.0


@dataclass(frozen=True, slots=True)
class TwoViews:
    """E pairs. `turn`: (E, 3, 3) first_R_second. `step`: (E, 3) from the first camera to the second as the
    first one sees it, in its heights above ground. `down`: (E, 2, 3) unit vectors towards the ground plane,
    as the first and the second see it. `sigma`: (E,) of the turn, radians.
    """

    turn: Array
    step: Array
    down: Array
    sigma: Array


def two_views(
    first: ComplexArray, second: ComplexArray, starts: IntArray, m: Moments, level: Array, pairs: IntArray
) -> TwoViews:
    """From the rays p (M,) of each pair's points in its two frames, turned by `level` (N, 3, 3)."""
    z = 1 / ratios(m)[0]
    x, sigma = _planar(first, second, starts, z)
    z, c = z + x[:, 0] + 1j * x[:, 1], x[:, 2] + 1j * x[:, 3]
    ground = level_to_world(np.zeros(1))[0]
    tilt = [rotations(np.column_stack((x[:, k + 1], x[:, k], np.zeros(len(x))))) for k in (4, 6)]
    R_first = ground @ tilt[0] @ level[pairs[:, 0]]
    R_second = level_to_world(-np.angle(z)) @ tilt[1] @ level[pairs[:, 1]]
    seen = np.column_stack((c.real, c.imag, np.abs(z) - 1))
    return TwoViews(
        np.einsum("eji,ejk->eik", R_first, R_second),
        np.einsum("eji,ej->ei", R_first, seen),
        np.stack((-R_first[:, 2], -R_second[:, 2]), 1),
        sigma,
    )


def _planar(
    first: ComplexArray, second: ComplexArray, starts: IntArray, z: ComplexArray
) -> tuple[Array, Array]:
    """Corrections (E, 8) to z = z_j / z_i, c = c_j − c_i (in the first's heights) and both tilts; and the
    standard deviation (E,) of the difference of the tilts, radians.
    """
    normal = np.zeros((len(z), 9, 9))
    _sum_products(first, second, starts, z, normal)
    H, g = normal[:, :8, :8], -normal[:, :8, 8]
    H[:, range(4), range(4)] += 1e-9
    H[:, range(4, 8), range(4, 8)] += LEVEL
    inverse = np.linalg.inv(H)
    x = np.einsum("eab,eb->ea", inverse, g)
    left = np.maximum(normal[:, 8, 8] - np.einsum("ea,ea->e", x, g), 0.0) / 2
    # what differs between the two tilts, the second's turned into the first's directions
    turned = np.exp(1j * np.angle(z))
    D = np.zeros((len(z), 2, 4))
    D[:, 0, 0] = D[:, 1, 1] = 1.0
    D[:, 0, 2], D[:, 0, 3] = -turned.real, turned.imag
    D[:, 1, 2], D[:, 1, 3] = -turned.imag, -turned.real
    spread = np.einsum("eak,ekl,eal->e", D, inverse[:, 4:, 4:], D) / 2
    return x, np.sqrt(left * spread / INDEPENDENT)


@compiled
def _sum_products(
    first: ComplexArray, second: ComplexArray, starts: IntArray, z: ComplexArray, normal: Array
) -> None:
    """Means over each pair's points of AᵀA, in `normal` (E, 9, 9): A's last column is what is left over."""
    row = np.empty(9, np.complex128)
    for e in range(len(z)):
        total = normal[e]
        for m in range(starts[e], starts[e + 1]):
            p, q = first[m], second[m]
            zq = z[e] * q
            row[0], row[1], row[2], row[3] = -q, -1j * q, -1.0, -1j
            row[4], row[5], row[6], row[7] = p * p.real, p * p.imag, -zq * q.real, -zq * q.imag
            row[8] = p - zq
            for a in range(9):
                for b in range(a, 9):
                    total[a, b] += row[a].real * row[b].real + row[a].imag * row[b].imag
        for a in range(9):
            for b in range(a, 9):
                total[a, b] /= starts[e + 1] - starts[e]
                total[b, a] = total[a, b]
