"""A scanned road with a lamp post, a bollard, a trunk under its crown, a bin and a wall."""

from __future__ import annotations

import numpy as np
import pytest
from tests.geometry.scanning import scanned

from lightsim.core.camera import PinholeCamera
from lightsim.core.fields import GroundMap
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.core.sensors import CameraFrame
from lightsim.geometry.completion.pole_meshes import with_poles
from lightsim.geometry.completion.poles import Pole, extend_poles, find_poles
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.render.casters.embree import EmbreeCaster

GROUND = GroundMap(
    np.zeros(2), 1.0, np.zeros((2, 2), dtype=np.float32), np.ones((2, 2), dtype=bool)
)
PATH_M = np.array([[x, 0.0, 0.0] for x in range(-8, 9)])
CAMERA = PinholeCamera("any", 480, 400, 300.0, 300.0, 240.0, 330.0)
POST, BOLLARD, TRUNK = (3.0, 5.0, 0.08, 7.0), (-2.0, -4.0, 0.06, 1.0), (-5.0, 6.0, 0.14, 3.0)


def _rod(x: float, y: float, radius_m: float, top_m: float) -> TriMesh:
    pole = Pole(np.array([x, y, 0.0]), np.zeros(2), radius_m, 0.0, (0.0, top_m), top_m)
    black = np.zeros((3, 3), np.float32)
    nothing = TriMesh("world", black, np.zeros((0, 3), np.int32), black)
    return with_poles(nothing, [pole])


def _quad(*corners: tuple[float, float, float]) -> TriMesh:
    points = np.array(corners, np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return TriMesh("world", points, faces, np.zeros_like(points))


def _scene() -> TriMesh:
    ground = _quad((-40, -40, 0), (40, -40, 0), (40, 40, 0), (-40, 40, 0))
    wall = _quad((-20, 12, 0), (20, 12, 0), (20, 12, 9), (-20, 12, 9))
    rng = np.random.default_rng(0)
    leaves = rng.normal(size=(250, 3)) * 0.45 + np.array([TRUNK[0], TRUNK[1], 4.0])
    crown = [_quad(*(c + 0.1 * rng.normal(size=(4, 3)))) for c in leaves if c[2] > 3.0]
    return concatenate_meshes(
        [
            ground,
            wall,
            _rod(*POST),
            _rod(*BOLLARD),
            _rod(*TRUNK),
            _rod(6.0, -5.0, 0.35, 1.1),
            *crown,
        ]
    )


@pytest.fixture(scope="module")
def scan() -> tuple[np.ndarray, np.ndarray]:
    """Returns and where their beams started."""
    origins, points = scanned(_scene(), 0.3, 15.0)
    return points, origins


def _near(poles: list[Pole], place: tuple[float, float, float, float]) -> Pole:
    return next(p for p in poles if np.linalg.norm(p.foot_m[:2] - place[:2]) < 0.1)


def test_rods_are_found_and_nothing_else(scan: tuple[np.ndarray, np.ndarray]) -> None:
    poles = find_poles(*scan, GROUND, PATH_M)
    assert len(poles) == 3
    for place in (POST, BOLLARD, TRUNK):
        pole = _near(poles, place)
        assert pole.axis_at(np.array([1.0]))[0, :2] == pytest.approx(place[:2], abs=0.03)
        assert float(pole.radius_at(np.array([0.5]))[0]) == pytest.approx(place[2], abs=0.025)
    assert _near(poles, BOLLARD).top_m == pytest.approx(1.0, abs=0.15)
    # Beams pass over the bollard, the crown begins over the trunk; over the post no beam goes.
    assert [_near(poles, p).is_open for p in (POST, BOLLARD, TRUNK)] == [True, False, False]


@pytest.mark.parametrize("is_before_sky", [True, False])
def test_views_carry_a_post_on_above_the_beams(
    scan: tuple[np.ndarray, np.ndarray], is_before_sky: bool
) -> None:
    """Before the sky the matte shows it; before a house its colour does."""
    poles = find_poles(*scan, GROUND, PATH_M)
    views = []
    caster = EmbreeCaster([_rod(*POST)])
    for x_m in np.arange(-8.0, 9.0, 2.0):
        rotation = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
        pose = RigidTransform.from_rotation("world", "camera", rotation, np.array([x_m, -3.0, 1.6]))
        frame = CameraFrame("front", f"{x_m}", 0, pose, lambda: np.zeros((1, 1, 3), "u1"))
        origins, rays = frame.pixel_rays(CAMERA, CAMERA.pixel_centres().reshape(-1, 2))
        is_rod = caster.intersect(origins, rays).is_hit.reshape(CAMERA.height_px, -1)
        image = np.where(is_rod, 60, 160).astype(np.uint8)[..., None].repeat(3, axis=2)
        matte = (~is_rod if is_before_sky else np.zeros_like(is_rod)).astype(np.float32)
        frame = CameraFrame("front", f"{x_m}", 0, pose, lambda image=image: image)
        views.append((frame, CAMERA, matte))
    raised = extend_poles(poles, ViewEvidence(views))
    assert _near(poles, POST).top_m < 5.0
    assert _near(raised, POST).top_m == pytest.approx(POST[3], abs=0.3)
    assert _near(raised, BOLLARD).top_m == _near(poles, BOLLARD).top_m


def test_a_rod_takes_the_place_of_its_shreds() -> None:
    pole = Pole(np.array([3.0, 5.0, 0.0]), np.array([0.01, 0.0]), 0.1, -0.005, (0.5, 4.0), 6.0)
    shred = _quad((3.0, 4.8, 1.0), (3.2, 4.8, 1.0), (3.2, 4.8, 2.0), (3.0, 4.8, 2.0))
    beside = _quad((4.0, 5.0, 1.0), (4.2, 5.0, 1.0), (4.2, 5.0, 2.0), (4.0, 5.0, 2.0))
    mesh = with_poles(concatenate_meshes([shred, beside]), [pole])
    z = np.array([0.5, 1.5, 3.0, 5.5])
    origins = np.stack([3.0 + 0.01 * z, np.zeros(4), z], axis=1)
    hits = EmbreeCaster([mesh]).intersect(origins, np.tile([0.0, 1.0, 0.0], (4, 1)))
    # A regular decagon lies up to 5 % inside its circle.
    radius = 0.1 - 0.005 * z
    assert hits.distance_m == pytest.approx(5.0 - radius, abs=0.006)
    down = EmbreeCaster([mesh]).intersect(np.array([[3.06, 5.0, 9.0]]), np.array([[0, 0, -1.0]]))
    assert down.distance_m[0] == pytest.approx(3.0, abs=1e-3)
    assert (mesh.vertices[:, 0] > 3.9).sum() == 4
    assert mesh.face_provenance is not None
    assert set(mesh.face_provenance.tolist()) == {Provenance.MEASURED, Provenance.INFERRED}


def test_nothing_comes_of_nothing() -> None:
    none = np.zeros((0, 3), np.float32)
    assert find_poles(none, none, GROUND, PATH_M) == []
    assert extend_poles([], ViewEvidence([])) == []
