"""A skyline that only images saw: it stands where they show it, and the ground goes on to it."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.camera import PinholeCamera
from lightsim.core.fields import GroundMap
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.core.sensors import CameraFrame
from lightsim.errors import FrameMismatchError
from lightsim.geometry.completion.far_field import build_far_field
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.render.casters.embree import EmbreeCaster

CAMERA = PinholeCamera("front", 320, 200, 150.0, 150.0, 160.0, 100.0)
PATH = np.stack([np.linspace(0, 10, 6), np.zeros(6), np.full(6, 1.5)], axis=1)
TOWER_DEG, SKYLINE_DEG, HILL_DEG = 12.0, 5.0, 4.0


def _near_ground() -> TriMesh:
    points = np.array([[-30, -30, 0], [40, -30, 0], [40, 30, 0], [-30, 30, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TriMesh("world", points, faces, np.zeros((4, 3), np.float32))


def _house() -> TriMesh:
    """Its front, 15 m to the left and 5 m high."""
    points = np.array([[-25, 15, 0], [35, 15, 0], [35, 15, 5], [-25, 15, 5]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TriMesh("world", points, faces, np.zeros((4, 3), np.float32))


def _ground() -> GroundMap:
    """Level, but one corner of the map lies on a roof."""
    height = np.zeros((60, 60), np.float32)
    height[50:, 50:] = 6.0
    return GroundMap(np.array([-30.0, -30.0]), 1.0, height, np.ones((60, 60), dtype=bool))


def _views(cornice_deg: float = 0.0) -> list:
    """Infinitely far: 5 degrees high, a tower of 12 degrees at azimuth 0 (+-4), a hill behind. The
    house of `_house` hides what is behind it, and is so much higher than its mesh."""
    views = []
    for x_m in (0.0, 2.5, 5.0, 7.5, 10.0):
        for k in range(4):
            forward = np.array([np.cos(k * np.pi / 2), np.sin(k * np.pi / 2), 0.0])
            right = np.array([forward[1], -forward[0], 0.0])
            rotation = np.stack([right, [0.0, 0.0, -1.0], forward], axis=1)
            pose = RigidTransform.from_rotation(
                "world", "camera", rotation, np.array([x_m, 0.0, 1.5])
            )
            frame = CameraFrame(f"c{k}", f"{x_m}", 0, pose, lambda: np.zeros((1, 1, 3), np.uint8))
            origins, rays = frame.pixel_rays(CAMERA, CAMERA.pixel_centres().reshape(-1, 2))
            azimuth = np.degrees(np.arctan2(rays[:, 1], rays[:, 0]))
            limit = np.where(np.abs(azimuth) < 4, TOWER_DEG, SKYLINE_DEG)
            limit += np.clip(0.2 * (np.abs(azimuth) - 120), 0, HILL_DEG)
            if cornice_deg:
                lower = np.radians(np.degrees(np.arcsin(rays[:, 2])) - cornice_deg)
                level = rays * [1, 1, 0] / np.linalg.norm(rays[:, :2], axis=1, keepdims=True)
                rays_below = np.cos(lower)[:, None] * level
                rays_below[:, 2] = np.sin(lower)
                is_house = EmbreeCaster([_house()]).intersect(origins, rays_below).is_hit
                limit[is_house] = 90.0
            matte = (np.degrees(np.arcsin(rays[:, 2])) > limit).astype(np.float32)
            views.append((frame, CAMERA, matte.reshape(200, 320)))
    return views


@pytest.fixture(scope="module")
def far() -> TriMesh:
    return build_far_field(
        _near_ground(), ViewEvidence(_views()), _ground(), PATH, make_caster=EmbreeCaster
    )


def _elevation_deg(far: TriMesh, azimuth_deg: float) -> float:
    """Of the highest ray from the middle of the path that still hits."""
    elevation = np.radians(np.arange(-3, 20, 0.1))
    azimuth = np.radians(azimuth_deg)
    rays = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    origin = np.tile(np.array([5.0, 0.0, 1.5]), (len(rays), 1))
    return float(np.degrees(elevation[EmbreeCaster([far]).intersect(origin, rays).is_hit].max()))


def test_the_skyline_is_that_of_the_images(far: TriMesh) -> None:
    assert _elevation_deg(far, 0.0) == pytest.approx(TOWER_DEG, abs=0.7)
    for azimuth_deg in (-90.0, 45.0, 101.0):
        assert _elevation_deg(far, azimuth_deg) == pytest.approx(SKYLINE_DEG, abs=0.7)
    assert _elevation_deg(far, 180.0) == pytest.approx(SKYLINE_DEG + HILL_DEG, abs=0.7)


def test_a_hill_has_no_steps(far: TriMesh) -> None:
    for azimuth_deg in np.arange(125.0, 135.0, 0.5):
        assert _elevation_deg(far, azimuth_deg) == pytest.approx(
            SKYLINE_DEG + 0.2 * (azimuth_deg - 120), abs=0.7
        )
        sides = [_elevation_deg(far, azimuth_deg + offset) for offset in (-0.02, 0.02)]
        assert sides[0] == pytest.approx(sides[1], abs=0.11)


def test_a_cornice_that_the_mesh_lacks_does_not_stand_far_behind_the_house() -> None:
    near = concatenate_meshes([_near_ground(), _house()])
    views = _views(cornice_deg=0.4)
    far = build_far_field(near, ViewEvidence(views), _ground(), PATH, make_caster=EmbreeCaster)
    # From beside the path one looks past the house at what would be its cornice.
    for azimuth_deg in (80.0, 90.0, 100.0):
        assert _elevation_deg(far, azimuth_deg) < SKYLINE_DEG + 0.7


def test_no_ray_below_the_horizon_escapes_and_roofs_raise_no_hills(far: TriMesh) -> None:
    rng = np.random.default_rng(0)
    rays = rng.standard_normal((4000, 3))
    rays[:, 2] = -np.abs(rays[:, 2]) * 0.2 - 0.001
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    caster = EmbreeCaster([_near_ground(), far])
    assert caster.intersect(np.tile([5.0, 0.0, 1.5], (4000, 1)), rays).is_hit.all()
    level = far.face_normals()[:, 2] > 0.7
    centre = far.vertices[far.faces[level]].mean(axis=1)
    outside = np.abs(centre[:, :2]).max(axis=1) > 50
    assert np.abs(centre[outside, 2]).max() < 0.6


def test_the_backdrop_faces_the_path_and_only_the_world(far: TriMesh) -> None:
    normals = far.face_normals()
    upright = np.abs(normals[:, 2]) < 0.1
    centre = far.vertices[far.faces[upright]].mean(axis=1) - np.array([5.0, 0.0, 0.0])
    assert ((normals[upright] * centre).sum(axis=1) < 0).all()
    assert far.has_provenance(Provenance.BACKGROUND_PROXY).all()
    lost = TriMesh("actor", far.vertices, far.faces, far.base_colour)
    with pytest.raises(FrameMismatchError):
        build_far_field(lost, ViewEvidence([]), _ground(), PATH, make_caster=EmbreeCaster)
