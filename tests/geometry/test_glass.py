"""A facade across the street: dark mirrors in it are panes, blank walls and shadows are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lightsim.core.buildings import Wall
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import Provenance, TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.geometry.completion.facade_cells import (
    CELL_M,
    FEATURES,
    FacadeCells,
    facade_cells,
    mean_around,
)
from lightsim.geometry.completion.glass import Pane, find_glass, find_rectangles
from lightsim.geometry.completion.glazing import glaze
from lightsim.geometry.completion.shipped_glass import shipped_glass_log_odds
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.geometry.materials import FACADE, GLASS
from lightsim.render.casters.embree import EmbreeCaster

CAMERA = PinholeCamera("left", 480, 270, 240.0, 240.0, 240.0, 135.0)
# The wall stands at y = 8, looks to -y and reaches from x = 0 to 16 and up to 6 m.
WALL = Wall(
    np.array([0.0, 8.0, 0.0]),
    np.array([0.0, -1.0, 0.0]),
    np.array([1.0, 0.0, 0.0]),
    (0.0, 16.0),
    (0.0, 6.0),
)
# Low and high x, low and high z.
PANES = ((2.0, 3.5, 1.0, 2.5), (6.0, 7.5, 1.0, 2.5), (10.0, 13.0, 0.75, 3.0))
WHITE, DARK = 180, 60


def _facade() -> TriMesh:
    """The wall in squares of 0.5 m."""
    x, z = (k.ravel() for k in np.meshgrid(np.arange(33) / 2, np.arange(13) / 2, indexing="ij"))
    points = np.stack([x, np.full_like(x, 8.0), z], axis=1).astype(np.float32)
    start = (np.arange(32)[:, None] * 13 + np.arange(12)).ravel()
    quad = np.stack([start, start + 13, start + 14, start + 1], axis=1)
    faces = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]).astype(np.int32)
    return TriMesh("world", points, faces, np.zeros_like(points), (FACADE,))


def _is_pane(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    inside = [(x > a) & (x < b) & (z > c) & (z < d) for a, b, c, d in PANES]
    return np.logical_or.reduce(inside)


def _is_shadow(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Of a roof's edge, slanting across the wall, and of a pole."""
    return (z > 1.0 + 0.3 * x) | (np.abs(x - z - 9.0) < 0.2)


def _frames(is_dark, gain: float = 1.0) -> ViewEvidence:
    """A camera that looks at the wall and drives along it."""
    rotation = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    views = []
    for number, x_m in enumerate(np.arange(1.0, 15.0, 2.0)):
        pose = RigidTransform.from_rotation("world", "camera", rotation, np.array([x_m, 0, 1.6]))
        frame = CameraFrame("left", f"{number}", number, pose, lambda: np.zeros((1, 1, 3), "u1"))
        origins, rays = frame.pixel_rays(CAMERA, CAMERA.pixel_centres().reshape(-1, 2))
        place = origins + ((8.0 - origins[:, 1]) / rays[:, 1])[:, None] * rays
        dark = is_dark(place[:, 0], place[:, 2])
        image = gain * np.where(dark, DARK, WHITE)[:, None] * np.ones(3)
        image = image.astype(np.uint8).reshape(CAMERA.height_px, -1, 3)
        frame = CameraFrame("left", frame.stem, number, pose, lambda image=image: image)
        views.append((frame, CAMERA, np.zeros((CAMERA.height_px, CAMERA.width_px), "f4")))
    return ViewEvidence(views)


def _returns(is_missing=None, recess_m: float | None = None) -> np.ndarray:
    """Beams on the wall; in panes none, or only their bars send some back."""
    x, z = (k.ravel() for k in np.meshgrid(np.arange(0, 16, 0.05), np.arange(0, 4, 0.1)))
    y = np.full_like(x, 8.0)
    if is_missing is not None:
        missing = is_missing(x, z)
        is_bar = np.zeros_like(missing)
        if recess_m is not None:
            is_bar = missing & (np.abs(x % 1.5 - 0.75) < 0.06)
            y[is_bar] += recess_m
        x, y, z = (k[~missing | is_bar] for k in (x, y, z))
    return np.stack([x, y, z], axis=1).astype(np.float32)


def _nothing(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.zeros(x.shape, dtype=bool)


def _cells(is_dark, returns: np.ndarray, gain: float = 1.0) -> FacadeCells:
    (cells,) = facade_cells([WALL], _frames(is_dark, gain), returns, EmbreeCaster([_facade()]))
    return cells


def _plane(cells: FacadeCells, name: str) -> np.ndarray:
    return cells.features[FEATURES.index(name)]


def _inside(cells: FacadeCells, pane: tuple[float, float, float, float]) -> np.ndarray:
    """Cells wholly within a rectangle."""
    x, z = WALL.grid(CELL_M, cells.is_known.shape)
    is_in = np.abs(x - (pane[0] + pane[1]) / 2) < (pane[1] - pane[0]) / 2 - CELL_M
    return is_in & (np.abs(z - (pane[2] + pane[3]) / 2) < (pane[3] - pane[2]) / 2 - CELL_M)


# The floor of darkness is a larger part of the darker picture.
@pytest.mark.parametrize(("gain", "within"), [(1.0, 0.03), (0.5, 0.23)])
def test_cells_are_told_against_the_wall_around_whatever_the_gain(
    gain: float, within: float
) -> None:
    cells = _cells(_is_pane, _returns(_is_pane, 0.15), gain)
    reference = _cells(_is_pane, _returns(_is_pane, 0.15))
    shade = _plane(cells, "log luminance, median of views")
    is_seen = _plane(cells, "views show it") > 0
    x, z = WALL.grid(CELL_M, cells.is_known.shape)
    # Codes 180 and 60 are linear .456 and .045.
    painted = np.where(_is_pane(x, z), np.log(0.045), np.log(0.456))
    expected = painted - mean_around(np.where(is_seen, painted, np.nan), 1.5)
    inner = np.logical_or.reduce([_inside(cells, pane) for pane in PANES])
    assert is_seen[inner].all()
    assert np.abs(shade - expected)[inner].mean() < within
    # A gain of codes is none of light: the two differ by sRGB's foot alone.
    before = _plane(reference, "log luminance, median of views")
    assert np.abs(shade - before)[is_seen].max() < 0.26
    np.testing.assert_allclose(cells.features[6:], reference.features[6:])


def test_beams_that_do_not_come_back_are_told() -> None:
    cells = _cells(_nothing, _returns(_is_pane))
    over = _plane(cells, "returns, over those around")
    x, z = WALL.grid(CELL_M, cells.is_known.shape)
    is_blank = ~_is_pane(x, z) & (z < 3.2) & (x > 8.2) & (x < 9.3)
    assert over[is_blank].mean() > 1.3
    for pane in PANES:
        assert over[_inside(cells, pane)].max() < 0.33
    # Nothing is missing above the highest beam.
    assert (_plane(cells, "there are returns around")[:, 36:] == 0).all()


def _dark(features: np.ndarray) -> np.ndarray:
    """Glass for whom all that is darker than the wall around is glass."""
    return np.where(features[0] < -0.6, 3.0, -3.0).astype(np.float32)


def _fits(pane: Pane, wanted: tuple[float, float, float, float], within_m: float) -> bool:
    ends = np.array([*pane.span_m, *pane.height_m])
    return bool(np.abs(ends - wanted).max() < within_m)


def test_dark_rectangles_without_returns_are_panes_at_their_frames_depth() -> None:
    panes = find_glass([_cells(_is_pane, _returns(_is_pane, 0.15))], _dark)
    assert len(panes) == len(PANES)
    for wanted in PANES:
        assert sum(_fits(pane, wanted, 0.01) for pane in panes) == 1
    for pane in panes:
        assert abs(pane.wall_m) < 1e-5
        assert abs(pane.out_m + 0.15) < 1e-5


def test_the_shipped_network_tells_windows_of_a_street_that_it_does_not_know() -> None:
    panes = find_glass([_cells(_is_pane, _returns(_is_pane, 0.15))], shipped_glass_log_odds())
    # To two cells. Of the third pane, 3 m wide, the network finds a part.
    for wanted in PANES[:2]:
        assert sum(_fits(pane, wanted, 2.1 * CELL_M) for pane in panes) == 1
    for pane in panes:
        x, z = np.array([*pane.span_m, np.mean(pane.span_m)]), np.full(3, np.mean(pane.height_m))
        assert _is_pane(x + np.array([0.2, -0.2, 0.0]), z).all()


@pytest.mark.parametrize("is_dark", [_nothing, _is_shadow])
def test_blank_walls_and_slanting_shadows_are_no_panes(is_dark) -> None:
    assert find_glass([_cells(is_dark, _returns())], shipped_glass_log_odds()) == []


def test_rectangles_hold_what_speaks_for_glass_on_the_whole() -> None:
    log_odds = np.full((60, 40), -1.0)
    log_odds[20:30, 10:22] = 2.0
    log_odds[24:26, 15:17] = -1.0
    log_odds[5:7, 5:7] = 4.0  # too small to be a pane
    assert find_rectangles(log_odds) == [(20, 10, 10, 12)]
    assert find_rectangles(np.zeros_like(log_odds)) == []


def test_panes_end_where_views_end_and_a_few_dark_cells_are_none() -> None:
    """What no view shows cost nothing: a pane reached over all of it to the next dark cell."""
    facade = _cells(_nothing, _returns())
    log_odds = np.full(facade.is_known.shape, -1.0, dtype=np.float32)
    log_odds[5:15, 10:22] = log_odds[40:42, 10:12] = log_odds[50:54, 5:11] = 2.0
    log_odds[52, 6:10] = -3.0
    is_known = np.ones(log_odds.shape, dtype=bool)
    is_known[15:40] = False
    (pane,) = find_glass([replace(facade, is_known=is_known)], lambda _: log_odds)
    assert _fits(pane, (5 * CELL_M, 15 * CELL_M, 10 * CELL_M, 22 * CELL_M), 0.01)


def _pane(recess_m: float) -> Pane:
    return Pane(WALL, (2.1, 3.6), (1.1, 2.4), 0.0, -recess_m)


def _toward_wall(slant: float) -> tuple[EmbreeCaster, np.ndarray, np.ndarray, TriMesh]:
    mesh = glaze(_facade(), [_pane(0.15)])
    x, z = np.meshgrid(np.arange(0.513, 15.5, 0.071), np.arange(0.507, 5.5, 0.071))
    start = np.stack([x.ravel() - 7 * slant, np.full(x.size, 1.0), z.ravel()], axis=1)
    rays = np.broadcast_to(np.array([slant, 1.0, 0.0]) / np.hypot(slant, 1.0), start.shape)
    return EmbreeCaster([mesh]), start, rays.copy(), mesh


def test_a_pane_closes_its_hole_at_its_depth() -> None:
    caster, start, rays, mesh = _toward_wall(0.0)
    hits = caster.intersect(start, rays)
    assert hits.is_hit.all()
    x, z = start[:, 0], start[:, 2]
    is_pane = (x > 2.1) & (x < 3.6) & (z > 1.1) & (z < 2.4)
    assert mesh.face_material is not None
    material = [mesh.materials[k] for k in mesh.face_material[hits.face_index]]
    assert [m == GLASS for m in material] == is_pane.tolist()
    depth = np.where(is_pane, 7.15, 7.0)
    np.testing.assert_allclose(hits.distance_m, depth, atol=1e-4)
    # Wall and pane look out of the house.
    assert (mesh.face_normals()[hits.face_index] @ WALL.normal > 0.99).all()


@pytest.mark.parametrize("slant", [-2.0, 2.0])
def test_no_ray_passes_beside_a_pane(slant: float) -> None:
    caster, start, rays, mesh = _toward_wall(slant)
    hits = caster.intersect(start, rays)
    is_inner = np.abs(start[:, 0] + 7 * slant - 8.0) < 6.0
    assert hits.is_hit[is_inner].all()
    facing = (mesh.face_normals()[hits.face_index] * rays).sum(axis=1)
    assert (facing[is_inner] < 0).all()


def test_panes_are_guessed_only_in_walls_that_are() -> None:
    for wall, pane in (
        (Provenance.MEASURED, Provenance.INTERPOLATED),
        (Provenance.INFERRED, Provenance.INFERRED),
    ):
        mesh = glaze(_facade().with_provenance(wall), [_pane(0.05)])
        assert mesh.face_material is not None
        is_glass = mesh.face_material == mesh.materials.index(GLASS)
        assert mesh.has_provenance(pane)[is_glass].all()
        area = mesh.face_areas_m2()[mesh.has_provenance(wall) & ~is_glass].sum()
        reveals = 2 * (1.5 + 1.3) * 0.05 if wall == pane else 0.0
        assert area == pytest.approx(16 * 6 - 1.5 * 1.3 + reveals, rel=1e-5)


def test_without_panes_nothing_changes() -> None:
    mesh = _facade()
    assert glaze(mesh, []) is mesh


def test_a_pane_is_found_once_though_two_planes_lie_close() -> None:
    near = Wall(WALL.origin_m + 0.2 * WALL.normal, WALL.normal, WALL.along, (0.0, 16.0), (0.0, 6.0))
    caster = EmbreeCaster([_facade()])
    cells = facade_cells([WALL, near], _frames(_is_pane), _returns(_is_pane, 0.1), caster)
    assert len(find_glass(cells, _dark)) == len(PANES)
