"""What new actors take from the camera: noise where they are, motion in its picture."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_erosion
from tests.simulation.test_edited_frames import OVERCAST, edits_of, frame_of, photographed
from tests.tiny_world import (
    ABOVE,
    BOX_LWH_M,
    LENS,
    STEP_M,
    STEP_NS,
    TinyWorkspace,
    rendered,
    scenario_of,
    tiny_world,
    with_pictures,
)

from lightsim.core.colour import linear_from_srgb8, luminance, srgb8_from_linear
from lightsim.core.frames import Trajectory
from lightsim.scenario.edits import Insert, Waypoint
from lightsim.simulation.blur_noise import CamerasBlurNoise, motion_in_picture

PUT = (Insert("edit 1", "box", "new", (Waypoint(x_m=6.0, y_m=0.0, yaw_deg=0.0),)),)
NOISE = 0.01


def noisy(work: TinyWorkspace) -> TinyWorkspace:
    """The same with grey noise in its pictures, of NOISE at a picture value of 0.3."""
    rng = np.random.default_rng(8)
    pictures = {}
    for frame in work.log.frames:
        linear = linear_from_srgb8(frame.load_srgb8())
        pictures[frame.stem] = srgb8_from_linear(
            linear + np.sqrt(linear[..., 1:2] / 0.3) * NOISE * rng.standard_normal((96, 96, 1))
        )
    return with_pictures(work, pictures)


def test_noise_is_the_cameras_where_pixels_are_rendered_and_nowhere_else() -> None:
    clean = photographed(OVERCAST)
    work = noisy(photographed(OVERCAST))
    blur_noise = CamerasBlurNoise(work.log).of(LENS)
    std = float(blur_noise.noise_std(np.full(1, 0.3, np.float32))[0])
    # The pictures are tiny: a handful of blocks.
    assert std == pytest.approx(NOISE, rel=0.3)
    found, again, plain = (
        frame_of(w, scenario_of(w), edits_of(scenario_of(w), w, PUT)) for w in (work, work, clean)
    )
    assert (found.image_srgb8 == again.image_srgb8).all()
    recorded = work.log.frames[1].load_srgb8()
    kept = ~found.source.is_edited
    assert (found.image_srgb8[kept] == recorded[kept]).all()
    assert found.traced is not None
    is_new = found.traced.geometry.actor_index == 1
    inside = np.asarray(binary_erosion(is_new, iterations=2), dtype=bool)
    rest = luminance(found.source.radiance - plain.source.radiance)[inside]
    signal = luminance(plain.source.radiance)[inside]
    assert (rest / blur_noise.noise_std(signal)).std() == pytest.approx(1.0, rel=0.2)


def test_motion_in_the_picture_is_that_of_box_and_camera() -> None:
    """The box's top drives at 10 m/s, 28.5 m below the camera; then the camera drives along."""
    work = tiny_world(OVERCAST)
    scenario, exposure_s = scenario_of(work), 0.04
    frame = work.log.frames[1]
    buffers, _ = rendered(work, frame, OVERCAST)
    shown = (buffers.actor_index == 0) & (buffers.position_world[..., 2] > BOX_LWH_M[2] - 0.01)
    speed = STEP_M / (STEP_NS * 1e-9)
    wanted = LENS.fy * speed * exposure_s / (ABOVE.translation_m[2] - BOX_LWH_M[2])
    for ego_speed, u, v in ((0.0, 0.0, -wanted), (speed, 0.0, 0.0)):
        poses = np.tile(np.eye(4), (3, 1, 1))
        poses[:, 1, 3] = ego_speed * (np.arange(3) - 1) * STEP_NS * 1e-9
        ego = Trajectory("world", "ego", work.log.ego.times_ns, poses)
        motion = motion_in_picture(scenario, (frame, LENS), ego, buffers, [0], exposure_s)
        np.testing.assert_allclose(motion[shown], np.tile([u, v], (shown.sum(), 1)), atol=1e-3)
        assert np.isnan(motion[buffers.actor_index != 0]).all()
        nobody = motion_in_picture(scenario, (frame, LENS), ego, buffers, [3], exposure_s)
        assert np.isnan(nobody).all()
