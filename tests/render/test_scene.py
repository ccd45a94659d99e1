"""Composite casters, placed actors and geometry buffers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rendering_scenes import box, camera, look_at, mesh, plane, sphere, sun_sky

from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.buffers import BACKGROUND, NO_SURFACE
from lightsim.core.colour import luminance
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.mesh import SunVisibility, TriMesh
from lightsim.core.scenario import ActorPlacement, Scenario, ScenarioFrame
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import ActorAsset
from lightsim.errors import FrameMismatchError
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.composite import CompositeCaster
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.gbuffers import render_gbuffers
from lightsim.render.roofs import UncertainRoofs
from lightsim.render.scene import FrameScene, make_static_scene, place, without_actors
from lightsim.render.transport.light import light
from lightsim.render.transport.matrix import TransportConfig, exact, trace_transport

_ABOVE = look_at((0.0, 0.0, 30.0), (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0))


def _meshes() -> list[TriMesh]:
    return [
        plane(9.0, 4),
        sphere((1, 1, 1), 1.0),
        box((-2, 0, 1.1), (1, 2, 2)),
        sphere((1, 1, 1.3), 2),
    ]


def test_composite_equals_one_caster(rng):
    meshes = _meshes()
    one = make_embree_caster(meshes)
    parts = [meshes[:0], meshes[:2], meshes[2:3], [], meshes[3:]]
    many = CompositeCaster([make_embree_caster(p) for p in parts])
    directions = rng.normal(size=(5000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = rng.uniform(-4, 4, (5000, 3))
    a, b = one.intersect(origins, directions), many.intersect(origins, directions)
    for name in ("distance_m", "mesh_index", "face_index", "barycentric"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    expected = one.is_occluded(origins, directions)
    np.testing.assert_array_equal(many.is_occluded(origins, directions), expected)
    assert [m is n for m, n in zip(many.meshes, meshes, strict=True)] == [True] * 4


def test_no_casters_hit_nothing():
    rays = np.eye(3)
    assert not CompositeCaster([]).intersect(rays, rays).is_hit.any()
    assert not CompositeCaster([]).is_occluded(rays, rays).any()


def _placement(name: str, speed_m_s: float, start_ns: int) -> ActorPlacement:
    """A 4 x 2 x 1 m box that drives along world y, turned by 90 degrees."""
    body = replace(box((0, 0, 0), (4, 2, 1), (0.9, 0.1, 0.1)), frame="actor")
    times = np.array([start_ns, start_ns + 10**9], dtype=np.int64)
    poses = [
        RigidTransform.from_yaw("world", "actor", np.pi / 2, np.array([3.0, y, 0.5])).matrix
        for y in (0.0, speed_m_s)
    ]
    track = ActorTrack(
        name,
        ActorKind.CAR,
        np.array([4.0, 2, 1]),
        Trajectory("world", "actor", times, np.array(poses)),
        True,
    )
    return ActorPlacement(ActorAsset(name, ActorKind.CAR, body), track)


def test_actors_stand_where_their_track_says_and_carry_their_index():
    late = _placement("late", 0.0, 10**10)
    car = _placement("car", 4.0, 0)
    scene = place(make_static_scene([plane()]), Scenario("s", (), (late, car)), 5 * 10**8)
    buffers = render_gbuffers(scene, camera(96, 96, 250.0), _ABOVE)
    # The number is the actor's own, also where others have not come yet.
    is_car = buffers.actor_index == 1
    assert set(np.unique(buffers.actor_index)) == {BACKGROUND, 1}
    points = buffers.position_world[is_car]
    np.testing.assert_allclose(points.min(0), [2.0, 0.0, 1.0], atol=0.15)
    np.testing.assert_allclose(points.max(0), [4.0, 4.0, 1.0], atol=0.15)
    np.testing.assert_allclose(
        buffers.base_colour[is_car], [[0.9, 0.1, 0.1]] * int(is_car.sum()), rtol=1e-5
    )


def test_buffers_of_a_plane_and_a_sphere_match_the_formulas():
    ball = sphere((0, 0, 0), 1.0, 5)
    eye = np.array([0.0, -5.0, 0.0])
    view = look_at(eye, (0, 0, 0))
    scene = without_actors(make_static_scene([ball]))
    buffers = render_gbuffers(scene, camera(64, 48, 60.0), view)
    seen = buffers.has_surface
    points, normals = buffers.position_world[seen], buffers.normal_world[seen]
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1, atol=3e-3)
    assert ((normals * points).sum(1) > 0.995).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    in_camera = view.inverse().apply(points.astype(np.float64))
    np.testing.assert_allclose(buffers.depth_z_m[seen], in_camera[:, 2], atol=1e-5)
    uv, _ = camera(64, 48, 60.0).project(in_camera)
    np.testing.assert_allclose(uv, camera(64, 48).pixel_centres()[seen], atol=1e-3)
    assert (buffers.actor_index[~seen] == NO_SURFACE).all()
    assert np.isinf(buffers.depth_z_m[~seen]).all()


def test_normals_face_the_camera_on_both_sides_of_a_face():
    flat = plane()
    flipped = mesh(flat.vertices, flat.faces[:, ::-1])
    for surface in (flat, flipped):
        scene = without_actors(make_static_scene([surface]))
        normal = render_gbuffers(scene, camera(), _ABOVE).normal_world
        np.testing.assert_allclose(normal[24, 32], [0, 0, 1], atol=1e-6)


def test_inferred_meshes_cast_shadows_and_are_seen_only_on_request():
    roof = plane(4.0, z_m=5.0)
    for is_visible in (False, True):
        static = make_static_scene([plane()], [roof], inferred_is_visible=is_visible)
        scene: FrameScene = without_actors(static)
        buffers = render_gbuffers(scene, camera(), _ABOVE)
        assert buffers.position_world[24, 32, 2] == pytest.approx(5.0 * is_visible, abs=1e-4)
        out = light(
            trace_transport(scene, buffers, exact()), scene, buffers, sun_sky(0.0, 90.0), exact()
        )
        assert out.sun_visibility[24, 32] == float(is_visible)
        assert out.sun_visibility[2, 2] == 1.0


def test_a_pose_of_other_frames_is_refused():
    scene = without_actors(make_static_scene([plane()]))
    with pytest.raises(FrameMismatchError, match="world_from_camera"):
        render_gbuffers(scene, camera(), _ABOVE.inverse())


def test_an_empty_scene_is_all_sky():
    scene = without_actors(make_static_scene([]))
    buffers = render_gbuffers(scene, camera(), _ABOVE)
    assert not buffers.has_surface.any()
    out = light(
        trace_transport(scene, buffers, exact()), scene, buffers, sun_sky(0.0, 40.0), exact()
    )
    np.testing.assert_array_equal(out.shaded, 0)
    np.testing.assert_array_equal(out.ratio, 1)


def test_the_found_visibility_holds_but_for_the_shadows_of_what_moves() -> None:
    """Ground whose pictures showed a shadow that no mesh casts, and a car that drives there."""
    ground = plane(10.0, 80)
    is_lit = ground.vertices[:, 0] > 0
    ground = replace(
        ground, sun_visibility=SunVisibility(np.where(is_lit, 255, 0).astype(np.uint8))
    )
    car = _placement("car", 4.0, 0)
    frame = CameraFrame("test", "00", 0, _ABOVE, lambda: np.zeros((96, 96, 3), np.uint8))
    config = TransportConfig(sky_rays=1, face_rays=0, glossy_rays=0)
    renderer = FrameRenderer(ground, plane(cells=0), config, 0)
    scenario = Scenario("s", (ScenarioFrame.of(frame, "rendered"),), (car,))
    sky = sun_sky(np.pi, 45.0)
    traced = renderer.trace(scenario, frame, camera(96, 96, 250.0))
    found = traced.found_visibility(sky.sun)
    assert found is not None
    buffers = traced.buffers
    is_ground = buffers.actor_index == BACKGROUND
    assert np.isnan(found[~is_ground]).all()
    x, y = buffers.position_world[..., 0], buffers.position_world[..., 1]
    # The car stands at x 2 to 4 and y -2 to 2, 1 m tall; the sun at 45 degrees beyond it.
    in_car_shade = (x > 4.1) & (x < 4.9) & (np.abs(y) < 1.9)
    assert (is_ground & in_car_shade).sum() > 100
    assert (found[is_ground & in_car_shade] == 0).all()
    assert (found[is_ground & (x > 0.3) & (x < 1.8)] > 0.99).all()
    assert (found[is_ground & (x < -0.3)] == 0).all()


def test_the_recorded_sun_is_rendered_as_found_and_another_is_not() -> None:
    """A renderer that knows the recorded sun shades what the pictures showed in shade."""
    ground = plane(10.0, 80)
    is_lit = ground.vertices[:, 0] > 0
    found = SunVisibility(np.where(is_lit, 255, 0).astype(np.uint8))
    ground = replace(ground, sun_visibility=found)
    frame = CameraFrame("test", "00", 0, _ABOVE, lambda: np.zeros((96, 96, 3), np.uint8))
    recorded, other = sun_sky(np.pi, 45.0), sun_sky(np.pi, 50.0)
    config = TransportConfig(sky_rays=1, face_rays=0, glossy_rays=2)
    renderer = FrameRenderer(
        ground, plane(cells=0), config, 0, is_sampled=True, recorded_sun=recorded.sun
    )
    traced = renderer.trace(Scenario("s", (), ()), frame, camera(96, 96, 250.0))
    x = traced.buffers.position_world[..., 0]
    for sky, in_shade in ((recorded, 0.0), (other, 1.0)):
        prepared = renderer.prepare(sky)
        visibility, image = traced.light(prepared).sun_visibility, traced.image(prepared)
        assert (visibility[x > 0.3] > 0.99).all()
        np.testing.assert_allclose(visibility[x < -0.3], in_shade, atol=0.01)
        brightness = image[x < -0.3].mean() / image[x > 0.3].mean()
        assert abs(brightness - in_shade) < 0.05


def test_a_shadow_is_as_soft_as_its_roof_is_uncertain() -> None:
    """Walls 4 or 8 m tall before a sun 45 degrees high: ground is dark up to 4 m behind, and up to
    8 m its code is the mean of dark and lit; under the sun of the recording the wall that its
    shadows chose is taken. Whether cameras see a wall changes nothing of that."""
    sky, elsewhere = sun_sky(0.0, 45.0, 0.2), sun_sky(np.radians(3.0), 45.0)
    low, tall = (box((0.0, 0.0, height / 2), (0.02, 60.0, height)) for height in (4.0, 8.0))
    shapes = [make_embree_caster([shape]) for shape in (low, tall)]
    frame = CameraFrame("test", "00", 0, _ABOVE, lambda: np.zeros((96, 96, 3), np.uint8))
    config = TransportConfig(sky_rays=1, face_rays=0, glossy_rays=0)
    for recorded_sun, half in ((elsewhere.sun, 0.5), (sky.sun, 0.0), (None, 0.5)):
        roofs = UncertainRoofs(lambda: shapes, recorded_sun)
        for is_sampled, is_seen in ((False, False), (True, False), (False, True)):
            renderer = FrameRenderer(
                *(plane(20.0, 4), tall, config, 0),
                is_sampled=is_sampled,
                inferred_is_visible=is_seen,
            )
            renderer = renderer.with_roofs(roofs)
            traced = renderer.trace(Scenario("s", (), ()), frame, camera(96, 96, 100.0))
            lit, x = traced.light(sky), traced.buffers.position_world[..., 0]
            rest, sun = luminance(lit.sky + lit.bounce), np.sin(np.radians(45.0))
            for behind_m, wanted in ((2.0, 0.0), (6.0, half), (10.0, 1.0)):
                there = np.abs(x + behind_m) < 1.0
                dark, bright, code = (
                    value[there] ** (1 / 2.2)
                    for value in (rest, rest + sun, rest + luminance(lit.direct_sun))
                )
                np.testing.assert_allclose(code, (1 - wanted) * dark + wanted * bright, rtol=1e-3)
                part = lit.sun_visibility[there]
                if wanted == 0.5:
                    assert 0.2 < part.min() <= part.max() < 0.5
                else:
                    np.testing.assert_allclose(part, wanted, atol=1e-5)
