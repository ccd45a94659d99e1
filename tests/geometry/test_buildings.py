"""A street canyon whose walls a LiDAR saw up to 4 m: buildings come back from the silhouettes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from lightsim.core.buildings import Roofline, Wall
from lightsim.core.camera import PinholeCamera
from lightsim.core.fields import GroundMap
from lightsim.core.frames import RigidTransform
from lightsim.core.lidar_returns import LidarReturns
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.core.profiles import (
    best_profile,
    energy_of_filling,
    label_probabilities,
    least_energies,
)
from lightsim.core.sensors import CameraFrame, LidarSweep
from lightsim.errors import FrameMismatchError, InputError
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.completion.neighbours import raised_to_neighbours, unexplained
from lightsim.geometry.completion.prisms import unobserved_building_parts
from lightsim.geometry.completion.rooflines import tops_at
from lightsim.geometry.completion.scene import Inputs, Scene
from lightsim.geometry.completion.table import STEPS, complete
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.geometry.completion.wall_cells import SurfaceSighting, WallCells
from lightsim.geometry.completion.walls import find_walls
from lightsim.geometry.surface import keep_faces
from lightsim.render.casters.embree import EmbreeCaster

WIDE = PinholeCamera("any", 480, 270, 240.0, 240.0, 240.0, 135.0)
NARROW = PinholeCamera("any", 480, 200, 480.0, 480.0, 240.0, 100.0)
SEEN_M, CELL_M = 4.0, 0.25
# Axis-aligned boxes: low x, low y, high x, high y, height.
LEFT_HOUSE = (5.0, 8.25, 30.0, 20.0, 10.0)
RIGHT_HOUSE = (-10.0, -22.0, 25.0, -9.25, 7.0)
LAMP = (12.0, 5.0, 12.3, 5.3, 8.0)
# Parts of a wall: low x, high x, low z, high z.
WINDOW, GATE = (9.0, 11.0, 1.5, 2.5), (20.0, 22.0, 0.0, 10.0)
NO_CROWNS = Crowns.none(np.zeros((1, 3)))
GROUND = GroundMap(
    np.zeros(2), 1.0, np.zeros((2, 2), dtype=np.float32), np.ones((2, 2), dtype=bool)
)
Box = tuple[float, float, float, float, float]
View = tuple[CameraFrame, PinholeCamera, np.ndarray]
Hole = tuple[float, float, float, float]


def _wall(start: np.ndarray, end: np.ndarray, top_m: float, holes: tuple[Hole, ...]) -> TriMesh:
    """An upright wall in squares of 0.25 m, outside to the right of the way from start to end."""
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    s, z = np.meshgrid(np.arange(0, length, CELL_M), np.arange(0, top_m, CELL_M), indexing="ij")
    x = start[0] + along[0] * (s + CELL_M / 2)
    keep = np.ones(s.shape, dtype=bool)
    for x0, x1, z0, z1 in holes:
        keep &= ~((x > x0) & (x < x1) & (z >= z0) & (z < z1))
    s, z = s[keep], z[keep]
    corners = [(0.0, 0.0), (CELL_M, 0.0), (CELL_M, CELL_M), (0.0, CELL_M)]
    points = np.stack(
        [np.c_[start + (s + a)[:, None] * along, z + b] for a, b in corners], axis=1
    ).reshape(-1, 3)
    return _quads(points)


def _quads(points: np.ndarray) -> TriMesh:
    start = 4 * np.arange(len(points) // 4)[:, None]
    faces = np.concatenate([start + [[0, 1, 2]], start + [[0, 2, 3]]]).astype(np.int32)
    black = np.zeros((len(points), 3), np.float32)
    return TriMesh("world", points.astype(np.float32), faces, black)


def _house(box: Box, top_m: float, whole: bool, holes: tuple[Hole, ...] = ()) -> TriMesh:
    """Walls and roof, or only the walls that the car sees (none that is turned away)."""
    x0, y0, x1, y1, _ = box
    ring = [np.array(corner) for corner in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    walls = list(zip(ring, ring[1:] + ring[:1], strict=True))
    if not whole:
        walls = [walls[0 if y0 > 0 else 2], walls[3 if x0 > 0 else 1]]
    parts = [_wall(*wall, top_m, holes) for wall in walls]
    if whole:
        parts.append(_quads(np.array([[*corner, top_m] for corner in ring])))
    return concatenate_meshes(parts)


def _street() -> TriMesh:
    """Nobody sees the ground behind the houses."""
    return _quads(np.array([[-40.0, -9.25, 0], [60, -9.25, 0], [60, 8.25, 0], [-40, 8.25, 0]]))


def _truth(boxes: list[Box]) -> TriMesh:
    return concatenate_meshes([_street(), *(_house(b, b[4], True) for b in boxes)])


def _seen(boxes: list[Box]) -> TriMesh:
    parts = [_street()]
    for box in boxes:
        holes = (WINDOW,) if box == LEFT_HOUSE else ()
        parts.append(_house(box, min(SEEN_M, box[4]), False, holes))
    return concatenate_meshes(parts)


def _views(truth: TriMesh, camera: PinholeCamera) -> list[View]:
    """Four cameras around a car that drives 12 m, with exact sky mattes."""
    caster = EmbreeCaster([truth])
    views = []
    for x_m, k in product(np.arange(-4.0, 9.0, 2.0), range(4)):
        forward = np.array([np.cos(k * np.pi / 2), np.sin(k * np.pi / 2), 0.0])
        right = np.array([forward[1], -forward[0], 0.0])
        rotation = np.stack([right, [0.0, 0.0, -1.0], forward], axis=1)
        pose = RigidTransform.from_rotation("world", "camera", rotation, np.array([x_m, 0.0, 1.6]))
        frame = CameraFrame(f"camera{k}", f"{x_m}", 0, pose, lambda: np.zeros((1, 1, 3), "u1"))
        origins, rays = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))
        is_sky = ~caster.intersect(origins, rays).is_hit & (rays[:, 2] > 0)
        views.append((frame, camera, is_sky.reshape(camera.height_px, -1).astype(np.float32)))
    return views


def _sweep(points: np.ndarray) -> LidarSweep:
    n = len(points)
    zero, none = np.zeros(n, np.float32), np.full(n, -1, np.int16)
    origins = np.tile(np.array([[2.0, 0.0, 1.8]], np.float32), (n, 1))
    return LidarSweep("0", 0, points.astype(np.float32), origins, zero, zero, none, none)


def _complete(
    seen: TriMesh,
    views: list[View],
    sweeps: list[LidarSweep] | None = None,
    parked: Sequence[TriMesh] = (),
) -> tuple[TriMesh, TriMesh]:
    after = complete_walls(seen, views, sweeps, find_walls(seen), parked)
    is_new = np.arange(len(after.background.faces)) >= len(seen.faces)
    visible = keep_faces(after.background, is_new)
    return visible, unobserved_building_parts(
        after.rooflines, after.background, make_caster=EmbreeCaster
    )


def complete_walls(
    seen: TriMesh,
    views: Sequence[View],
    sweeps: Sequence[LidarSweep] | None,
    walls: Sequence[Wall],
    parked: Sequence[TriMesh] = (),
) -> Scene:
    """The scene after the steps of the completion that concern walls."""
    before = Scene(seen, NO_CROWNS, walls, parked=parked)
    others = {step.name for step in STEPS} - {"far_walls", "roofs"}
    return complete(inputs_of(views, sweeps), before, others)[0]


def inputs_of(views: Sequence[View], sweeps: Sequence[LidarSweep] | None = None) -> Inputs:
    nothing, sweeps = np.zeros((0, 3), "f4"), sweeps or []
    points = np.concatenate([nothing, *(s.points_world for s in sweeps)])
    origins = np.concatenate([nothing, *(s.origins_world for s in sweeps)])
    returns = LidarReturns(points, origins, np.zeros(len(points), dtype=bool))
    return Inputs(
        ViewEvidence(views), returns, lambda: sweeps, GROUND, np.zeros((1, 3)), EmbreeCaster
    )


def _height_m(meshes: tuple[TriMesh, ...], x_m: float, y_m: float) -> float:
    down = np.array([[0, 0, -1.0]])
    hits = EmbreeCaster(list(meshes)).intersect(np.array([[x_m, y_m, 90.0]]), down)
    return 90.0 - float(hits.distance_m[0])


def _is_wall(mesh: TriMesh, x_m: float, z_m: float) -> bool:
    """Whether the left house's front is there, seen from the road."""
    hits = EmbreeCaster([mesh]).intersect(np.array([[x_m, 0.0, z_m]]), np.array([[0, 1.0, 0]]))
    return bool(hits.is_hit[0]) and abs(float(hits.distance_m[0]) - LEFT_HOUSE[1]) < 0.1


@pytest.fixture(scope="module")
def canyon() -> tuple[tuple[TriMesh, TriMesh], list[View]]:
    boxes = [LEFT_HOUSE, RIGHT_HOUSE, LAMP]
    views = _views(_truth(boxes), WIDE)
    return _complete(_seen(boxes), views), views


def test_roofs_stand_where_the_silhouettes_end(canyon) -> None:
    meshes, _ = canyon
    for x_m in np.arange(6.1, 29.0, 1.7):
        assert _height_m(meshes, float(x_m), 9.0) == pytest.approx(10.0, abs=0.51)
    for x_m in np.arange(-8.9, 24.0, 1.7):
        assert _height_m(meshes, float(x_m), -10.0) == pytest.approx(7.0, abs=0.51)


def test_houses_have_a_depth_and_the_open_stays_empty(canyon) -> None:
    meshes, _ = canyon
    assert _height_m(meshes, 15.0, 12.0) == pytest.approx(10.0, abs=0.51)
    for x_m, y_m in ((-20.0, 0.0), (15.0, 0.0), (50.0, 5.0), (12.1, 5.1), (-10.0, 10.0)):
        assert _height_m(meshes, x_m, y_m) == -np.inf


def test_holes_close_and_seen_walls_are_not_hidden(canyon) -> None:
    visible, casting = canyon[0]
    pane = visible.has_provenance(Provenance.INTERPOLATED)
    assert visible.has_provenance(Provenance.INFERRED)[~pane].all()
    assert visible.face_material is not None
    assert {visible.materials[k].name for k in visible.face_material[pane]} == {"facade"}
    x = visible.vertices[visible.faces[pane]].reshape(-1, 3)
    np.testing.assert_allclose(x.min(axis=0)[[0, 2]], WINDOW[::2], atol=0.26)
    np.testing.assert_allclose(x.max(axis=0)[[0, 2]], WINDOW[1::2], atol=0.26)
    assert _is_wall(visible, 15.0, 8.0)
    assert not _is_wall(casting, 15.0, 8.0)


def test_a_barred_window_closes_whose_bars_rays_meet() -> None:
    """Bars in the middle of the wall's cells passed for a measured wall: the gaps stayed holes."""
    x0, x1, z0, z1 = WINDOW
    bars = [
        np.array(
            [[x - 0.04, 8.25, z0], [x + 0.04, 8.25, z0], [x + 0.04, 8.25, z1], [x - 0.04, 8.25, z1]]
        )
        for x in np.arange(x0 + CELL_M / 2, x1, CELL_M)
    ]
    seen = concatenate_meshes([_seen([LEFT_HOUSE]), _quads(np.concatenate(bars))])
    visible, _ = _complete(seen, _views(_truth([LEFT_HOUSE]), WIDE))
    assert _is_wall(visible, x0 + 4 * CELL_M, 2.0)


def test_gates_that_show_what_lies_behind_stay_open() -> None:
    ends = np.array([5.0, 8.25]), np.array([30.0, 8.25])
    yard = _quads(np.array([[0.0, 8.25, 0], [60, 8.25, 0], [60, 90, 0], [0, 90, 0]]))
    truth = concatenate_meshes([_street(), yard, _wall(*ends, 10.0, (GATE,))])
    seen = concatenate_meshes([_street(), yard, _wall(*ends, SEEN_M, (GATE,))])
    for mesh in _complete(seen, _views(truth, WIDE)):
        assert not any(_is_wall(mesh, 21.1, z_m) for z_m in (1.1, 3.1, 6.1, 9.1))


def test_a_wall_goes_on_behind_a_parked_car() -> None:
    """Nothing of its foot was measured, and rays that go through the car meet the room behind:
    the wall once hung above the ground."""
    car, foot, room = (6.0, 4.0, 28.0, 7.0, 1.55), (7.0, 27.0, 0.0, 1.25), 12.0
    boxes = [LEFT_HOUSE, car]
    front = _wall(np.array([5.0, 8.25]), np.array([30.0, 8.25]), SEEN_M, (foot,))
    behind = _wall(np.array([5.0, room]), np.array([30.0, room]), SEEN_M, ())
    seen = concatenate_meshes([_street(), front, behind])
    views = _views(_truth(boxes), WIDE)
    assert not _is_wall(_complete(seen, views)[0], 14.0, 0.6)
    visible, _ = _complete(seen, views, parked=[_house(car, car[4], True)])
    for x_m, z_m in ((13.0, 0.3), (14.0, 0.6), (15.0, 1.2)):
        assert _is_wall(visible, x_m, z_m)


def test_a_window_closes_whose_sill_a_parked_car_hides() -> None:
    """Beams went through its upper part; with the hidden foot it was one hole, too open for a
    window, and rays met the ground behind the house."""
    car, foot, pane = (6.0, 4.0, 28.0, 7.0, 1.55), (7.0, 27.0, 0.0, 1.25), (12.0, 14.0, 0.0, 2.75)
    front = _wall(np.array([5.0, 8.25]), np.array([30.0, 8.25]), SEEN_M, (foot, pane))
    room = _wall(np.array([5.0, 12.0]), np.array([30.0, 12.0]), SEEN_M, ())
    seen = concatenate_meshes([_street(), front, room])
    origin = np.array([2.0, 0.0, 1.8])
    x, z = np.meshgrid(np.arange(12.1, 14.0, 0.05), np.arange(1.4, 2.7, 0.05))
    way = np.stack([x, np.full_like(x, 8.25), z], axis=-1).reshape(-1, 3) - origin
    inside = _sweep(origin + way * (12.0 / 8.25))
    views = _views(_truth([LEFT_HOUSE, car]), WIDE)
    visible, _ = _complete(seen, views, [inside], parked=[_house(car, car[4], True)])
    for z_m in (0.4, 1.3, 1.9, 2.4):
        assert _is_wall(visible, 13.1, z_m)


def test_no_sky_is_covered(canyon) -> None:
    meshes, views = canyon
    caster, fractions = EmbreeCaster(list(meshes)), []
    for frame, camera, matte in views:
        origins, rays = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))
        covered = caster.intersect(origins, rays).is_hit.reshape(matte.shape)
        assert (covered & (matte > 0.5)).sum() <= 0.02 * (matte > 0.5).sum()
        fractions.append(covered.mean())
    assert np.mean(fractions) > 0.28


def test_shadow_casters_leave_measured_walls_in_the_light(canyon) -> None:
    """A prism's side walls once lay on the measured wall round the corner and darkened it."""
    meshes, _ = canyon
    caster = EmbreeCaster(list(meshes))
    towards = np.array([-0.5, -0.5, 1.0]) / np.sqrt(1.5)
    front = [[x, LEFT_HOUSE[1] - 0.02, z] for x in (6.0, 13.0, 17.0, 28.0) for z in (1.0, 3.0)]
    side = [[LEFT_HOUSE[0] - 0.02, y, z] for y in (9.0, 13.0, 18.0) for z in (1.0, 3.0)]
    points = np.array(front + side)
    assert not caster.is_occluded(points, np.tile(towards, (len(points), 1))).any()


def test_a_roof_that_no_view_reaches_gets_the_height_of_the_street() -> None:
    """Narrow cameras see the far house whole and of the near one the ground floor alone."""
    far = (35.0, 8.25, 60.0, 20.0, 14.0)
    near = (-2.0, 8.25, 8.0, 20.0, 14.0)
    views = _views(_truth([near, far]), NARROW)
    meshes = _complete(_seen([near, far]), views)
    # One roof moves the prior of 10 m a good way towards 14.
    assert 11.0 < _height_m(meshes, 3.0, 9.5) < 14.0
    assert _height_m(meshes, 45.0, 9.5) == pytest.approx(14.0, abs=0.6)
    visible, casting = meshes
    assert not _is_wall(visible, 3.0, 9.0)
    assert _is_wall(casting, 3.0, 9.0) or _height_m((casting,), 3.0, 9.5) > 11.0


def test_panes_that_mirror_the_sky_at_the_border_of_a_picture_are_wall() -> None:
    """Log 002: a strip of windows that the side camera saw the foot of cut its house down."""
    boxes = [LEFT_HOUSE]
    caster = EmbreeCaster([truth := _truth(boxes)])
    views: list[View] = []
    for frame, camera, matte in _views(truth, WIDE):
        origins, rays = frame.pixel_rays(camera, camera.pixel_centres().reshape(-1, 2))
        met = origins + caster.intersect(origins, rays).distance_m[:, None] * rays
        is_pane = np.abs(met - [14.0, LEFT_HOUSE[1], 6.5]) < [1.9, 0.1, 0.8]
        is_mirror = is_pane.all(axis=1).reshape(matte.shape) & (frame.camera_name == "camera1")
        views.append((frame, camera, np.where(is_mirror, np.float32(1.0), matte)))
    assert max(matte[0].mean() for frame, _, matte in views if frame.stem == "8.0") > 0.7
    meshes = _complete(_seen(boxes), views)
    for x_m in np.arange(6.1, 29.0, 1.7):
        assert _height_m(meshes, float(x_m), 9.0) == pytest.approx(10.0, abs=0.51)


def test_a_wall_that_beams_pass_over_ends_there() -> None:
    boxes = [LEFT_HOUSE]
    blind = [(f, c, np.full_like(m, 0.5)) for f, c, m in _views(_truth(boxes), WIDE)]
    x, z = np.meshgrid(np.arange(5.0, 60.0, 0.1), np.arange(9.5, 30.0, 0.2))
    beyond = np.stack([x, np.full_like(x, 20.0), z], axis=-1).reshape(-1, 3)
    assert _height_m(_complete(_seen(boxes), blind), 15.0, 9.0) > 8.0
    meshes = _complete(_seen(boxes), blind, [_sweep(beyond)])
    assert not _is_wall(meshes[0], 15.0, 5.5)
    assert not _is_wall(meshes[1], 15.0, 5.5)


@pytest.mark.parametrize("side", [-1, 1])
def test_the_side_of_a_tall_neighbour_is_not_the_low_house(side: int) -> None:
    """Both share the plane of their fronts. Above the low one views show the other's side, which
    no beam reached: the low one once rose as high."""
    low = (6.0, 8.25, 18.0, 20.0, SEEN_M)
    tall = (18.0, 8.25, 30.0, 20.0, 14.0)
    boxes = [(-b[2], *b[1:2], -b[0], *b[3:]) if side < 0 else b for b in (low, tall)]
    views = _views(_truth(boxes), WIDE)
    # Beams end 17 degrees above the horizon: only the tall house returns those above the low one.
    above = _sweep(np.array([[2.0, 60.0, 1.8 + 60.0 * np.tan(np.radians(17.0))]] * 100))
    fronts = [
        _wall(np.array([x0, y0]), np.array([x1, y0]), min(top_m, 10.0), ())
        for x0, y0, x1, _, top_m in boxes
    ]
    meshes = _complete(concatenate_meshes([_street(), *fronts]), views, [above])
    for x_m in np.arange(7.0, 17.5, 1.5):
        assert _height_m(meshes, side * float(x_m), 9.5) == pytest.approx(SEEN_M, abs=0.6)
    for x_m in (19.0, 22.0, 25.0, 29.0):
        assert _height_m(meshes, side * x_m, 9.5) == pytest.approx(14.0, abs=0.6)


@pytest.mark.parametrize(
    ("tall_y_m", "faces", "share"), [(8.25, -1.0, 0.0), (8.25, 1.0, 1.0), (12.0, -1.0, 1.0)]
)
def test_what_shows_above_a_front_belongs_to_the_row_behind_it(tall_y_m, faces, share) -> None:
    """A low front set back by half a metre has a plane of its own; above it a view shows the next
    house of the row, which once raised it by 6 m. Houses of other rows do not speak."""
    north, east = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    low = Wall(np.array([0.0, 8.75, 0.0]), -north, east, (6.0, 18.0), (0.0, 7.0))
    span = (18.0, 30.0) if faces < 0 else (-30.0, -18.0)
    place = np.array([0.0, tall_y_m, 0.0])
    tall = Wall(place, faces * north, -faces * east, span, (0.0, 7.0))
    rooflines = [_sure_roofline(low, 28), _sure_roofline(tall, 56)]
    cells = [_cells_of(r) for r in rooflines]
    rows = 160 * 24 + np.arange(30, 38)  # 6 m along, 7.5 to 9.5 m up
    cells[0].surface_views.reshape(-1)[rows] = 1
    cells[0].sightings.append(SurfaceSighting(np.array([0.0, 0.0, 1.6]), rows.astype(np.int32)))
    own = unexplained(cells, rooflines)[0].reshape(-1)
    np.testing.assert_allclose(own[rows], share, atol=0.01)
    assert own.sum() == pytest.approx(own.size - len(rows) * (1 - share), abs=0.1)


def _sure_roofline(wall: Wall, top: int) -> Roofline:
    count = round((wall.span_m[1] - wall.span_m[0]) / CELL_M)
    flat, no = np.zeros(count), np.zeros(count, dtype=bool)
    energy = np.full((count, 161), 40.0, np.float32)
    energy[:, top] = 0.0
    tops = np.full(count, top)
    return Roofline(wall, CELL_M, flat, energy, tops, tops, no, np.full(count, 12.0), 0.3)


def _cells_of(roofline: Roofline) -> WallCells:
    shape = (len(roofline.top), 160)
    no = np.zeros(shape, dtype=bool)
    counts = [np.zeros(shape, dtype=np.int32) for _ in range(5)]
    roof_m = np.full(shape[0], np.inf)
    return WallCells(
        roofline.wall,
        CELL_M,
        no,
        no,
        np.zeros(shape),
        *counts,
        sightings=[],
        is_measured=no,
        roof_m=roof_m,
    )


def _roofline(wall: Wall, top: np.ndarray, depth_m: float) -> Roofline:
    flat, no = np.zeros(len(top)), np.zeros(len(top), dtype=bool)
    energy = np.zeros((len(top), 61), np.float32)
    return Roofline(wall, 0.5, flat, energy, top, top, no, np.where(top > 0, depth_m, 0.0), 0.3)


def test_walls_rise_to_the_house_behind_them_and_gaps_stay_open() -> None:
    """A row of fronts with a gap; the side wall of its right house knows that this is 15 m tall.
    The gap once got a wall that hung over the beams, as prisms behind any wall were 12 m deep."""
    north, east = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    front = Wall(np.zeros(3), -north, east, (0.0, 30.0), (0.0, 10.0))
    top = np.full(60, 20)
    top[16:24] = 0
    side = Wall(np.array([12.0, 0.0, 0.0]), -east, -north, (-12.0, 0.0), (0.0, 10.0))
    facing = Wall(np.array([8.0, 0.0, 0.0]), east, north, (0.0, 12.0), (0.0, 10.0))
    behind = [_roofline(side, np.full(24, 30), 6.0), _roofline(facing, np.full(24, 20), 6.0)]
    raised = raised_to_neighbours([_roofline(front, top, 8.0), *behind])[0]
    np.testing.assert_array_equal(raised.top[:16], 20)
    np.testing.assert_array_equal(raised.top[16:24], 0)
    np.testing.assert_array_equal(raised.top[26:35], 30)
    np.testing.assert_array_equal(raised.top[38:], 20)


def test_a_wall_that_single_beams_reach_goes_on() -> None:
    """High beams lie metres apart: too few for a mesh, but the wall between them is not silent.
    Log 002 once lost the front of a hall above its densest beams."""
    boxes = [LEFT_HOUSE]
    blind = [(f, c, np.full_like(m, 0.5)) for f, c, m in _views(_truth(boxes), WIDE)]
    x, z = np.meshgrid(np.arange(5.1, 30.0, 0.2), [5.0, 6.5, 8.0])
    on_wall = np.stack([x, np.full_like(x, LEFT_HOUSE[1]), z], axis=-1).reshape(-1, 3)
    beams = _sweep(np.repeat(on_wall, 4, axis=0))
    assert _height_m(_complete(_seen(boxes), blind, [beams]), 15.0, 9.0) > 8.0


def test_the_best_profile_is_the_best_of_all() -> None:
    rng = np.random.default_rng(0)
    energy = energy_of_filling(rng.uniform(0, 2, (5, 3)), rng.uniform(0, 2, (5, 3)))
    np.testing.assert_allclose(energy[:, 0] >= 0, True)

    def total(profile: tuple[int, ...]) -> float:
        rise = np.abs(np.diff(profile))
        return float(energy[np.arange(5), profile].sum() + (0.7 * (rise > 0) + 0.2 * rise).sum())

    profiles = list(product(range(4), repeat=5))
    assert tuple(best_profile(energy, 0.7, 0.2)) == min(profiles, key=total)
    least = least_energies(energy, 0.7, 0.2)
    for s, label in product(range(5), range(4)):
        with_it = min(total(p) for p in profiles if p[s] == label)
        without = min(total(p) for p in profiles if p[s] == 0)
        assert least[s, label] - least[s, 0] == pytest.approx(with_it - without)


def test_probabilities_of_labels_sum_over_all_profiles() -> None:
    rng = np.random.default_rng(1)
    energy, fresh = rng.uniform(0, 2, (4, 3)), rng.uniform(0.1, 1, (4, 3))
    fresh /= fresh.sum(axis=1, keepdims=True)
    kept = np.array([[0.95, 0.05, 0.0], [0.05, 0.9, 0.05], [0.0, 0.05, 0.95]])
    wanted = np.zeros((4, 3))
    for profile in product(range(3), repeat=4):
        weight = float(np.exp(-energy[np.arange(4), profile].sum())) * fresh[0, profile[0]]
        for s in range(1, 4):
            weight *= 0.8 * kept[profile[s - 1], profile[s]] + 0.2 * fresh[s, profile[s]]
        wanted[np.arange(4), profile] += weight
    found = label_probabilities(energy, fresh, 0.2)
    np.testing.assert_allclose(found, wanted / wanted.sum(axis=1, keepdims=True), rtol=1e-9)


def test_an_unseen_roof_is_its_neighbours_near_it_and_any_of_the_street_further_on() -> None:
    """The most probable profile alone stays at 16 m for all 40 m: it never begins a house."""
    wall = Wall(np.zeros(3), np.array([0.0, -1, 0]), np.array([1.0, 0, 0]), (0.0, 40.0), (0.0, 4.0))
    known = _roofline(wall, np.full(80, 32), 12.0)
    # As rooflines carry it, a building every 10 m.
    pull = 0.5 * (np.log(np.maximum(0.5 * np.arange(61), 0.5) / 10.0) / 0.3) ** 2
    energy = np.tile(0.05 * pull, (80, 1)).astype(np.float32)
    energy[:10] += 8.0 * np.abs(np.arange(61) - 32)
    roofline = replace(known, energy=energy, is_seen=np.arange(80) < 10)
    low, middle, high = 0.5 * tops_at(roofline, (10.0, 0.3), np.array([0.159, 0.5, 0.841]))
    np.testing.assert_array_equal(middle[:10], 16.0)
    assert middle[12] == pytest.approx(16.0, abs=0.5)
    # Four houses on it is the street's own: a log-normal, up to half a cell.
    assert middle[-1] == pytest.approx(10.0, abs=0.6)
    assert low[-1] == pytest.approx(10.0 * np.exp(-0.3), abs=0.6)
    assert high[-1] == pytest.approx(10.0 * np.exp(0.3), abs=0.9)
    assert (np.diff(high - low)[12:40:7] >= -0.5).all()


def test_walls_are_upright_planes() -> None:
    wall = find_walls(_wall(np.array([-6.0, 10.0]), np.array([18.0, 10.0]), SEEN_M, ()))[0]
    np.testing.assert_allclose(wall.normal, [0, -1, 0], atol=1e-6)
    assert wall.span_m[1] - wall.span_m[0] == pytest.approx(24.0, abs=1e-4)
    np.testing.assert_allclose(wall.at(np.zeros(1), np.ones(1))[0, 1:], [10.0, 1.0], atol=1e-6)


def test_wrong_inputs_are_refused_and_nothing_comes_of_nothing(canyon) -> None:
    _, views = canyon
    seen = _seen([LEFT_HOUSE])
    with pytest.raises(FrameMismatchError):
        _complete(seen.transformed(RigidTransform.identity("actor", "world")), views)
    frame, camera, matte = views[0]
    with pytest.raises(InputError, match="differ in size"):
        _complete(seen, [(frame, camera, matte[:-1])])
    assert [len(mesh.faces) for mesh in _complete(_street(), views)] == [0, 0]
