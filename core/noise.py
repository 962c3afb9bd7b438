"""Value noise on integer lattices: a pure function of place and seed, so that all windows of it fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


def lattice(seed: int, columns: NDArray[np.int64], rows: NDArray[np.int64]) -> Float32:
    """Random values in [−1, 1] of the lattice points rows × columns → (len(rows), len(columns)) float32."""
    with np.errstate(over="ignore"):
        x = columns.astype(np.uint32) * np.uint32(0x9E3779B1)
        y = rows.astype(np.uint32) * np.uint32(0x85EBCA77) + np.uint32(seed * 0x27D4EB2F & 0xFFFFFFFF)
        h = y[:, None] ^ x[None, :]
        for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
            h ^= h >> np.uint32(shift)
            h *= np.uint32(factor)
        h ^= h >> np.uint32(16)
    return np.asarray(h.astype(np.float32) * np.float32(2.0 / 0xFFFFFFFF) - np.float32(1), np.float32)


def value_noise(seed: int, cell_m: float, x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> Float32:
    """Noise in [−1, 1] over the raster of columns x_m (W,) and rows y_m (H,) metres → (H, W) float32.

    It has continuous first derivatives and detail of about `cell_m`.
    """
    (left, column, wx), (bottom, row, wy) = _cells(x_m / cell_m), _cells(y_m / cell_m)
    values = lattice(
        seed,
        np.arange(left, left + int(column.max()) + 2),
        np.arange(bottom, bottom + int(row.max()) + 2),
    )
    along = _blend(values, column, wx)
    return np.ascontiguousarray(_blend(np.ascontiguousarray(along.T), row, wy).T)


def value_noise_at(seed: int, cell_m: float, xy_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same noise at scattered points (N, 2) metres → (N,) float64."""
    (left, column, wx), (bottom, row, wy) = _cells(xy_m[:, 0] / cell_m), _cells(xy_m[:, 1] / cell_m)
    values = lattice(
        seed,
        np.arange(left, left + int(column.max()) + 2),
        np.arange(bottom, bottom + int(row.max()) + 2),
    ).astype(float)
    low = values[row, column] * (1 - wx) + values[row, column + 1] * wx
    high = values[row + 1, column] * (1 - wx) + values[row + 1, column + 1] * wx
    return np.asarray(low * (1 - wy) + high * wy)


def _cells(t: NDArray[np.float64]) -> tuple[int, NDArray[np.int64], NDArray[np.float64]]:
    """Lattice coordinates → the first index, each point's index from there, smooth weight of the next."""
    whole = np.floor(t)
    part = t - whole
    first = int(whole.min())
    return first, whole.astype(np.int64) - first, part * part * part * (part * (part * 6 - 15) + 10)


def _blend(values: Float32, column: NDArray[np.int64], weight: NDArray[np.float64]) -> Float32:
    w = weight.astype(np.float32)
    return np.asarray(values[:, column] * (1 - w) + values[:, column + 1] * w, np.float32)
