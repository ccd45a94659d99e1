"""A wall with a window and a low measured top: both gaps close, the gate stays open."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.core.sensors import CameraFrame, LidarSweep
from lightsim.errors import FrameMismatchError
from lightsim.geometry.completion.facades import complete_facades
from lightsim.geometry.completion.walls import find_walls
from lightsim.render.casters.embree import EmbreeCaster

CAMERA = PinholeCamera("side", 320, 240, 160.0, 160.0, 160.0, 120.0)
WALL_Y, SEEN_M, TOP_M = 10.0, 4.0, 9.0
WINDOW = (2.0, 4.0, 1.5, 2.5)
GATE = (8.0, 10.0, 0.0, 9.0)


def _wall(low_x: float, high_x: float, top_m: float, holes: list[tuple]) -> TriMesh:
    """A wall at y = 10 that faces -y, in squares of 0.25 m."""
    x, z = np.meshgrid(
        np.arange(low_x, high_x, 0.25) + 0.125, np.arange(0, top_m, 0.25) + 0.125, indexing="ij"
    )
    keep = np.ones(x.shape, dtype=bool)
    for x0, x1, z0, z1 in holes:
        keep &= ~((x > x0) & (x < x1) & (z > z0) & (z < z1))
    x, z = x[keep], z[keep]
    h = 0.125
    corners = [(-h, -h), (h, -h), (h, h), (-h, h)]
    points = np.stack(
        [np.stack([x + a, np.full_like(x, WALL_Y), z + b], axis=-1) for a, b in corners], axis=1
    ).reshape(-1, 3)
    start = 4 * np.arange(len(x))[:, None]
    faces = np.concatenate([start + [[0, 1, 2]], start + [[0, 2, 3]]]).astype(np.int32)
    black = np.zeros((len(points), 3), np.float32)
    return TriMesh("world", points.astype(np.float32), faces, black)


def _views(truth: TriMesh) -> list:
    caster = EmbreeCaster([truth])
    rotation = np.stack([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]], axis=1)
    views = []
    for x_m in np.arange(-4.0, 17.0, 3.0):
        pose = RigidTransform.from_rotation("world", "camera", rotation, np.array([x_m, 0.0, 1.6]))
        frame = CameraFrame("side", f"{x_m}", 0, pose, lambda: np.zeros((1, 1, 3), np.uint8))
        origins, rays = frame.pixel_rays(CAMERA, CAMERA.pixel_centres().reshape(-1, 2))
        hits = caster.intersect(origins, rays)
        matte = (~hits.is_hit & (rays[:, 2] > 0)).astype(np.float32)
        views.append((frame, CAMERA, matte.reshape(240, 320)))
    return views


def _over_the_low_end() -> LidarSweep:
    """Beams that pass over x > 14 and return from a house 10 m behind."""
    x, z = np.meshgrid(np.arange(26.0, 36.0, 0.05), np.arange(7.0, 16.0, 0.2))
    points = np.stack([x, np.full_like(x, 20.0), z], axis=-1).reshape(-1, 3).astype(np.float32)
    n = len(points)
    zero = np.zeros(n, np.float32)
    origins = np.tile(np.array([[4.0, 0.0, 1.8]], np.float32), (n, 1))
    none = np.full(n, -1, np.int16)
    return LidarSweep("0", 0, points, origins, zero, zero, none, none)


@pytest.fixture(scope="module")
def completed() -> TriMesh:
    truth = _wall(-6.0, 18.0, TOP_M, [GATE])
    seen = _wall(-6.0, 18.0, SEEN_M, [GATE, WINDOW])
    return complete_facades(seen, _views(truth), [_over_the_low_end()], make_caster=EmbreeCaster)


def _is_hit(mesh: TriMesh, x_m: float, z_m: float) -> bool:
    hits = EmbreeCaster([mesh]).intersect(np.array([[x_m, 0.0, z_m]]), np.array([[0, 1.0, 0]]))
    return bool(hits.is_hit[0]) and abs(float(hits.distance_m[0]) - WALL_Y) < 0.05


def test_windows_close_and_the_wall_reaches_its_top(completed: TriMesh) -> None:
    window = completed.comes_from(Provenance.INTERPOLATED)
    assert completed.comes_from(Provenance.INFERRED)[~window].all()
    assert completed.face_material is not None
    assert {completed.materials[k].name for k in completed.face_material[window]} == {"window"}
    x = completed.vertices[completed.faces[window]].reshape(-1, 3)
    np.testing.assert_allclose(x.min(axis=0)[[0, 2]], WINDOW[::2], atol=0.26)
    np.testing.assert_allclose(x.max(axis=0)[[0, 2]], WINDOW[1::2], atol=0.26)
    for x_m in np.arange(-5.5, 13.5, 0.9):
        if not GATE[0] - 0.6 < x_m < GATE[1] + 0.6:
            assert _is_hit(completed, float(x_m), 8.4), x_m
            assert not _is_hit(completed, float(x_m), TOP_M + 0.4), x_m


def test_a_wall_that_beams_pass_over_ends_there(completed: TriMesh) -> None:
    for z_m in (5.6, 7.6):
        assert not _is_hit(completed, 16.6, z_m)


def test_gates_open_to_the_sky_stay_open_and_faces_look_out(completed: TriMesh) -> None:
    for z_m in (1.1, 3.1, 6.1, 8.1):
        assert not _is_hit(completed, 9.1, z_m)
    assert (completed.face_normals()[:, 1] < -0.9).all()


def test_walls_are_upright_planes() -> None:
    wall = find_walls(_wall(-6.0, 18.0, SEEN_M, []))[0]
    np.testing.assert_allclose(wall.normal, [0, -1, 0], atol=1e-6)
    assert wall.span_m[1] - wall.span_m[0] == pytest.approx(24.0, abs=1e-4)
    np.testing.assert_allclose(wall.at(np.zeros(1), np.ones(1))[0, 1:], [WALL_Y, 1.0], atol=1e-6)


def test_no_walls_no_facades_and_only_in_world() -> None:
    empty = TriMesh(
        "world",
        np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.int32),
        np.zeros((0, 3), np.float32),
    )
    assert len(complete_facades(empty, [], [], make_caster=EmbreeCaster).faces) == 0
    lost = TriMesh("actor", empty.vertices, empty.faces, empty.base_colour)
    with pytest.raises(FrameMismatchError):
        complete_facades(lost, [], [], make_caster=EmbreeCaster)
