"""A street canyon whose walls a LiDAR saw up to 4 m: heights come back from the silhouettes."""

from __future__ import annotations

import numpy as np
import pytest

from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.sensors import CameraFrame
from lightsim.errors import FrameMismatchError, InputError
from lightsim.geometry.completion.extrude import infer_tall_structures
from lightsim.progress import SilentProgress
from lightsim.render.casters.embree import EmbreeCaster

CAMERA = PinholeCamera("any", 480, 270, 240.0, 240.0, 240.0, 135.0)
SEEN_M = 4.0
# Axis-aligned boxes: low x, low y, high x, high y, height.
LEFT_HOUSE = (5.0, 8.25, 30.0, 20.0, 10.0)
RIGHT_HOUSE = (-10.0, -22.0, 25.0, -9.25, 7.0)
LAMP = (12.0, 5.0, 12.3, 5.3, 8.0)
Box = tuple[float, float, float, float, float]
View = tuple[CameraFrame, PinholeCamera, np.ndarray]


def quad(corners: list[list[float]]) -> TriMesh:
    return TriMesh(
        "world",
        np.array(corners, np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.full((4, 3), 0.4, np.float32),
    )


def box_mesh(box: Box, top_m: float, whole: bool) -> TriMesh:
    """Walls and roof, or only the walls that the car sees (none that is turned away)."""
    x0, y0, x1, y1, _ = box
    ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    walls = list(zip(ring, ring[1:] + ring[:1], strict=True))
    if not whole:
        walls = [walls[0 if y0 > 0 else 2], walls[3 if x0 > 0 else 1]]
    parts = [quad([[*a, 0.0], [*b, 0.0], [*b, top_m], [*a, top_m]]) for a, b in walls]
    if whole:
        parts.append(quad([[*corner, top_m] for corner in ring]))
    return concatenate_meshes(parts)


def ground() -> TriMesh:
    """The street only: nobody sees the ground behind the houses."""
    return quad([[-40.0, -9.25, 0], [60.0, -9.25, 0], [60.0, 8.25, 0], [-40.0, 8.25, 0]])


def truth_mesh(boxes: list[Box]) -> TriMesh:
    return concatenate_meshes([ground(), *(box_mesh(box, box[4], True) for box in boxes)])


def seen_mesh(boxes: list[Box]) -> TriMesh:
    return concatenate_meshes(
        [ground(), *(box_mesh(box, min(SEEN_M, box[4]), False) for box in boxes)]
    )


def rays(pose: RigidTransform, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    directions = pose.rotate(camera.directions(camera.pixel_centres())).reshape(-1, 3)
    return np.tile(pose.translation_m, (len(directions), 1)), directions


def make_views(truth: TriMesh) -> list[View]:
    """Four cameras around a car that drives 12 m, with exact sky mattes."""
    caster = EmbreeCaster([truth])
    views = []
    for x_m in np.arange(-4.0, 9.0, 2.0):
        for k in range(4):
            forward = np.array([np.cos(k * np.pi / 2), np.sin(k * np.pi / 2), 0.0])
            right = np.array([forward[1], -forward[0], 0.0])
            rotation = np.stack([right, [0.0, 0.0, -1.0], forward], axis=1)
            position = np.array([x_m, 0.0, 1.6])
            pose = RigidTransform.from_rotation("world", "camera", rotation, position)
            frame = CameraFrame(f"camera{k}", f"{x_m}", 0, pose, lambda: np.zeros((1, 1, 3), "u1"))
            is_hit = caster.intersect(*rays(pose, CAMERA)).is_hit
            matte = (~is_hit & (rays(pose, CAMERA)[1][:, 2] > 0)).astype(np.float32)
            views.append((frame, CAMERA, matte.reshape(270, 480)))
    return views


def infer(seen: TriMesh, views: list[View]) -> TriMesh:
    return infer_tall_structures(
        seen,
        views,
        make_caster=EmbreeCaster,
        progress=SilentProgress(),
    )


def height_m(mesh: TriMesh, x_m: float, y_m: float) -> float:
    hits = EmbreeCaster([mesh]).intersect(np.array([[x_m, y_m, 90.0]]), np.array([[0, 0, -1.0]]))
    return 90.0 - float(hits.distance_m[0])


@pytest.fixture(scope="module")
def canyon() -> tuple[TriMesh, TriMesh, list[View]]:
    boxes = [LEFT_HOUSE, RIGHT_HOUSE, LAMP]
    views = make_views(truth_mesh(boxes))
    seen = seen_mesh(boxes)
    return infer(seen, views), seen, views


def test_facade_heights_come_back(canyon: tuple[TriMesh, TriMesh, list[View]]) -> None:
    mesh = canyon[0]
    for x_m in np.arange(6.1, 29.0, 1.7):
        assert height_m(mesh, float(x_m), 9.0) == pytest.approx(10.0, abs=0.51)
    for x_m in np.arange(-8.9, 24.0, 1.7):
        assert height_m(mesh, float(x_m), -10.0) == pytest.approx(7.0, abs=0.51)


def test_houses_have_a_depth_and_the_open_stays_empty(
    canyon: tuple[TriMesh, TriMesh, list[View]],
) -> None:
    mesh = canyon[0]
    assert height_m(mesh, 15.0, 12.0) == pytest.approx(10.0, abs=0.51)
    assert height_m(mesh, 15.0, 17.9) == -np.inf
    for x_m, y_m in ((-20.0, 0.0), (15.0, 0.0), (50.0, 5.0), (12.1, 5.1), (-10.0, 10.0)):
        assert height_m(mesh, x_m, y_m) == -np.inf
    assert 0 < len(mesh.faces) <= 100_000


def test_no_sky_is_covered(canyon: tuple[TriMesh, TriMesh, list[View]]) -> None:
    mesh, _, views = canyon
    caster = EmbreeCaster([mesh])
    for frame, camera, matte in views:
        covered = caster.intersect(*rays(frame.world_from_camera, camera)).is_hit
        is_sky = matte > 0.5
        # The rays beside the silhouette are not used: mattes are uncertain there.
        core = is_sky.copy()
        for shift in (-5, 5):
            core &= np.roll(is_sky, shift, axis=0) & np.roll(is_sky, shift, axis=1)
        assert not (covered.reshape(matte.shape) & core).any()
        assert (covered.reshape(matte.shape) & is_sky).sum() <= 0.03 * is_sky.sum()


def test_nothing_above_walls_that_were_seen_whole() -> None:
    boxes = [(5.0, 8.25, 30.0, 20.0, 3.5)]
    mesh = infer(seen_mesh(boxes), make_views(truth_mesh(boxes)))
    assert len(mesh.faces) == 0


def test_views_without_sky_information_prove_nothing(
    canyon: tuple[TriMesh, TriMesh, list[View]],
) -> None:
    """Undecided mattes neither carve nor vote: walls keep their observed height."""
    _, seen, views = canyon
    unsure = [(frame, camera, np.full_like(matte, 0.5)) for frame, camera, matte in views]
    mesh = infer(seen, unsure)
    assert (mesh.vertices[:, 2] <= SEEN_M + 0.51).all()


def test_wrong_inputs_are_refused(canyon: tuple[TriMesh, TriMesh, list[View]]) -> None:
    _, seen, views = canyon
    moved = seen.transformed(RigidTransform.identity("actor", "world"))
    with pytest.raises(FrameMismatchError):
        infer(moved, views)
    frame, camera, matte = views[0]
    with pytest.raises(InputError, match="differ in size"):
        infer(seen, [(frame, camera, matte[:-1])])
