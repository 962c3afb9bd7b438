"""A tile's inputs: the same for the same drawing, another as soon as anything about it is another."""

from dataclasses import replace

import numpy as np

from core.fusion import FusionParams
from core.geometry import Camera, Pose, PosedFrame, World
from core.grid import TileKey
from core.inputs import frame_digest, tile_inputs

CAMERA = Camera(400, 300, 420.0, 200.0, 150.0, -0.05, 0.01)
FRAME = PosedFrame("a", CAMERA, Pose(np.diag([1.0, -1.0, -1.0]), np.array([1.0, 2.0, 60.0]), 0.5))
TILE, WORLD, PARAMS = TileKey(20, 5, 6), World(47.0, 8.0, 400.0), FusionParams()


def other_frames():
    """The frame with one thing changed, the least that a float can tell."""
    pose = FRAME.pose
    turned = pose.world_R_cam.copy()
    turned[0, 1] = 5e-324
    yield replace(FRAME, frame_id="b")
    yield replace(FRAME, gain=(1.0, 1.0, float(np.nextafter(1, 2))))
    yield replace(FRAME, camera=replace(CAMERA, k1=float(np.nextafter(-0.05, 0))))
    yield replace(FRAME, camera=replace(CAMERA, falloff=(0.0,) * 9))
    yield replace(FRAME, camera=replace(CAMERA, width=401))
    yield replace(FRAME, pose=replace(pose, world_R_cam=turned))
    yield replace(FRAME, pose=replace(pose, center=np.nextafter(pose.center, 99)))
    yield replace(FRAME, pose=replace(pose, ground_h_m=float(np.nextafter(0.5, 1))))
    yield replace(FRAME, pose=replace(pose, source="gnss"))


def test_a_frames_digest_changes_with_every_bit_of_it():
    digests = [frame_digest(frame) for frame in (FRAME, *other_frames())]
    assert len(set(digests)) == len(digests)


def test_how_a_frame_lies_in_memory_does_not_matter():
    pose = replace(
        FRAME.pose, world_R_cam=np.asfortranarray(FRAME.pose.world_R_cam), ground_h_m=np.float64(0.5)
    )
    assert frame_digest(replace(FRAME, pose=pose)) == frame_digest(FRAME)


def test_a_tiles_inputs_are_a_function_of_the_set_of_its_frames():
    one, two = frame_digest(FRAME), frame_digest(replace(FRAME, frame_id="b"))
    both = tile_inputs(TILE, WORLD, 1600, [one, two], PARAMS)
    assert tile_inputs(TILE, WORLD, 1600, [two, one], PARAMS) == both
    others = {
        tile_inputs(TILE, WORLD, 1600, [one], PARAMS),
        tile_inputs(TILE._replace(x=7), WORLD, 1600, [one, two], PARAMS),
        tile_inputs(TILE, replace(WORLD, alt_m=401.0), 1600, [one, two], PARAMS),
        tile_inputs(TILE, WORLD, None, [one, two], PARAMS),
        tile_inputs(TILE, WORLD, 1600, [one, two], replace(PARAMS, bands=3)),
        tile_inputs(TILE, WORLD, 1600, [one, two], PARAMS, "png"),
    }
    assert len(others) == 6
    assert both not in others
