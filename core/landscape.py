"""A made-up countryside as a plan: parcels, roads, a stream, houses and trees. Pure geometry, no pixels.

Everything is laid out in plan coordinates (u, v), where borders are straight, and bent into ground metres
(x east, y north, origin in the middle) by `Landscape.bend`, so that no road runs like a ruler.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

CROPS = ("wheat", "barley", "maize", "rape", "plough", "stubble", "meadow", "pasture", "beet")
WILD = ("forest", "orchard")


@dataclass(frozen=True, slots=True)
class LandscapeParams:
    """`monotony`: share (0–1) of fields that are bare and strictly periodic, the hard parts for matching."""

    seed: int = 0
    size_m: float = 4096.0
    monotony: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Parcel:
    """A piece of land with one use. `rect`: u0, v0, u1, v1 plan metres; `outline` (K, 2): ground metres."""

    index: int
    kind: str
    rect: tuple[float, float, float, float]
    outline: Array
    row_rad: float
    monotone: bool


@dataclass(frozen=True, slots=True)
class Road:
    """A way along a border. `line` (K, 2) ground metres; `kind`: main, lane, track, margin or hedge."""

    kind: str
    line: Array
    width_m: float


@dataclass(frozen=True, slots=True)
class House:
    """A building with a gabled roof; `angle_rad`: of its ridge, anticlockwise from east."""

    center: tuple[float, float]
    angle_rad: float
    length_m: float
    width_m: float
    eave_m: float
    roof: Colour
    panels: bool = False
    chimney: bool = True


@dataclass(frozen=True, slots=True)
class Patch:
    """A plain flat-topped thing: lawn, drive, pool, parked car, bale. `outline` (K, 2) ground metres."""

    outline: Array
    colour: Colour
    rough: float
    height_m: float = 0.0


@dataclass(frozen=True, slots=True)
class Furniture:
    """What stands on one parcel. `trees` (N, 5): x, y, crown radius, height (metres), tone 0–1."""

    trees: Array
    houses: tuple[House, ...] = ()
    patches: tuple[Patch, ...] = ()


@dataclass(frozen=True, eq=False)
class Landscape:
    """The plan for one seed."""

    params: LandscapeParams
    parcels: tuple[Parcel, ...]
    roads: tuple[Road, ...]
    village: tuple[float, float]

    def bend(self, uv: Array) -> Array:
        """Plan (N, 2) → ground metres (N, 2)."""
        return bend(self.params.seed, uv)

    def stream(self) -> tuple[Array, Array]:
        """The stream's middle line (K, 2) in ground metres and its width there (K,) metres."""
        u = np.arange(-self.params.size_m / 2, self.params.size_m / 2, 3.0)
        return self.bend(np.column_stack((u, stream_v(self.params.seed, u)))), stream_width(u)


@lru_cache(maxsize=4)
def landscape(params: LandscapeParams) -> Landscape:
    """The plan that belongs to `params`."""
    rng = np.random.default_rng((params.seed, 1))
    cross = (float(rng.uniform(30, 60)), float(rng.uniform(35, 60)))
    half = params.size_m / 2
    cuts = list(_divide((-half, -half, half, half), 0, cross, rng))
    parcels: list[Parcel] = []
    roads: list[Road] = []
    for kind, rect, line in cuts:
        if line is None:
            parcels.append(_parcel(params, len(parcels), kind, rect, rng))
        else:
            roads.append(_road(params.seed, kind, line, rng))
    return Landscape(params, tuple(parcels), tuple(roads), cross)


def bend(seed: int, uv: Array) -> Array:
    """Plan (N, 2) → ground metres (N, 2): a turn and long waves."""
    rng = np.random.default_rng((seed, 2))
    turn, phase = rng.uniform(-0.5, 0.5), rng.uniform(0, 2 * np.pi, 4)
    u, v = uv[:, 0], uv[:, 1]
    wavy_u = u + 9 * np.sin(v / 83 + phase[0]) + 16 * np.sin(v / 217 + phase[1])
    wavy_v = v + 8 * np.sin(u / 71 + phase[2]) + 18 * np.sin(u / 260 + phase[3])
    c, s = np.cos(turn), np.sin(turn)
    return np.column_stack((c * wavy_u - s * wavy_v, s * wavy_u + c * wavy_v))


def stream_v(seed: int, u: Array) -> Array:
    """Where the stream runs: plan v (N,) at plan u (N,)."""
    phase = np.random.default_rng((seed, 3)).uniform(0, 2 * np.pi, 3)
    waves = 17 * np.sin(u / 31 + phase[0]) + 26 * np.sin(u / 88 + phase[1]) + 60 * np.sin(u / 400 + phase[2])
    return np.asarray(-85 + waves - 60 * np.sin(phase[2]))


def stream_width(u: Array) -> Array:
    """The stream's width (N,) metres at plan u (N,)."""
    return np.asarray(6.5 + 1.5 * np.sin(u / 23) + 1.2 * np.sin(u / 57))


Cut = tuple[str, tuple[float, float, float, float], "tuple[Array, float] | None"]


def _divide(
    rect: tuple[float, float, float, float], depth: int, cross: tuple[float, float], rng: np.random.Generator
) -> Iterator[Cut]:
    """Halve the land until parcels are left; every cut becomes a way, wide where it divides much."""
    u0, v0, u1, v1 = rect
    near = np.hypot((u0 + u1) / 2 - cross[0], (v0 + v1) / 2 - cross[1])
    village = near < 115
    longest, shortest = max(u1 - u0, v1 - v0), min(u1 - u0, v1 - v0)
    enough = 70 if village else rng.uniform(85, 150)
    if longest < enough or (longest < 200 and shortest < 38):
        yield (_use(near, rng), rect, None)
        return
    across = u1 - u0 >= v1 - v0
    low, high = (u0, u1) if across else (v0, v1)
    at = cross[0 if across else 1] if depth < 3 and low < cross[0 if across else 1] < high else None
    at = (
        low + (high - low) * rng.uniform(0.4, 0.6)
        if at is None or not 0.3 < (at - low) / (high - low) < 0.7
        else at
    )
    steps = np.linspace(0, 1, int((v1 - v0 if across else u1 - u0) / 6) + 2)
    line = (
        np.column_stack((np.full(len(steps), at), v0 + steps * (v1 - v0)))
        if across
        else np.column_stack((u0 + steps * (u1 - u0), np.full(len(steps), at)))
    )
    yield (_way(longest, village, rng), rect, (line, near))
    first = (u0, v0, at, v1) if across else (u0, v0, u1, at)
    second = (at, v0, u1, v1) if across else (u0, at, u1, v1)
    yield from _divide(first, depth + 1, cross, rng)
    yield from _divide(second, depth + 1, cross, rng)


def _way(longest_m: float, village: bool, rng: np.random.Generator) -> str:
    if longest_m > 1500:
        return "main"
    if longest_m > 480 or (village and longest_m > 90):
        return "lane"
    if longest_m > 210:
        return "track"
    return "hedge" if rng.random() < 0.3 else "margin"


def _use(near_m: float, rng: np.random.Generator) -> str:
    pick = rng.random()
    if near_m < 125:
        return "lots" if pick < 0.86 else ("orchard" if pick < 0.93 else "pasture")
    if near_m < 190 and pick < 0.5:
        return ("pitch", "orchard", "lots", "meadow", "wheat", "pasture")[int(rng.integers(6))]
    if pick < 0.14:
        return "forest" if pick < 0.10 else "orchard"
    return CROPS[int(rng.integers(len(CROPS)))]


def _parcel(
    params: LandscapeParams,
    index: int,
    kind: str,
    rect: tuple[float, float, float, float],
    rng: np.random.Generator,
) -> Parcel:
    u0, v0, u1, v1 = rect
    t = np.linspace(0, 1, 16)[:-1, None]
    corners = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]])
    ring = np.concatenate([corners[i] + t * (corners[(i + 1) % 4] - corners[i]) for i in range(4)])
    outline = bend(params.seed, ring)
    axis = np.array([[u0, (v0 + v1) / 2], [u1, (v0 + v1) / 2]])
    if v1 - v0 > u1 - u0:
        axis = np.array([[(u0 + u1) / 2, v0], [(u0 + u1) / 2, v1]])
    run = np.diff(bend(params.seed, axis), axis=0)[0]
    monotone = kind in CROPS and bool(rng.random() < params.monotony)
    return Parcel(index, kind, rect, outline, float(np.arctan2(run[1], run[0])), monotone)


def _road(seed: int, kind: str, line: tuple[Array, float], rng: np.random.Generator) -> Road:
    width = {"main": 6.6, "lane": 4.4, "track": 2.8, "margin": 1.6, "hedge": 2.2}[kind]
    return Road(kind, bend(seed, line[0]), width * float(rng.uniform(0.9, 1.15)))
