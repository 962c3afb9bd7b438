"""What stands on a landscape's parcels and along its roads: trees, houses, gardens, cars."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from core.landscape import Array, Colour, Furniture, House, Landscape, Parcel, Patch, stream_v

LOT_M = (24.0, 30.0)
STREET_M = 5.0


def _dry(seed: int, uv: Array, clear_m: float) -> NDArray[np.bool_]:
    """Which plan points (N, 2) keep `clear_m` from the stream's middle."""
    return np.asarray(np.abs(uv[:, 1] - stream_v(seed, uv[:, 0])) > clear_m)


def _inside(
    rect: tuple[float, float, float, float], edge_m: float, n: int, rng: np.random.Generator
) -> Array:
    u0, v0, u1, v1 = rect
    return np.column_stack(
        (rng.uniform(u0 + edge_m, u1 - edge_m, n), rng.uniform(v0 + edge_m, v1 - edge_m, n))
    )


def _trees(plan: Landscape, uv: Array, radius_m: tuple[float, float], rng: np.random.Generator) -> Array:
    uv = uv[_dry(plan.params.seed, uv, 6.0)]
    radius = rng.uniform(*radius_m, len(uv))
    height = radius * rng.uniform(1.7, 2.6, len(uv))
    return np.column_stack((plan.bend(uv), radius, np.minimum(height, 11), rng.uniform(0, 1, len(uv))))


@lru_cache(maxsize=4096)
def furniture(plan: Landscape, parcel: Parcel) -> Furniture:
    """What stands on `parcel`."""
    rng = np.random.default_rng((plan.params.seed, 4, parcel.index))
    u0, v0, u1, v1 = parcel.rect
    area = (u1 - u0) * (v1 - v0)
    banks = _bank_trees(plan, parcel, rng)
    if parcel.kind == "lots":
        return _village(plan, parcel, banks, rng)
    if parcel.kind == "forest":
        grown = _trees(plan, _inside(parcel.rect, 3, int(area / 13), rng), (1.6, 4.2), rng)
        return Furniture(np.concatenate((grown, banks)))
    if parcel.kind == "orchard":
        grid = np.stack(np.meshgrid(np.arange(u0 + 6, u1 - 5, 6.5), np.arange(v0 + 6, v1 - 5, 5.5)), -1)
        uv = grid.reshape(-1, 2) + rng.normal(0, 0.35, (grid[..., 0].size, 2))
        return Furniture(
            np.concatenate((_trees(plan, uv[rng.random(len(uv)) < 0.9], (1.4, 2.2), rng), banks))
        )
    if parcel.kind == "pitch":
        return Furniture(banks, patches=tuple(_pitch(plan, parcel)))
    if parcel.kind in ("pasture", "meadow"):
        few = _trees(plan, _inside(parcel.rect, 8, int(rng.integers(0, 7)), rng), (2.0, 4.6), rng)
        return Furniture(np.concatenate((few, banks)))
    bales = tuple(_bales(plan, parcel, rng)) if parcel.kind == "stubble" and not parcel.monotone else ()
    return Furniture(banks, patches=bales)


def _bank_trees(plan: Landscape, parcel: Parcel, rng: np.random.Generator) -> Array:
    u0, v0, u1, v1 = parcel.rect
    u = rng.uniform(u0, u1, int((u1 - u0) / 3.4))
    side = rng.choice((-1.0, 1.0), len(u))
    uv = np.column_stack((u, stream_v(plan.params.seed, u) + side * rng.uniform(7.0, 11.0, len(u))))
    kept = uv[(uv[:, 1] > v0) & (uv[:, 1] < v1)]
    return _trees(plan, kept, (1.3, 3.6), rng)


@lru_cache(maxsize=4096)
def verge_trees(plan: Landscape, index: int) -> Array:
    """The trees (N, 5) along road `index`, as in `Furniture.trees`."""
    rng = np.random.default_rng((plan.params.seed, 5, index))
    road = plan.roads[index]
    every, sway, radius = {
        "hedge": (2.1, 0.5, (1.1, 2.3)),
        "margin": (34.0, 0.5, (1.8, 3.6)),
        "track": (26.0, 1.0, (1.8, 4.0)),
        "lane": (60.0, 1.0, (2.0, 4.0)),
        "main": (15.0, 0.4, (2.2, 3.2)),
    }[road.kind]
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(road.line, axis=0).T))))
    along = np.arange(rng.uniform(0, every), length[-1], every) + rng.normal(0, 0.2 * every, 1)
    if road.kind == "main" and rng.random() < 0.5:
        along = along[:0]
    xy = np.column_stack([np.interp(along, length, road.line[:, i]) for i in range(2)])
    ahead = np.column_stack([np.interp(along + 1, length, road.line[:, i]) for i in range(2)]) - xy
    normal = np.column_stack((-ahead[:, 1], ahead[:, 0])) / (np.hypot(*ahead.T)[:, None] + 1e-9)
    side = rng.choice((-1.0, 1.0), len(xy)) * (0 if road.kind == "hedge" else road.width_m / 2 + 2.2)
    xy = xy + normal * (side + rng.normal(0, sway, len(xy)))[:, None]
    r = rng.uniform(*radius, len(xy))
    stream, _ = plan.stream()
    gap = np.array([np.min(np.hypot(*(stream - p).T)) for p in xy])
    trees = np.column_stack((xy, r, r * rng.uniform(1.6, 2.4, len(r)), rng.uniform(0, 1, len(r))))
    return np.asarray(trees[gap > 6.0])


def _box(plan: Landscape, center_uv: Array, half_u: float, half_v: float, turn_rad: float = 0.0) -> Array:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (half_u, half_v)
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return plan.bend(center_uv + corners @ np.array([[c, s], [-s, c]]))


def _beside(place: Array, du_m: float, dv_m: float) -> Array:
    return np.asarray(place + np.array([du_m, dv_m]))


def _pitch(plan: Landscape, parcel: Parcel) -> Iterator[Patch]:
    """A football pitch: mown stripes and white lines."""
    u0, v0, u1, v1 = parcel.rect
    edge = np.linspace(u0, u1, 30)
    water = stream_v(plan.params.seed, edge)
    if ((water > v0 - 8) & (water < v1 + 8)).any():
        return
    middle, half = np.array([(u0 + u1) / 2, (v0 + v1) / 2]), np.array([u1 - u0, v1 - v0]) / 2 - 6
    for k in range(12):
        lane = _beside(middle, (k - 5.5) / 6 * half[0], 0.0)
        yield Patch(_box(plan, lane, half[0] / 12, half[1]), (104, 142, 66) if k % 2 else (90, 128, 58), 0.45)
    white, w = (226, 230, 222), 0.09
    inner = half - 2.0
    for s in (-1, 1):
        yield Patch(_box(plan, _beside(middle, s * inner[0], 0), w, inner[1]), white, 0.2)
        yield Patch(_box(plan, _beside(middle, 0, s * inner[1]), inner[0], w), white, 0.2)
        yield Patch(_box(plan, _beside(middle, s * (inner[0] - 7), 0), w, inner[1] * 0.5), white, 0.2)
        yield Patch(_box(plan, _beside(middle, s * (inner[0] + 0.8), 0), 0.6, 2.4), (190, 196, 196), 0.2, 1.8)
    yield Patch(_box(plan, middle, w, inner[1]), white, 0.2)


def _bales(plan: Landscape, parcel: Parcel, rng: np.random.Generator) -> Iterator[Patch]:
    for uv in _inside(parcel.rect, 8, int(rng.integers(8, 22)), rng):
        if _dry(plan.params.seed, uv[None], 12)[0]:
            yield Patch(_box(plan, uv, 0.75, 0.6, rng.uniform(0, 3.1)), (212, 190, 132), 0.7, 1.3)


def _village(plan: Landscape, parcel: Parcel, banks: Array, rng: np.random.Generator) -> Furniture:
    u0, v0, u1, v1 = np.array(parcel.rect) + np.array([1, 1, -1, -1]) * STREET_M
    columns, rows = max(1, round((u1 - u0) / LOT_M[0])), max(1, round((v1 - v0) / LOT_M[1]))
    houses: list[House] = []
    patches: list[Patch] = []
    trees = [banks]
    for i in range(columns):
        for j in range(rows):
            size = np.array([(u1 - u0) / columns, (v1 - v0) / rows])
            middle = np.array([u0, v0]) + (np.array([i, j]) + 0.5) * size
            if not _dry(plan.params.seed, middle[None], 19)[0]:
                continue
            toward = 1.0 if j >= rows / 2 else -1.0
            patches.extend(_garden(plan, middle, size, toward, rng))
            houses.extend(_homestead(plan, middle, size, toward, rng))
            shrubs = middle + rng.uniform(-0.46, 0.46, (int(rng.integers(3, 9)), 2)) * size
            near = np.abs(shrubs - middle - (0, toward * size[1] * 0.12))
            trees.append(_trees(plan, shrubs[(near[:, 0] > 7) | (near[:, 1] > 7)], (0.7, 2.6), rng))
            edge = np.arange(-0.42, 0.4, 0.045)
            hedge = middle + np.column_stack((edge * 0 + 0.49, edge)) * size
            trees.append(_trees(plan, hedge, (0.55, 0.95), rng) if rng.random() < 0.5 else banks[:0])
    return Furniture(np.concatenate(trees), tuple(houses), tuple(patches))


def _turned(plan: Landscape, uv: Array, along_v: bool) -> float:
    step = np.array([[0.0, 0.0], (0.0, 1.0) if along_v else (1.0, 0.0)])
    run = np.diff(plan.bend(uv + step), axis=0)[0]
    return float(np.arctan2(run[1], run[0]))


ROOFS: tuple[Colour, ...] = (
    (158, 84, 62),
    (176, 102, 74),
    (132, 72, 58),
    (112, 108, 108),
    (148, 128, 110),
    (90, 92, 98),
)


def _homestead(
    plan: Landscape, middle: Array, size: Array, toward: float, rng: np.random.Generator
) -> Iterator[House]:
    at = _beside(middle, rng.uniform(-2, 2), toward * size[1] * rng.uniform(0.08, 0.16))
    along_v = bool(rng.random() < 0.35)
    tint = rng.integers(-14, 15)
    base = ROOFS[int(rng.integers(len(ROOFS)))]
    roof = (base[0] + int(tint), base[1] + int(tint), base[2] + int(tint))
    x, y = plan.bend(at[None])[0]
    angle = _turned(plan, at, along_v) + rng.normal(0, 0.03)
    length, width = rng.uniform(10.5, 15.5), rng.uniform(7.5, 9.5)
    yield House((x, y), angle, length, width, rng.uniform(3, 5.5), roof, bool(rng.random() < 0.25))
    if rng.random() < 0.35:
        shift = np.array([np.cos(angle + np.pi / 2), np.sin(angle + np.pi / 2)]) * (width / 2 + 1.5)
        yield House((x + shift[0], y + shift[1]), angle + np.pi / 2, 7.0, 5.5, 3.0, roof, chimney=False)
    if rng.random() < 0.7:
        shed = _beside(
            middle, rng.choice((-1, 1)) * size[0] * 0.32, -toward * size[1] * rng.uniform(0.2, 0.36)
        )
        sx, sy = plan.bend(shed[None])[0]
        yield House(
            (sx, sy), angle, rng.uniform(3, 6), rng.uniform(2.5, 3.6), 2.1, (138, 122, 104), chimney=False
        )


def _garden(
    plan: Landscape, middle: Array, size: Array, toward: float, rng: np.random.Generator
) -> Iterator[Patch]:
    shade = int(rng.integers(-16, 17))
    yield Patch(_box(plan, middle, *(size * 0.485)), (108 + shade, 132 + shade, 74 + shade // 2), 0.8)
    if rng.random() < 0.6:
        bed = _beside(middle, rng.uniform(-0.25, 0.25) * size[0], -toward * size[1] * 0.3)
        for k in range(int(rng.integers(3, 7))):
            row = _beside(bed, k * 1.15 - 2.5, 0)
            yield Patch(_box(plan, row, 0.42, 2.8), (104, 84, 62) if k % 2 else (92, 118, 56), 0.9)
    drive = _beside(middle, rng.choice((-1, 1)) * size[0] * 0.33, toward * size[1] * 0.25)
    grey = int(rng.integers(-18, 18))
    yield Patch(_box(plan, drive, 1.7, size[1] * 0.25), (172 + grey, 164 + grey, 152 + grey), 0.5)
    yield Patch(
        _box(plan, _beside(middle, 0, toward * size[1] * 0.1), size[0] * 0.3, 5.6), (176, 168, 154), 0.6
    )
    if rng.random() < 0.28:
        pool = _beside(middle, rng.uniform(-0.2, 0.2) * size[0], -toward * size[1] * 0.22)
        yield Patch(_box(plan, pool, 4.3, 2.5), (206, 202, 192), 0.3)
        yield Patch(_box(plan, pool, 3.7, 1.9), (92, 172, 190), 0.15)
    if rng.random() < 0.6:
        yield from parked_car(
            plan.bend(drive[None])[0], _turned(plan, drive, True), CARS[int(rng.integers(len(CARS)))]
        )


CARS: tuple[Colour, ...] = (
    (214, 216, 218),
    (52, 54, 60),
    (150, 40, 38),
    (52, 84, 142),
    (168, 170, 174),
    (30, 32, 34),
)


def car_parts(angle_rad: float) -> tuple[Array, Array]:
    """A car's body and its dark windows around (0, 0): each (4, 2) metres, turned by `angle_rad`."""
    turn = np.array([[np.cos(angle_rad), np.sin(angle_rad)], [-np.sin(angle_rad), np.cos(angle_rad)]])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    return (corners * (2.2, 0.92)) @ turn, (corners * (0.95, 0.74) - (0.25, 0)) @ turn


def parked_car(xy: Array, angle_rad: float, colour: Colour) -> Iterator[Patch]:
    """A car that stands at `xy`, ground metres."""
    body, glass = car_parts(angle_rad)
    yield Patch(xy + body, colour, 0.1, 1.2)
    yield Patch(xy + glass, (44, 50, 58), 0.1, 1.45)
