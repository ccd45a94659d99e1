"""Roughness of a road from pictures that are rendered in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.render.rendering_scenes import constant_sky, look_at, plane
from tests.tiny_world import (
    GAIN,
    LENS,
    TinyWorkspace,
    ground_points,
    on_ground,
    tiny_world,
)

from lightsim.appearance.intrinsic.light import ObservedPoints, SurfaceLight
from lightsim.build.road_roughness import with_measured_road
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.dome import Sun
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.geometry.materials import ASPHALT, FACADE
from lightsim.render.transport.lobes import Lobes, normal_reflectance, sun_in_lobes

SUN = Sun(np.array([np.cos(0.4), 0.0, np.sin(0.4)]), np.full(3, 1.0, np.float32))
SKY, BASE = 0.1, 0.2
LIT = BASE * (SUN.irradiance / np.pi * np.sin(0.4) + SKY)


def light_at(points: ObservedPoints) -> SurfaceLight:
    """Open ground under a sun and an even sky."""
    ones = np.ones((len(points.position), 3), np.float32)
    sun = (ones * SUN.irradiance / np.pi * np.sin(0.4)).astype(np.float32)
    return SurfaceLight(sun, ones[:, :2], np.float32(SKY) * ones, 0 * ones, 0 * ones)


def photographed(frame: CameraFrame, roughness: float) -> np.ndarray:
    """The road with its reflection of the sun; the driving box and the sky are white."""
    is_road = on_ground(frame)
    towards = frame.world_from_camera.translation_m - ground_points(frame)[is_road]
    towards = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
    up = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (len(towards), 1))
    f0 = normal_reflectance(np.zeros_like(up), np.zeros(len(up), np.float32))
    rough = np.full(len(up), roughness, np.float32)
    picture = np.ones((LENS.height_px, LENS.width_px, 3), np.float32)
    picture[is_road] = GAIN * (LIT + sun_in_lobes(Lobes(up, up, towards, rough, f0), SUN))
    return srgb8_from_linear(picture)


def road(roughness: float, material: TriMesh) -> TinyWorkspace:
    """Six views towards the sun and away from it, each 3 m from the one before."""
    work = tiny_world(constant_sky(), background=material)
    frames = []
    for number in range(6):
        eye = np.array([3.0 * number - 18.0, 0.0, 1.8])
        aim = eye + [1.0 if number % 2 else -1.0, 0.0, -0.5]
        blank = replace(work.log.frames[number % 3], world_from_camera=look_at(eye, aim))
        picture = photographed(blank, roughness)
        frames.append(replace(blank, load_srgb8=lambda picture=picture: picture))
    work.__dict__["log"] = work.log.with_frames(tuple(frames))
    return work


def asphalt() -> TriMesh:
    return replace(plane(60.0, 1), materials=(ASPHALT,))


@pytest.mark.parametrize("true", [0.65, 0.85])
def test_the_roughness_of_the_road_comes_back(true: float) -> None:
    work = road(true, asphalt())
    mesh, (note,) = with_measured_road(work.log, work.assets, SUN, light_at, 0)
    assert mesh.materials == (replace(ASPHALT, roughness=mesh.materials[0].roughness),)
    assert mesh.materials[0].roughness == pytest.approx(true, abs=0.01)
    assert f"{mesh.materials[0].roughness:.2f}" in note


def test_without_evidence_the_road_stays_as_it_is() -> None:
    work = road(0.7, asphalt())
    level = Sun(np.array([1.0, 0.0, 0.0]), SUN.irradiance)
    wall = replace(work.assets, background=replace(asphalt(), materials=(FACADE,)))
    for assets, sun in ((work.assets, None), (work.assets, level), (wall, SUN)):
        assert with_measured_road(work.log, assets, sun, light_at, 0) == (assets.background, ())
    dusk = replace(work.log, frames=work.log.frames[:1])
    mesh, (note,) = with_measured_road(dusk, work.assets, SUN, light_at, 0)
    assert mesh is work.assets.background
    assert "no picture" in note
