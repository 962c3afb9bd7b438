"""What goes into the pose graph and what comes out of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from core.frame import FrameMeta
from core.geometry import Camera, Pose, World


@dataclass(frozen=True, slots=True)
class GraphFrame:
    """A photo as the pose graph sees it. `name` orders frames taken in the same second."""

    frame_id: str
    name: str
    meta: FrameMeta


@dataclass(frozen=True, slots=True)
class Mark:
    """A surveyed point where a person marked it in a photo: `uv` in pixels of the original photo.

    `alt_m`: None where the survey does not tell it.
    """

    point: str
    frame_id: str
    uv: tuple[float, float]
    lon_deg: float
    lat_deg: float
    alt_m: float | None


@dataclass(frozen=True, slots=True)
class PoseParams:
    """How much the pose graph believes in what. Lengths in metres, angles in radians.

    `points_per_edge`: correspondences kept of one image pair, spread evenly over the picture.
    `independent_points`: how many of them count as independent, since relief errs in patches. `sigma_of_f`:
    standard deviation of a correspondence on the ground plane, as a share of the focal length.
    `sigma_range`: how many times that a mission's own residuals may make it. `robust_scale`: where the
    Cauchy loss starts to bend, in standard deviations. `wrong_edge`: an edge whose median residual exceeds
    this many standard deviations (and this many times the median edge) is taken for a wrong match.
    `…_start_…`: before a mission shows how good its GPS and gimbal are; `…_floor_…`: the best that is
    believed of them afterwards. `min_downward`: cosine of the steepest tilt by the gimbal that still makes a
    map photo; `oblique_ratio`: the furthest corner, in heights. `focal_log_sigma`: where a camera has at most
    `focal_frames` photos; with more it is held in proportion. Without GPS the scale comes from the first
    frame (Avola 2019, 2.1): `first_height_m` above ground, or `ground_px_per_m`, pixels per metre of ground
    as a marker of known size shows them, in the photo of the name `scale_image` if that is given.
    Surveyed points: `control_sigma_m` of their places, `control_px` of their marks, `control_height_sigma_m`
    of a point above the plane of its photo; `control_bend_m` and `control_turn_sigma` (scale, and radians):
    how far the map may be off before they hold it, so that points close together only shift it.
    """

    points_per_edge: int = 32
    independent_points: float = 2.0
    coarse_points: int = 12
    min_points: int = 8
    sigma_range: tuple[float, float] = (0.3, 6.0)
    sigma_of_f: float = 1.5e-3
    robust_scale: float = 2.0
    wrong_edge: float = 8.0
    gps_sigma_m: float = 3.0
    gps_floor_m: float = 0.05
    altitude_sigma_m: float = 15.0
    ground_step_sigma_m: float = 3.0
    gps_learnt_floor_m: float = 0.3
    altitude_learnt_floor_m: float = 0.3
    min_frames_to_learn: int = 8
    tilt_start_rad: float = 0.3
    tilt_floor_rad: float = 0.03
    gimbal_start_rad: float = 0.05
    gimbal_sigma_rad: float = 0.03
    yaw_sigma_rad: float = 0.5
    focal_log_sigma: float = 0.005
    focal_frames: int = 100
    k1_sigma: float = 0.1
    k2_sigma: float = 0.03
    lag_sigma_s: float = 0.3
    assumed_height_m: float = 60.0
    first_height_m: float | None = None
    ground_px_per_m: float | None = None
    scale_image: str | None = None
    first_height_log_sigma: float = 0.01
    far_m: float = 50_000.0
    oblique_ratio: float = 10.0
    min_downward: float = 0.4
    control_sigma_m: float = 0.05
    control_px: float = 1.0
    control_height_sigma_m: float = 1.0
    control_bend_m: float = 0.1
    control_turn_sigma: float = 0.02
    self_calibrate: bool = True
    min_frames_to_calibrate: int = 8
    coarse_steps: int = 6
    fine_steps: int = 10


@dataclass(frozen=True, slots=True)
class Solution:
    """Poses of one mission at one moment.

    A pose is that of a camera over a level plane: where the ground slopes, camera and ground are turned
    about the point that the camera looks down on until the ground is level, so that pixels lie right on the
    map; the centre then departs from the drone's by height × slope.

    `cameras`: refined, by `FrameMeta.camera_key`. `poses`: by frame id. `unplaced`: frame id → error code of
    `core.errors`. `islands`: poses of unplaced frames that tie to each other but to no GPS, in metres of
    their own submap, whose place and heading are not known. `reprojection_rms_px`: over the
    correspondences of all trusted pairs, in pixels of the original photos, wild ones (beyond ten
    robust standard deviations) left out. `dropped_pairs`: (low, high) ids of matches that contradict the
    rest. `lag_s`: by drone, how long its GPS lags the shutter.
    `yaw_offset_rad`: by drone, what to add to the metadata's yaw. `gps_sigma_m`: by drone, as observed.
    """

    world: World
    cameras: Mapping[str, Camera]
    poses: Mapping[str, Pose]
    unplaced: Mapping[str, str]
    reprojection_rms_px: float
    dropped_pairs: tuple[tuple[str, str], ...] = ()
    lag_s: Mapping[str, float] = field(default_factory=dict)
    yaw_offset_rad: Mapping[str, float] = field(default_factory=dict)
    gps_sigma_m: Mapping[str, float] = field(default_factory=dict)
    islands: Mapping[str, Pose] = field(default_factory=dict)
    edges: int = 0
    observations: int = 0
    steps: int = 0
