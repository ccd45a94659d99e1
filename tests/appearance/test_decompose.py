"""Shadows taken out of the base colour, where the rendered ones lie wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from lightsim.appearance.atlas import choose_resolution, edge_lengths_m, pack, texels_of
from lightsim.appearance.intrinsic import reflectance
from lightsim.appearance.intrinsic.balance import balance_light
from lightsim.appearance.intrinsic.decompose import (
    IntrinsicConfig,
    SurfaceLight,
    decompose,
    mesh_surfels,
)
from lightsim.appearance.intrinsic.light import LightAt, LightBalance, ObservedPoints, Reflections
from lightsim.core.mesh import Texture, TriMesh
from lightsim.core.twin import LightPrior
from lightsim.errors import InputError

_SUN = np.array([1.0, 0.9, 0.7])
_SKY = np.array([0.15, 0.2, 0.3])


def _ground(cells: int = 160, half_m: float = 10.0) -> TriMesh:
    line = np.linspace(-half_m, half_m, cells + 1)
    x, y = np.meshgrid(line, line)
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    up = i + cells + 1
    faces = np.concatenate([np.stack([i, i + 1, up], 1), np.stack([i + 1, up + 1, up], 1)])
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    return TriMesh("world", vertices, faces.astype(np.int32), np.full_like(vertices, 0.5))


def _is_lit(points: np.ndarray, shift_m: float = 0.0) -> np.ndarray:
    """A house's shadow, a lamp's, and one of something that no rendering knows."""
    x, y = points[:, 0] - shift_m, points[:, 1]
    house = y > 3 + np.sin(x)
    pole = (np.abs(x + 4) < 0.5) & (y < 0)
    return ~(house | pole)


def _unknown_shadow(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, :2] - [4, -5], axis=1) < 1.8


def _albedo(points: np.ndarray) -> np.ndarray:
    """Asphalt, a strip of paint, and a light pavement."""
    x, y = points[:, 0], points[:, 1]
    grey = np.where(y < -8, 0.35, 0.12) * (1 + 0.05 * np.sin(9 * x) * np.cos(7 * y))
    return np.where((np.abs(y - 1.0) < 0.15), 0.55, grey)


def _light(points: np.ndarray, visibility: np.ndarray, sun: float) -> SurfaceLight:
    def repeat(rgb: np.ndarray) -> np.ndarray:
        return np.broadcast_to(rgb.astype(np.float32), (len(points), 3)).copy()

    both = np.stack([visibility, visibility], axis=1).astype(np.float32)
    none = np.zeros((len(points), 3), np.float32)
    return SurfaceLight(repeat(sun * _SUN), both, repeat(_SKY), none, none)


def _all_shadows(points: np.ndarray) -> np.ndarray:
    return _is_lit(points) & ~_unknown_shadow(points)


def _everywhere(points: np.ndarray) -> np.ndarray:
    return np.ones(len(points))


def _under(sun: float, is_lit: Callable[[np.ndarray], np.ndarray]) -> LightAt:
    """Light of a sun of some strength, where it is seen."""
    return lambda seen: _light(seen.position, is_lit(seen.position), sun)


def _recorded(sun: float) -> tuple[TriMesh, np.ndarray, np.ndarray]:
    """The ground as cameras saw it; true visibility and base colour."""
    mesh = _ground()
    lit = (_is_lit(mesh.vertices) & ~_unknown_shadow(mesh.vertices)).astype(float)
    albedo = _albedo(mesh.vertices)
    noise = np.exp(0.03 * np.random.default_rng(1).normal(size=(len(albedo), 1)))
    radiance = albedo[:, None] * (_SKY + sun * lit[:, None] * _SUN) * noise
    return replace(mesh, base_colour=radiance.astype(np.float32)), lit, albedo


def _ratio(mesh: TriMesh, lit: np.ndarray, albedo: np.ndarray) -> float:
    error = np.log(mesh.base_colour / albedo[:, None]).mean(axis=1)
    return float(np.exp(error[lit > 0.5].mean() - error[lit < 0.5].mean()))


def _light_prior(sun: float = 1.0, unseen: float = 0.0, cloud: float = 0.0) -> LightPrior:
    return LightPrior(np.zeros((2, 4), np.float32), unseen, 0.0, sun, cloud)


_NO_PATH = np.zeros((0, 3))


def _balance(
    mesh: TriMesh, light_at: LightAt, light_prior: LightPrior, path: np.ndarray = _NO_PATH
) -> LightBalance:
    rng = np.random.default_rng(0)
    patches = mesh_surfels(mesh, IntrinsicConfig(), rng)
    assert patches is not None
    return balance_light(patches.with_light(light_at), light_prior, path, IntrinsicConfig())


def _balanced(light_at: LightAt, balance: LightBalance) -> LightAt:
    return lambda seen: light_at(seen).balanced(balance)


def test_division_by_the_right_light_leaves_the_base_colour():
    mesh, lit, albedo = _recorded(sun=1.0)

    light_at = _under(1.0, _all_shadows)
    done = decompose(mesh, light_at, IntrinsicConfig(method="divide"), np.random.default_rng(0))
    assert _ratio(done.mesh, lit, albedo) == pytest.approx(1.0, abs=1e-3)
    error = np.log(done.mesh.base_colour / albedo[:, None])
    assert np.abs(np.median(error)) < 1e-3
    assert error.std() < 0.034  # The noise of the recording is 0.03.


def test_shadows_vanish_though_rendered_ones_lie_elsewhere_and_the_sun_is_too_strong():
    mesh, lit, albedo = _recorded(sun=1.0)

    light_at = _under(2.2, partial(_is_lit, shift_m=0.4))
    balance = _balance(mesh, light_at, _light_prior())
    np.testing.assert_allclose(balance.sun, 1 / 2.2, rtol=0.02)
    np.testing.assert_allclose(balance.unseen_sky, 1.0, rtol=2e-3)
    done = decompose(
        mesh, _balanced(light_at, balance), IntrinsicConfig(), np.random.default_rng(0)
    )
    assert abs(np.log(_ratio(done.mesh, lit, albedo))) < np.log(1.012)
    assert ((done.visibility > 0.5) == (lit > 0.5)).mean() > 0.999
    paint = albedo > 0.5
    assert np.median(done.mesh.base_colour[paint]) == pytest.approx(0.55, rel=0.02)
    assert np.median(done.mesh.base_colour[albedo < 0.2]) == pytest.approx(0.12, rel=0.01)


def test_the_reflectance_of_the_pavement_tells_the_unseen_sky(monkeypatch: pytest.MonkeyPatch):
    """Half of the sky was seen, the rest is brighter than the estimate by 2. Shadows tell the sun
    against the sky; only a known base colour tells the level of both."""
    sure = replace(reflectance.PAVEMENT, median=0.12, log_std=0.03)
    monkeypatch.setattr(reflectance, "PAVEMENT", sure)
    true_sky, dark = 1.5 * _SKY, _SKY
    mesh = _ground()
    lit = (_is_lit(mesh.vertices)).astype(float)
    albedo = _albedo(mesh.vertices)
    radiance = albedo[:, None] * (true_sky + lit[:, None] * _SUN)
    mesh = replace(mesh, base_colour=radiance.astype(np.float32))

    def light_at(seen: ObservedPoints) -> SurfaceLight:
        points = seen.position
        light = _light(points, _is_lit(points), sun=1.0)
        return replace(light, unseen_sky=np.full_like(light.sky, 0.5) * light.sky)

    sure_sky = _balance(mesh, light_at, _light_prior(sun=1.0, unseen=0.01))
    np.testing.assert_allclose(sure_sky.sun, dark / true_sky, rtol=0.012)
    np.testing.assert_allclose(sure_sky.unseen_sky, 1.0, rtol=1e-3)
    path = np.stack([np.linspace(-9, 9, 10), np.full(10, 0.5), np.full(10, 1.6)], axis=1)
    known = _balance(mesh, light_at, _light_prior(sun=1.0, unseen=1.0), path)
    # Pavement is known to 3 %, its level and the estimate share the rest.
    np.testing.assert_allclose(known.unseen_sky, 2.0, rtol=0.14)
    np.testing.assert_allclose(known.sun, 1.0, rtol=0.08)
    open_sky = _balance(mesh, light_at, _light_prior(sun=1.0, unseen=1.0))
    assert known.unseen_sky_log_std < 0.3 * open_sky.unseen_sky_log_std


def test_what_nobody_saw_takes_base_colour_and_not_light_from_around():
    """A hole across the edge of the house's shadow; what was filled in there is as bright as the
    sunlit ground."""
    mesh, _, albedo = _recorded(sun=1.0)
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    hole = (np.abs(x) < 1.5) & (np.abs(y - 3.5) < 1.5)
    colour = np.where(hole[:, None], np.float32(0.13), mesh.base_colour)
    seen = replace(mesh, base_colour=colour, confidence=(~hole).astype(np.float32))

    light_at = _under(1.0, _is_lit)
    done = decompose(seen, light_at, IntrinsicConfig(), np.random.default_rng(0))
    inner = hole & (np.abs(x) < 1.2) & (np.abs(y - 3.5) < 1.2)
    np.testing.assert_allclose(done.mesh.base_colour[inner].mean(axis=1), albedo[inner], rtol=0.06)
    lit = _is_lit(mesh.vertices)
    np.testing.assert_array_equal(done.visibility[inner] > 0.5, lit[inner])


def test_few_pairs_leave_the_prior():
    mesh = _ground(cells=40, half_m=1.0)
    balance = _balance(mesh, _under(1.0, _everywhere), _light_prior(sun=0.3))
    assert balance.pair_count == 0
    np.testing.assert_allclose(balance.sun, 1.0, rtol=1e-6)
    np.testing.assert_allclose(balance.unseen_sky, 1.0, rtol=1e-6)
    assert balance.sun_log_std == pytest.approx(0.3, rel=0.015)


def test_without_hard_shadows_none_are_invented():
    """A veiled sun: the rendered light has shadows, the pictures have none."""
    mesh = _ground()
    albedo = _albedo(mesh.vertices)
    mesh = replace(mesh, base_colour=(albedo[:, None] * _SKY * 1.5).astype(np.float32))

    light_at = _under(0.5, _is_lit)
    # The sun was read with some certainty, but there may be cloud before it.
    balance = _balance(mesh, light_at, _light_prior(sun=0.16, cloud=0.3))
    assert (balance.sun < 0.1).all()
    done = decompose(
        mesh, _balanced(light_at, balance), IntrinsicConfig(), np.random.default_rng(0)
    )
    lit = _is_lit(mesh.vertices).astype(float)
    assert abs(np.log(_ratio(done.mesh, lit, albedo))) < np.log(1.05)


@pytest.mark.parametrize("cloud", [0.8, 0.99])
def test_bright_patches_behind_cloud_are_no_sun(cloud: float):
    """Labels that follow the pictures call bright patches lit, and their pairs asked for a sun of
    the sky's colour, three times as blue as the clear one; once again as soon as cloud was a little
    less than certain."""
    mesh = _ground()
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    blobs = np.sin(0.8 * x + 1) * np.cos(y) + 0.5 * np.sin(1.7 * y + x)
    albedo = _albedo(mesh.vertices) * np.exp(0.3 * np.sign(blobs))
    mesh = replace(mesh, base_colour=(albedo[:, None] * _SKY).astype(np.float32))

    light_at = _under(0.5, _is_lit)
    balance = _balance(mesh, light_at, _light_prior(sun=0.5, cloud=cloud))
    assert balance.pair_count == 0
    assert balance.sun[2] < 1.5 * balance.sun[0]
    assert balance.sun[1] < 0.22


def test_broken_light_is_refused():
    mesh = _ground(cells=4)
    points = mesh.vertices[:-1].astype(np.float64)
    short = _light(points, np.ones(len(points)), 1.0)
    with pytest.raises(InputError, match="every vertex"):
        decompose(mesh, lambda _: short, IntrinsicConfig(), np.random.default_rng(0))
    with pytest.raises(InputError, match="negative"):
        replace(short, sky=-short.sky)


def _textured(
    mesh: TriMesh, texel_m: float, is_lit: Callable[[np.ndarray], np.ndarray] = _all_shadows
) -> tuple[TriMesh, np.ndarray, np.ndarray]:
    """The mesh with a radiance texture; where its texels lie, and their pixels."""
    edges = edge_lengths_m(mesh.vertices, mesh.faces)
    seen = np.full(len(mesh.faces), texel_m, np.float32)
    patches = pack(choose_resolution(edges, seen, texel_m, 64, 1 << 20), edges)
    texels = texels_of(patches)
    corners = mesh.vertices[mesh.faces[texels.face]]
    points = (texels.barycentric[:, :, None] * corners).sum(axis=1)
    lit = is_lit(points).astype(float)
    radiance = _albedo(points)[:, None] * (_SKY + lit[:, None] * _SUN)
    image = np.zeros((patches.height_px * patches.width_px, 3), np.float32)
    image[texels.pixel] = radiance
    image = image.reshape(patches.height_px, patches.width_px, 3)
    textured = replace(mesh, texture=Texture(image, patches.corner_uv()))
    return textured, points, texels.pixel


def test_a_texture_loses_its_shadows_texel_by_texel_on_coarse_faces():
    mesh = _ground(cells=25)
    lit = (_is_lit(mesh.vertices) & ~_unknown_shadow(mesh.vertices)).astype(float)
    radiance = _albedo(mesh.vertices)[:, None] * (_SKY + lit[:, None] * _SUN)
    mesh, points, pixel = _textured(replace(mesh, base_colour=radiance.astype(np.float32)), 0.1)

    light_at = _under(1.0, partial(_is_lit, shift_m=0.4))
    done = decompose(mesh, light_at, IntrinsicConfig(), np.random.default_rng(0)).mesh
    assert done.texture is not None
    assert mesh.texture is not None
    assert done.texture.image.shape == mesh.texture.image.shape
    colour = done.texture.image.reshape(-1, 3)[pixel]
    error = np.abs(np.log(colour / _albedo(points)[:, None])).mean(axis=1)
    assert np.median(error) < 1e-6
    assert (error > np.log(1.5)).mean() < 1e-3
    assert done.sun_visibility is not None
    assert done.sun_visibility.texel is not None
    found = done.sun_visibility.texel.reshape(-1)[pixel] > 127
    assert (found == (_is_lit(points) & ~_unknown_shadow(points))).mean() > 0.9995
    assert done.confidence is not None
    assert np.median(done.confidence) == 1.0


def test_a_post_narrower_than_patches_leaves_no_shadow_in_the_texture():
    """Labels of patches average a shadow of 12 cm away: it was dark base colour under any sun."""

    def is_lit(points: np.ndarray, shift_m: float = 0.0) -> np.ndarray:
        return np.abs(points[:, 0] - shift_m - 0.3 * points[:, 1]) > 0.06

    mesh = _ground(cells=100)
    radiance = _albedo(mesh.vertices)[:, None] * (_SKY + is_lit(mesh.vertices)[:, None] * _SUN)
    mesh = replace(mesh, base_colour=radiance.astype(np.float32))
    mesh, points, pixel = _textured(mesh, 0.05, is_lit)

    light_at = _under(1.0, partial(is_lit, shift_m=0.15))
    done = decompose(mesh, light_at, IntrinsicConfig(), np.random.default_rng(0)).mesh
    assert done.texture is not None
    colour = done.texture.image.reshape(-1, 3)[pixel]
    error = np.log(colour / _albedo(points)[:, None]).mean(axis=1)
    is_dark = ~is_lit(points)
    assert np.abs(np.median(error[is_dark])) < 1e-6
    # Texels on the edge are both.
    assert (error[is_dark] < -0.5).mean() < 0.07
    assert (np.abs(error[~is_dark]) > 0.4).mean() < 1e-3


def test_what_surfaces_reflect_is_no_base_colour():
    """A road seen against the light: half of what cameras saw of it in the shade is reflected. The
    sun and the base colour come out as if nothing shone, and shadows vanish."""
    mesh, lit, albedo = _recorded(sun=1.0)
    shine, sunny = 0.08 * _SKY, 0.03 * _SUN
    seen = mesh.base_colour + shine + lit[:, None] * sunny
    mesh = replace(mesh, base_colour=seen.astype(np.float32))

    def light_at(seen: ObservedPoints) -> SurfaceLight:
        found = _light(seen.position, _is_lit(seen.position, shift_m=0.2), sun=1.5)
        shape = found.sun.shape
        reflected = Reflections(
            *(
                np.broadcast_to(rgb.astype(np.float32), shape).copy()
                for rgb in (shine, 0 * shine, 1.5 * sunny)
            )
        )
        return replace(found, reflected=reflected)

    balance = _balance(mesh, light_at, _light_prior())
    np.testing.assert_allclose(balance.sun, 1 / 1.5, rtol=0.03)
    done = decompose(
        mesh, _balanced(light_at, balance), IntrinsicConfig(), np.random.default_rng(0)
    )
    assert abs(np.log(_ratio(done.mesh, lit, albedo))) < np.log(1.02)
    assert np.median(done.mesh.base_colour[albedo < 0.2] / 0.12) == pytest.approx(1.0, abs=0.015)
    blind = decompose(
        mesh,
        lambda points: replace(light_at(points).balanced(balance), reflected=None),
        IntrinsicConfig(),
        np.random.default_rng(0),
    )
    assert np.median(blind.mesh.base_colour[albedo < 0.2] / 0.12) > 1.3


def test_dark_panes_amid_light_stay_dark():
    mesh = _ground()
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    is_pane = (np.abs((x % 3.0) - 1.5) < 0.6) & (np.abs((y % 3.0) - 1.5) < 0.7)
    albedo = np.where(is_pane, 0.05, 0.3)
    noise = np.exp(0.03 * np.random.default_rng(1).normal(size=(len(albedo), 1)))
    radiance = (albedo[:, None] * (_SKY + 4.0 * _SUN) * noise).astype(np.float32)

    light_at = _under(4.0, _everywhere)
    recorded = replace(mesh, base_colour=radiance)
    done = decompose(recorded, light_at, IntrinsicConfig(), np.random.default_rng(0))
    assert np.quantile(done.visibility[is_pane], 0.05) == 1.0
    assert np.median(done.mesh.base_colour[is_pane]) == pytest.approx(0.05, rel=0.01)


def test_shaded_pavement_is_no_dark_asphalt_in_the_sun():
    mesh = _ground()
    rng = np.random.default_rng(1)
    noise = np.exp(0.03 * rng.normal(size=(len(mesh.vertices), 1)))
    recorded = replace(mesh, base_colour=(0.13 * _SKY * noise).astype(np.float32))
    path = np.stack([np.linspace(-9, 9, 40), np.zeros(40), np.full(40, 1.8)], axis=1)

    light_at = _under(5.0, _everywhere)
    done = decompose(recorded, light_at, IntrinsicConfig(), rng, path_world=path)
    assert np.median(done.mesh.base_colour @ np.full(3, 1 / 3)) == pytest.approx(0.13, rel=1e-3)


def test_light_of_patches_is_asked_for_above_a_bent_surface():
    flat = _ground(cells=400, half_m=5.0)
    x = flat.vertices[:, 0]
    height = (0.04 * np.sin(x * 2 * np.pi / 0.4)).astype(np.float32)
    mesh = replace(flat, vertices=flat.vertices + height[:, None] * np.array([0, 0, 1], np.float32))
    heights: list[np.ndarray] = []

    def light_at(seen: ObservedPoints) -> SurfaceLight:
        surface = 0.04 * np.sin(seen.position[:, 0] * 2 * np.pi / 0.4)
        heights.append(seen.position[:, 2] - surface)
        return _light(seen.position, np.ones(len(seen.position)), sun=1.0)

    patches = mesh_surfels(mesh, IntrinsicConfig(), np.random.default_rng(0))
    assert patches is not None
    patches.with_light(light_at)
    assert (heights[0] > 0).all()
