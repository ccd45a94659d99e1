"""Gains, visibility and texels of textures, on a scene whose radiance is known everywhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plane_mesh import plane_mesh

from lightsim.appearance.atlas import patches_of, texels_of
from lightsim.appearance.bake import TexelSamples, bake, mean_radiance
from lightsim.appearance.bake_kernels import code_weight, weight_code
from lightsim.appearance.config import AssetConfig
from lightsim.appearance.observe import outlines
from lightsim.core.actors import ActorKind, ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.frames import RigidTransform, Trajectory
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import Material, Texture, TriMesh, concatenate_meshes
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.geometry.surface import make_mesh
from lightsim.progress import SilentProgress
from lightsim.render.casters.embree import make_embree_caster

GAINS = {"a": np.array([1.3, 1.0, 0.9]), "b": np.array([0.8, 0.7, 1.1]), "c": np.array([1, 1.2, 1])}
DOWN = np.diag([1.0, -1.0, -1.0])
CONFIG = AssetConfig(occlusion_tolerance_m=0.05, shade_margin_m=0.25)


def _pattern(xy: np.ndarray) -> np.ndarray:
    """A smooth radiance on the ground."""
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([0.3 + 0.1 * np.sin(x), 0.35 + 0.1 * np.cos(y), 0.3 + 0.02 * x], axis=-1)


def _log(
    actors: tuple[ActorTrack, ...],
    occluder: np.ndarray | None,
    colour: tuple[float, float, float] = (0.8, 0.02, 0.02),
) -> DrivingLog:
    """Three cameras with unequal gains look straight down from 5 m, shifted along x."""
    cameras, frames = {}, []
    for i, (name, gain) in enumerate(GAINS.items()):
        camera = PinholeCamera(name, 160, 160, 120.0, 120.0, 80.0, 80.0)
        centre = np.array([1.0 * i - 1.0, 0.0, 5.0])
        pose = RigidTransform.from_rotation("world", "camera", DOWN, centre)
        uv = camera.pixel_centres()
        ray = pose.rotate(camera.directions(uv))
        radiance = _pattern((centre + ray * (-5.0 / ray[..., 2:]))[..., :2])
        if occluder is not None:
            top = (centre + ray * (-4.0 / ray[..., 2:]))[..., :2]
            radiance[(np.abs(top - occluder) < 0.5).all(axis=-1)] = colour
        image = srgb8_from_linear(radiance * gain)
        cameras[name] = camera
        frames.append(CameraFrame(name, "0", 0, pose, lambda image=image: image))
    ego = Trajectory("world", "ego", np.array([0], dtype=np.int64), np.eye(4)[None])
    return DrivingLog("toy", cameras, tuple(frames), (), ego, actors, None, {})


def _box_track() -> tuple[ActorTrack, TriMesh]:
    matrix = np.eye(4)
    matrix[2, 3] = 0.5
    pose = Trajectory("world", "actor", np.array([0], dtype=np.int64), matrix[None])
    track = ActorTrack("box", ActorKind.CAR, np.array([1.0, 1.0, 1.0]), pose, True)
    lid = plane_mesh(1.0, 0.25, 0.5)
    return track, make_mesh("actor", lid.vertices, lid.faces.astype(np.int64))


def _gain_array() -> np.ndarray:
    gains = np.array(list(GAINS.values()))
    return gains / np.exp(np.log(gains).mean(axis=0))


def _bake(
    log: DrivingLog, plane: TriMesh, actors: dict[str, TriMesh], config: AssetConfig = CONFIG
) -> tuple[list[TriMesh], np.ndarray]:
    return bake(
        log, plane, actors, config, make_caster=make_embree_caster, progress=SilentProgress()
    )


def _texels(mesh: TriMesh) -> tuple[np.ndarray, np.ndarray]:
    """Position and colour of every texel."""
    assert mesh.texture is not None
    texels = texels_of(patches_of(mesh.texture))
    corners = mesh.vertices[mesh.faces[texels.face]]
    points = (texels.barycentric[:, :, None] * corners).sum(axis=1)
    return points, mesh.texture.image.reshape(-1, 3)[texels.pixel]


def test_gains_and_texels_come_back() -> None:
    """Known gains within 1 %, known radiance within 2 %, the moving box not on the ground."""
    track, lid = _box_track()
    plane = plane_mesh(8.0, 0.8)
    (ground, top), gains = _bake(_log((track,), np.zeros(2)), plane, {"box": lid})
    np.testing.assert_allclose(gains, _gain_array(), rtol=0.01)
    np.testing.assert_allclose(np.log(gains).mean(axis=0), 0, atol=1e-6)
    points, colour = _texels(ground)
    scale = np.exp(np.log(np.array(list(GAINS.values()))).mean(axis=0))
    expected = _pattern(points[:, :2]) * scale
    inner = (np.abs(points[:, :2]) < 2.5).all(axis=1) & ~(np.abs(points[:, :2]) < 1.4).all(axis=1)
    assert inner.sum() > 5000
    np.testing.assert_allclose(colour[inner], expected[inner], rtol=0.02)
    under = (np.abs(points[:, :2]) < 0.3).all(axis=1)
    np.testing.assert_allclose(colour[under], expected[under], rtol=0.2)
    points, colour = _texels(top)
    middle = (np.abs(points[:, :2]) < 0.4).all(axis=1)
    assert colour[middle, 0].min() > 4 * colour[middle, 1].max()


def test_leaves_that_the_crown_lacks_do_not_fall_on_the_ground() -> None:
    """The recorded crown is five times as wide as the twin's: what one camera alone sees beside it
    outweighs the leaves that the two others see there."""
    vegetation = (Material(0.7, 0.0, "vegetation"),)
    crown = replace(plane_mesh(0.2, 0.1, 1.0), materials=vegetation)
    background = concatenate_meshes([plane_mesh(8.0, 0.1), crown])
    log = _log((), np.zeros(2), (0.03, 0.12, 0.02))
    (mesh,), _ = _bake(log, background, {}, replace(CONFIG, outlier_ratio=1.05))
    points, colour = _texels(mesh)
    x, y = np.abs(points[:, :2]).T
    beside = (points[:, 2] < 0.5) & (x > 0.45) & (x < 0.65) & (y < 0.5)
    assert beside.sum() > 400
    scale = np.exp(np.log(np.array(list(GAINS.values()))).mean(axis=0))
    expected = _pattern(points[beside, :2]) * scale
    np.testing.assert_allclose(colour[beside], expected, rtol=0.05)


def test_ground_beside_a_moving_actor_takes_other_views() -> None:
    """Two images, the car elsewhere in the second; the first shows its shade on the ground."""
    track, lid = _box_track()
    poses = np.stack([track.trajectory.matrices[0]] * 2)
    poses[1, 0, 3] = 3.0
    times = np.array([0, 10**9], dtype=np.int64)
    track = replace(track, trajectory=Trajectory("world", "actor", times, poses))
    camera = PinholeCamera("a", 160, 160, 120.0, 120.0, 80.0, 80.0)
    pose = RigidTransform.from_rotation("world", "camera", DOWN, np.array([0.0, 0.0, 5.0]))
    shaded = np.full((160, 160, 3), 40, np.uint8)
    lit = np.full((160, 160, 3), 60, np.uint8)
    frames = (
        CameraFrame("a", "0", 0, pose, lambda: shaded),
        CameraFrame("a", "1", 10**9, pose, lambda: lit),
    )
    log = replace(_log((track,), None), cameras={"a": camera}, frames=frames)
    config = replace(CONFIG, shade_margin_m=0.6, outlier_ratio=1.01)
    (ground, _), _ = _bake(log, plane_mesh(8.0, 0.1), {"box": lid}, config)
    points, colour = _texels(ground)
    beside = (np.abs(points[:, 0]) < 0.8) & (np.abs(points[:, 1]) < 0.4)
    np.testing.assert_allclose(srgb8_from_linear(colour[beside]), 60, atol=1)


@pytest.mark.parametrize("is_moving", [True, False])
def test_ground_never_seen_without_an_actor_takes_the_colour_around(is_moving: bool) -> None:
    """One image, dark under the car and right beside it. If it stays, the radiance does, too, which
    tells no base colour."""
    track, lid = _box_track()
    track = replace(track, is_moving=is_moving)
    camera = PinholeCamera("a", 160, 160, 120.0, 120.0, 80.0, 80.0)
    pose = RigidTransform.from_rotation("world", "camera", DOWN, np.array([0.0, 0.0, 5.0]))
    image = np.full((160, 160, 3), 60, np.uint8)
    half = track.size_lwh_m[:2] / 2 + 0.2
    dark = (np.abs(np.arange(160) + 0.5 - 80) / 24 < h for h in half)
    image[np.ix_(*dark)] = 20
    frames = (CameraFrame("a", "0", 0, pose, lambda: image),)
    log = replace(_log((track,), None), cameras={"a": camera}, frames=frames)
    (ground, _), _ = _bake(log, plane_mesh(8.0, 0.1), {"box": lid})
    points, colour = _texels(ground)
    under = (np.abs(points[:, :2]) < half - 0.1).all(axis=1)
    assert under.sum() > 100
    if is_moving:
        np.testing.assert_allclose(srgb8_from_linear(colour[under]), 60, atol=3)
    assert ground.confidence is not None
    is_observed = (np.abs(ground.vertices[:, :2]) > half + 0.2).any(axis=1)
    is_inside = (np.abs(ground.vertices[:, :2]) < 2.0).all(axis=1)
    assert (ground.confidence[(np.abs(ground.vertices[:, :2]) < half).all(axis=1)] == 0).all()
    assert (ground.confidence[is_observed & is_inside] == 1).all()


def test_vertex_colour_is_the_local_mean_of_the_texture() -> None:
    plane = plane_mesh(8.0, 0.4)
    (ground,), _ = _bake(_log((), None), plane, {})
    scale = np.exp(np.log(np.array(list(GAINS.values()))).mean(axis=0))
    inner = (np.abs(plane.vertices[:, :2]) < 2).all(axis=1)
    expected = _pattern(plane.vertices[inner, :2]) * scale
    np.testing.assert_allclose(ground.base_colour[inner], expected, rtol=0.03)


def test_texels_are_as_fine_as_the_pixels() -> None:
    """A camera 5 m above with f = 120 px has pixels of 4 cm on the ground."""
    plane = plane_mesh(4.0, 1.0)
    (ground,), _ = _bake(_log((), None), plane, {})
    assert ground.texture is not None
    uv = ground.texture.corner_uv
    resolution = np.abs(uv - np.roll(uv, 1, axis=1)).max(axis=(1, 2))
    assert resolution.min() >= 20
    assert resolution.max() <= 27
    (small,), _ = _bake(_log((), None), plane, {}, replace(CONFIG, max_texels=2000))
    assert small.texture is not None
    assert 1500 < len(texels_of(patches_of(small.texture)).face) <= 2000


def test_a_wrong_image_size_is_named() -> None:
    log = _log((), None)
    camera = replace(log.cameras["a"], width_px=150)
    with pytest.raises(InputError, match=r"a/0.*160x160"):
        _bake(replace(log, cameras={**log.cameras, "a": camera}), plane_mesh(4.0, 1.0), {})


def test_outliers_do_not_enter_the_mean() -> None:
    colours = np.full((1, 5, 3), 100, dtype=np.uint8)
    colours[0, 4] = 230
    codes = np.full((1, 5), weight_code(1.0), np.uint8)
    samples = TexelSamples(colours, codes, np.zeros((1, 5), np.uint16))
    radiance, is_seen = mean_radiance(samples, np.ones((1, 3), np.float32), 1.4)
    assert is_seen.all()
    np.testing.assert_array_equal(srgb8_from_linear(radiance), 100)


def test_weights_survive_as_bytes() -> None:
    weights = np.geomspace(1e-4, 1e4, 50)
    back = np.array([code_weight(weight_code(float(w))) for w in weights])
    np.testing.assert_allclose(back, weights, rtol=0.1)
    assert weight_code(0.0) == 0
    assert code_weight(0) == 0.0


def test_outlines_are_where_depth_jumps_not_where_it_slopes() -> None:
    rows = np.arange(60, dtype=np.float32)[:, None]
    ground = (rows + 5) * 0.002 * np.ones((1, 80), np.float32)
    assert not outlines(ground, 0.05, 2.0).any()
    ground[20:40, 30:50] = 0.2
    found = outlines(ground, 0.05, 2.0)
    assert found[30, 28:33].all()
    assert not found[30, 10:26].any()
    assert not found[30, 36:44].any()


def test_texture_look_up_gives_the_texels() -> None:
    (ground,), _ = _bake(_log((), None), plane_mesh(4.0, 1.0), {})
    texture = ground.texture
    assert isinstance(texture, Texture)
    texels = texels_of(patches_of(texture))
    inside = texels.barycentric.min(axis=1) >= 0
    found = texture.look_up(texels.face[inside], texels.barycentric[inside])
    expected = texture.image.reshape(-1, 3)[texels.pixel[inside]]
    np.testing.assert_allclose(found, expected, atol=1e-4)
