"""The viewer's scene: orientation of the sky, cameras, actors and the shared page."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.app.test_view_meshes import BuiltWorkspace
from tests.tiny_world import ABOVE, BOX_LWH_M, LENS, STEP_M, STEP_NS, driving_box, tiny_world

from lightsim.app import scene
from lightsim.app.page import frames_of, write_page
from lightsim.app.server import open_server, stop_server
from lightsim.app.sky import DOME_RADIUS_M, dome_picture, dome_surface, sun_arc
from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.dome import SkyDome, Sun, add_sun
from lightsim.core.frames import RigidTransform, matrices_from_quaternions
from lightsim.core.log import Clock, GeoReference, Place
from lightsim.core.sensors import CameraFrame
from lightsim.core.solar import angle_between_deg
from lightsim.errors import InputError
from lightsim.progress import SilentProgress

viser = pytest.importorskip("viser")
EQUINOX_NS = 1_742_472_000_000_000_000
"""2025-03-20 12:00 UTC, three hours after the equinox."""
SUN_DIRECTION = np.array([0.48, -0.6, 0.64])


def sunny(rows: int = 64) -> SkyDome:
    sun = Sun(SUN_DIRECTION, np.array([5.0, 4.5, 4.0], np.float32))
    return add_sun(np.full((rows, 2 * rows, 3), (0.1, 0.2, 0.4), np.float32), sun)


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    server = open_server("127.0.0.1", 0)
    yield server
    stop_server(server)


@pytest.fixture
def api(server: Any) -> Iterator[Any]:
    yield server.scene
    server.scene.reset()


def turn_of(handle: Any) -> np.ndarray:
    return matrices_from_quaternions(np.asarray(handle.wxyz)[None])[0]


@pytest.mark.parametrize("direction", [SUN_DIRECTION, [0.0, 0.8, 0.6], [-0.8, -0.0001, 0.6]])
def test_the_dome_shows_the_sun_where_it_is(direction: Any) -> None:
    way = np.asarray(direction) / np.linalg.norm(direction)
    rows = 256
    dome = add_sun(np.zeros((rows, 2 * rows, 3), np.float32), Sun(way, np.ones(3, np.float32), 2.0))
    picture = dome_picture(dome, 0.0)
    vertices, faces, uv = dome_surface()
    # The ray from the centre hits the face in which all three weights are positive.
    edges = vertices[faces].astype(np.float64).transpose(0, 2, 1)
    weights = np.linalg.inv(edges) @ way
    (face,) = np.flatnonzero((weights > 0).all(axis=1))[:1]
    at = weights[face] @ uv[faces[face]] / weights[face].sum()
    row, column = int(at[1] * rows), int(at[0] * 2 * rows)
    assert picture[row, column].min() == 255
    assert (picture == 255).mean() < 0.002  # and nowhere else


def test_the_dome_is_seen_from_inside_and_is_in_front_of_the_far_plane() -> None:
    vertices, faces, _ = dome_surface()
    a, b, c = vertices[faces].swapaxes(0, 1).astype(np.float64)
    inward = -np.einsum("nc,nc->n", np.cross(b - a, c - a), a + b + c)
    assert (inward > 1.0).all()
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), DOME_RADIUS_M, rtol=1e-6)
    assert 2 * DOME_RADIUS_M <= 1000.0


def test_exposure_brightens_the_dome_by_stops() -> None:
    dome = SkyDome(np.full((8, 16, 3), 0.1, np.float32), None)
    shown = linear_from_srgb8(dome_picture(dome, 2.0))
    np.testing.assert_allclose(shown, 0.4, rtol=0.01)
    assert (dome_picture(dome, 4.0) == 255).all()


def test_a_camera_has_its_vertical_field_of_view_and_its_pose(api: Any) -> None:
    camera = PinholeCamera("wide", 80, 40, 20.0, 40.0, 40.0, 20.0)
    pose = RigidTransform.from_yaw("world", "camera", 0.3, np.array([1.0, 2.0, 3.0]))
    picture = np.zeros((1000, 2000, 3), np.uint8)
    frame = CameraFrame("wide", "00", 0, pose, lambda: picture)
    handle = scene.show_cameras(api, {"wide": camera}, [frame])["wide"]
    # The upper right corner of the image, one metre ahead of the camera.
    top = -np.tan(handle.fov / 2)
    corner = camera.directions(np.array([80.0, 0.0]))
    np.testing.assert_allclose(corner / corner[2], [-top * handle.aspect, top, 1.0])
    np.testing.assert_allclose(turn_of(handle), pose.rotation, atol=1e-12)
    np.testing.assert_allclose(handle.position, pose.translation_m)
    assert handle.image is not None
    assert max(handle.image.shape) <= 480
    later = replace(frame, world_from_camera=ABOVE)
    scene.set_camera(handle, later)
    np.testing.assert_allclose(turn_of(handle), ABOVE.rotation, atol=1e-12)


def test_the_box_of_a_placed_actor_has_the_corners_of_its_track(api: Any) -> None:
    _, track = driving_box()
    handle = scene.show_actors(api, [track], {})["car"]
    assert not handle.frame.visible
    assert handle.mesh is None
    pose = RigidTransform.from_yaw("world", "actor", 0.7, np.array([3.0, 4.0, 5.0]))
    scene.place_actor(handle, pose)
    assert handle.frame.visible
    shown = handle.box.points @ turn_of(handle.frame).T + np.asarray(handle.frame.position)
    lengths = np.linalg.norm(shown[:, 0] - shown[:, 1], axis=1)
    np.testing.assert_allclose(np.sort(lengths), np.sort(np.repeat(BOX_LWH_M, 4)), rtol=1e-6)
    corners = np.unique(shown.reshape(-1, 3).round(4), axis=0)
    expected = np.unique(pose.apply(track.corners_actor).round(4), axis=0)
    np.testing.assert_allclose(corners, expected, atol=2e-4)
    scene.place_actor(handle, None)
    assert not handle.frame.visible


def test_actors_are_shown_while_they_are_present(api: Any) -> None:
    _, track = driving_box()
    handles = scene.show_actors(api, [track], {})
    scene.place_actors(handles, [track], STEP_NS)
    assert handles["car"].frame.visible
    np.testing.assert_allclose(handles["car"].frame.position, [0.0, 0.0, BOX_LWH_M[2] / 2])
    scene.place_actors(handles, [track], 10 * STEP_NS)
    assert not handles["car"].frame.visible


def test_ids_with_slashes_are_nodes_of_their_own(api: Any) -> None:
    _, track = driving_box()
    tracks = [replace(track, actor_id="a"), replace(track, actor_id="a/b")]
    handles = scene.show_actors(api, tracks, {})
    assert handles["a/b"].frame.name.count("/") == handles["a"].frame.name.count("/")


def test_a_path_runs_along_the_ground(api: Any) -> None:
    _, track = driving_box()
    points = scene.show_paths(api, [track])["car"].points
    np.testing.assert_allclose(points[0, 0], [0.0, -STEP_M, 0.0], atol=1e-6)
    np.testing.assert_allclose(points[-1, 1], [0.0, STEP_M, 0.0], atol=1e-6)
    assert scene.show_paths(api, [replace(track, is_moving=False)]) == {}


def geo_at(latitude: float, longitude: float) -> GeoReference:
    north = RigidTransform.from_yaw("enu", "world", 0.5, np.zeros(3))
    return GeoReference(Place(latitude, longitude), Clock(), north, "given", 0.0)


@pytest.mark.parametrize("longitude", [-150.0, 0.0, 120.0])
def test_the_equinox_arc_at_the_equator_runs_from_east_over_the_zenith_to_west(
    longitude: float,
) -> None:
    geo = geo_at(0.0, longitude)
    arc = sun_arc(geo, EQUINOX_NS)
    assert arc is not None
    assert geo.enu_from_world is not None
    enu = geo.enu_from_world.rotate(arc.directions_world)
    assert np.abs(enu[:, 1]).max() < np.sin(np.radians(1.0))
    assert enu[0, 0] > 0.99
    assert enu[-1, 0] < -0.99
    assert enu[:, 2].max() > 0.995
    assert len(arc.hours) in (12, 13)
    hour = next(iter(arc.hours))
    assert (np.diff(arc.times_ns) > 0).all()
    assert 0 <= hour < 24


def test_the_arc_passes_through_the_recorded_sun() -> None:
    geo = geo_at(41.4, 2.2)
    arc = sun_arc(geo, EQUINOX_NS + 7_000_000_000_000)
    recorded = geo.direction_at(EQUINOX_NS + 7_000_000_000_000)
    assert arc is not None
    assert recorded is not None
    nearest = min(angle_between_deg(recorded, way) for way in arc.directions_world)
    assert nearest < 1.9  # half of a quarter of an hour


def test_no_arc_without_a_place_or_in_polar_night() -> None:
    assert sun_arc(replace(geo_at(0.0, 0.0), place=None), EQUINOX_NS) is None
    assert sun_arc(geo_at(-89.0, 0.0), EQUINOX_NS + 90 * 86_400_000_000_000) is None


def test_the_arc_lies_on_the_dome_with_a_ring_around_the_recorded_sun(api: Any) -> None:
    arc = sun_arc(geo_at(41.4, 2.2), EQUINOX_NS)
    handles = scene.show_sun_arc(api, arc, SUN_DIRECTION, np.array([1.0, 2.0, 3.0]))
    assert handles.arc is not None
    assert handles.recorded is not None
    assert arc is not None
    for line in (handles.arc, handles.recorded):
        distance = np.linalg.norm(line.points, axis=-1)
        assert (distance < DOME_RADIUS_M).all()
        assert (distance > 0.9 * DOME_RADIUS_M).all()
    way = handles.recorded.points.reshape(-1, 3).astype(np.float64)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(way @ SUN_DIRECTION))
    np.testing.assert_allclose(angles, angles[0], atol=0.01)
    assert len(handles.hours) == len(arc.hours)
    empty = scene.show_sun_arc(api, None, None, np.zeros(3))
    assert empty.arc is None
    assert empty.recorded is None


def built(folder: Path) -> BuiltWorkspace:
    work = tiny_world(sunny())
    work.__class__ = BuiltWorkspace
    assert isinstance(work, BuiltWorkspace)
    work.root, work.twin_key = folder, "first"
    picture = np.full((LENS.height_px, LENS.width_px, 3), 90, np.uint8)
    frames = tuple(replace(frame, load_srgb8=lambda: picture) for frame in work.log.frames)
    work.__dict__["log"] = work.log.with_frames(frames)
    return work


def test_the_page_is_one_file_and_its_server_has_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    start = viser.ViserServer
    monkeypatch.setattr(viser, "ViserServer", lambda **kw: made.append(start(**kw)) or made[-1])
    path = tmp_path / "page.html"
    write_page(built(tmp_path), path, "01", SilentProgress())
    html = path.read_text()
    assert "__VISER_EMBED_DATA__" in html
    assert not [line for line in html.splitlines() if 'src="http' in line or 'href="http' in line]
    (server,) = made
    assert server.get_host() == "127.0.0.1"
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", server.get_port()), timeout=1.0)
    assert [p.name for p in tmp_path.iterdir() if p.suffix == ".html"] == ["page.html"]


def test_an_unknown_frame_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"07.*00, 01, 02"):
        frames_of(built(tmp_path).log, "07")
