"""Where the finished mosaic shows surveyed points: each marked photo is looked up in it by correlation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from core.checkpoints import Checkpoints, Observation, rms_levels
from core.geometry import Array, World
from core.grid import UtmGrid

Floats = NDArray[np.float32]
Outcome = Literal["found", "outside", "flat", "poor", "ambiguous"]
Picture = Callable[[UtmGrid], NDArray[np.uint8]]
"""What the mosaic shows in a window of its grid: RGBA (height, width, 4) uint8."""
PhotoOf = Callable[[str], NDArray[np.uint8]]
"""A frame's photo by its id, RGB (h, w, 3) uint8, of any size."""


@dataclass(frozen=True, slots=True)
class SearchParams:
    """How a marked point is looked for.

    `radius_m`: around where its own photo's pose puts it, `max_radius_px` at most. `halves_px`: of the
    patches, in pixels of the mosaic. A large one tells places apart; but what stands up in it looks otherwise
    from elsewhere: where one correlates less than `clear` a smaller one is tried, and the better one counts.
    Not found are patches that correlate less than `min_score`, that have another peak less than `margin`
    below the best, or less contrast than `min_contrast` grey levels.
    """

    radius_m: float = 4.0
    max_radius_px: int = 200
    halves_px: tuple[int, ...] = (20, 12)
    clear: float = 0.85
    min_score: float = 0.6
    margin: float = 0.05
    min_contrast: float = 2.0

    def reach_px(self, grid: UtmGrid) -> int:
        """How far a patch is moved, pixels of the mosaic."""
        return min(self.max_radius_px, max(4, round(self.radius_m / grid.gsd_m)))


DEFAULT = SearchParams()


@dataclass(frozen=True, slots=True)
class Lookup:
    """One marked pixel looked up. `place`: (2,) in the mosaic's CRS where found; `score`: its correlation."""

    point: str
    outcome: Outcome
    score: float = 0.0
    place: Array | None = None


@dataclass(frozen=True, slots=True)
class MosaicPoint:
    """One point as the mosaic shows it: the median of where its photos were found, metres off the survey.

    `found` of `sightings` photos; `spread_m`: how far these lie from their median, RMS; `why`: what became
    of the others, or of all. Errors are None when no photo was found.
    """

    point: str
    sightings: int
    found: int
    east_m: float | None
    north_m: float | None
    spread_m: float | None
    score: float | None
    why: Mapping[str, int]


@dataclass(frozen=True, slots=True)
class MosaicErrors:
    """Horizontal RMS errors over the points that check and were found, metres; see CheckpointErrors."""

    points: int
    found: int
    raw_m: float | None
    debiased_m: float | None
    similarity_m: float | None


def look_up(
    seen: Sequence[Observation],
    world: World,
    grid: UtmGrid,
    picture: Picture,
    photo: PhotoOf,
    params: SearchParams = DEFAULT,
) -> list[Lookup]:
    """Look for every marked pixel in the mosaic, in the order of `seen`. `grid`: of the whole mosaic.

    A patch of the photo around the pixel is drawn onto the mosaic's grid with the photo's pose, and moved to
    where it correlates best, to a fraction of a pixel.
    """
    groups: dict[str, list[int]] = {}
    for k, o in enumerate(seen):
        groups.setdefault(o.sighting.point, []).append(k)
    found: dict[int, Lookup] = {}
    for group in groups.values():
        places = [_pixel(seen[k], world, grid) for k in group]
        shown = _around(places, grid, picture, params)
        for k, at in zip(group, places, strict=True):
            found[k] = _look_up(seen[k], at, world, grid, shown, photo(seen[k].frame.frame_id), params)
    return [found[k] for k in range(len(seen))]


def _pixel(o: Observation, world: World, grid: UtmGrid) -> Array:
    """Where the photo's own pose puts the point: (2,) column and row."""
    cols, rows = grid.from_world(world, o.plane[None], o.frame.pose.ground_h_m)
    return np.array([cols[0], rows[0]])


def _around(places: Sequence[Array], grid: UtmGrid, picture: Picture, p: SearchParams) -> Picture:
    """The picture, drawn but once where the windows of one point's photos overlap: pixels are absolute."""
    side = p.reach_px(grid) + max(p.halves_px)
    low = np.rint(np.min(places, axis=0)).astype(int) - side
    size = np.rint(np.max(places, axis=0)).astype(int) + side + 1 - low
    if (size > 4 * side).any():
        return picture
    whole = picture(grid.window(int(low[0]), int(low[1]), int(size[0]), int(size[1])))

    def cut(window: UtmGrid) -> NDArray[np.uint8]:
        top, left = window.row0 - int(low[1]), window.col0 - int(low[0])
        return np.ascontiguousarray(whole[top : top + window.height, left : left + window.width])

    return cut


def _look_up(
    o: Observation,
    at: Array,
    world: World,
    grid: UtmGrid,
    picture: Picture,
    photo: NDArray[np.uint8],
    p: SearchParams,
) -> Lookup:
    best: Lookup | None = None
    for half in p.halves_px:
        found = _look_for(o, at, half, world, grid, picture, photo, p)
        if best is None or (found.outcome == "found", found.score) > (best.outcome == "found", best.score):
            best = found
        if best.outcome == "found" and best.score >= p.clear:
            break
    assert best is not None
    return best


def _look_for(
    o: Observation,
    at: Array,
    half: int,
    world: World,
    grid: UtmGrid,
    picture: Picture,
    photo: NDArray[np.uint8],
    p: SearchParams,
) -> Lookup:
    """The pixel looked up by a patch of one size."""
    name, reach = o.sighting.point, p.reach_px(grid)
    middle = np.rint(at).astype(int)
    patch, inside = _patch(o, world, grid, photo, middle, half)
    if inside[half, half] == 0 or inside.mean() < 0.5:
        return Lookup(name, "outside")
    if float(patch[inside > 0].std(axis=0).max()) < p.min_contrast:
        return Lookup(name, "flat")
    side = reach + half
    window = picture(grid.window(int(middle[0]) - side, int(middle[1]) - side, 2 * side + 1, 2 * side + 1))
    scores = _scores(window, patch, inside)
    if scores is None:
        return Lookup(name, "outside")
    best, place = _peak(scores)
    if best < p.min_score or place is None:
        return Lookup(name, "poor", best)
    if _runner_up(scores, half // 2) > best - p.margin:
        return Lookup(name, "ambiguous", best)
    col, row = at + place - reach
    crs_xy = np.array([grid.left + (col + 0.5) * grid.gsd_m, grid.top - (row + 0.5) * grid.gsd_m])
    return Lookup(name, "found", best, crs_xy)


def _patch(
    o: Observation, world: World, grid: UtmGrid, photo: NDArray[np.uint8], middle: NDArray[np.int_], half: int
) -> tuple[Floats, Floats]:
    """The photo around the pixel as the mosaic would draw it, (n, n, 3), and 1 where the photo reaches."""
    cols, rows = np.meshgrid(*(m + np.arange(-half, half + 1) for m in middle))
    pose, camera = o.frame.pose, o.frame.camera.scaled(photo.shape[1], photo.shape[0])
    xy = grid.to_world(world, cols.ravel(), rows.ravel(), pose.ground_h_m)
    uv = pose.pixels(camera, np.column_stack((xy, np.full(len(xy), pose.ground_h_m))))
    low, high = np.floor(uv.min(0)).astype(int) - 2, np.ceil(uv.max(0)).astype(int) + 3
    low, high = np.clip(low, 0, None), np.clip(high, 1, (camera.width, camera.height))
    if (high - low < 2).any():
        return np.zeros((*cols.shape, 3), np.float32), np.zeros(cols.shape, np.float32)
    cut = np.ascontiguousarray(photo[low[1] : high[1], low[0] : high[0]])
    u, v = (uv - low).astype(np.float32).T.reshape(2, *cols.shape)
    seen = cv2.remap(
        cut.astype(np.float32), u, v, cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    edge = np.array([camera.width - 1, camera.height - 1])
    inside = ((uv >= 0) & (uv <= edge)).all(1).reshape(cols.shape)
    return np.asarray(seen, np.float32), inside.astype(np.float32)


def _scores(window: NDArray[np.uint8], patch: Floats, inside: Floats) -> Floats | None:
    """Correlation in colour (2 reach + 1)², −1 where the mosaic ends under the patch; None if everywhere."""
    shown = (window[:, :, 3] == 255).astype(np.float32)
    colours = np.ascontiguousarray(window[:, :, :3], np.float32)
    covered = cv2.matchTemplate(shown, inside, cv2.TM_CCORR) >= 0.95 * inside.sum()
    if not covered.any():
        return None
    mask = None if inside.all() else inside
    scores = cv2.matchTemplate(colours, patch, cv2.TM_CCOEFF_NORMED, mask=mask)
    return np.where(covered & np.isfinite(scores), scores, np.float32(-1)).astype(np.float32)


def _peak(scores: Floats) -> tuple[float, Array | None]:
    """The best correlation and its place (column, row) by parabolas; None at the border of the search."""
    row, col = (int(v) for v in np.unravel_index(int(scores.argmax()), scores.shape))
    best = float(scores[row, col])
    if not (0 < row < scores.shape[0] - 1 and 0 < col < scores.shape[1] - 1):
        return best, None
    across = _vertex(*(float(v) for v in scores[row, col - 1 : col + 2]))
    down = _vertex(*(float(v) for v in scores[row - 1 : row + 2, col]))
    return best, np.array([col + across, row + down])


def _vertex(before: float, here: float, after: float) -> float:
    bend = before - 2 * here + after
    return 0.0 if bend >= 0 else min(max(0.5 * (before - after) / bend, -0.5), 0.5)


def _runner_up(scores: Floats, apart_px: int) -> float:
    """The highest local peak at least so far from the best one."""
    peaks = np.where(scores >= cv2.dilate(scores, np.ones((3, 3), np.uint8)), scores, np.float32(-1))
    row, col = (int(v) for v in np.unravel_index(int(scores.argmax()), scores.shape))
    peaks[max(0, row - apart_px) : row + apart_px + 1, max(0, col - apart_px) : col + apart_px + 1] = -1
    return float(peaks.max())


def mosaic_points(checkpoints: Checkpoints, found: Sequence[Lookup], epsg: int) -> dict[str, MosaicPoint]:
    """Every point that was looked for, by name. `epsg`: of the mosaic."""
    truth = _truth(checkpoints, epsg)
    groups: dict[str, list[Lookup]] = {}
    for lookup in found:
        groups.setdefault(lookup.point, []).append(lookup)
    return {point: _point(point, groups[point], truth[point]) for point in sorted(groups)}


def _truth(checkpoints: Checkpoints, epsg: int) -> dict[str, Array]:
    to_crs = Transformer.from_crs(checkpoints.crs, epsg, always_xy=True)
    xyz = np.array([s.xyz for s in checkpoints.sightings])
    places = np.column_stack(to_crs.transform(xyz[:, 0], xyz[:, 1]))
    return {s.point: place for s, place in zip(checkpoints.sightings, places, strict=True)}


def _point(point: str, lookups: Sequence[Lookup], truth: Array) -> MosaicPoint:
    why = {o: n for o in ("outside", "flat", "poor", "ambiguous") if (n := _count(lookups, o))}
    places = np.array([k.place for k in lookups if k.place is not None])
    if not len(places):
        return MosaicPoint(point, len(lookups), 0, None, None, None, None, why)
    shown = np.median(places, axis=0)
    east_m, north_m = (round(float(v), 4) for v in shown - truth)
    spread_m = round(float(np.sqrt(((places - shown) ** 2).sum(1).mean())), 4)
    score = round(float(np.median([k.score for k in lookups if k.place is not None])), 3)
    return MosaicPoint(point, len(lookups), len(places), east_m, north_m, spread_m, score, why)


def _count(lookups: Sequence[Lookup], outcome: str) -> int:
    return sum(lookup.outcome == outcome for lookup in lookups)


def mosaic_errors(
    checkpoints: Checkpoints, points: Mapping[str, MosaicPoint], epsg: int
) -> MosaicErrors | None:
    """The RMS over the points that check; None when none of them is seen in a posed photo."""
    checks = [p for name, p in sorted(points.items()) if name not in checkpoints.used]
    good = [p for p in checks if p.found]
    if not good:
        return MosaicErrors(len(checks), 0, None, None, None) if checks else None
    truth = _truth(checkpoints, epsg)
    errors = np.array([(p.east_m, p.north_m) for p in good], float)
    levels = rms_levels(errors, np.array([truth[p.point] for p in good]), len(good))
    return MosaicErrors(len(checks), len(good), *levels)


def mosaic_document(points: Mapping[str, MosaicPoint], errors: MosaicErrors | None) -> dict[str, Any]:
    """What was found in the mosaic, as JSON: every point looked for, and the RMS of those that check."""
    entries = {name: {k: v for k, v in asdict(p).items() if k != "point"} for name, p in points.items()}
    return {"mosaic": None if errors is None else asdict(errors), "points": entries}
