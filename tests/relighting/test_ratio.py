"""Relighting against scenes whose answer is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.relighting.scene import (
    HEIGHT_PX,
    SKY_ROWS,
    WALL_ROWS,
    WIDTH_PX,
    everywhere_lit,
    geometry,
    light,
    shadow_right_of,
    sun_towards,
)

from lightsim.core.buffers import ShadowBuffers
from lightsim.errors import InputError
from lightsim.relighting.physical.ratio import RatioConfig, RelightInputs, relight_physical

OLD_SKY = np.array([0.7, 0.8, 0.95], np.float32)
NEW_SKY = np.array([0.9, 0.5, 0.2], np.float32)
SUN = sun_towards(150.0, 45.0)
OTHER_SUN = sun_towards(200.0, 25.0)


def make_inputs(rng: np.random.Generator, target_visibility: np.ndarray) -> RelightInputs:
    buffers = geometry(rng)
    source = light(buffers, SUN, 0.5, shadow_right_of(70))
    target = light(buffers, OTHER_SUN, 0.3, target_visibility)
    radiance = buffers.base_colour * source.shaded
    radiance[:SKY_ROWS] = OLD_SKY
    matte = np.zeros((HEIGHT_PX, WIDTH_PX), np.float32)
    matte[:SKY_ROWS] = 1.0
    return RelightInputs(
        radiance=radiance,
        is_clipped=np.any(radiance > 1, axis=-1),
        sky_matte=matte,
        buffers=buffers,
        source=source,
        target=target,
        target_sky=np.broadcast_to(NEW_SKY, radiance.shape).copy(),
        source_sun=SUN,
        target_sun=OTHER_SUN,
    )


@pytest.fixture
def inputs(rng: np.random.Generator) -> RelightInputs:
    return make_inputs(rng, everywhere_lit())


def with_target(inputs: RelightInputs, target: ShadowBuffers) -> RelightInputs:
    return replace(inputs, target=target, target_sun=inputs.source_sun)


def test_the_same_sky_gives_the_source_back(inputs: RelightInputs) -> None:
    """Noise, deep shadow, clipping nearby: whatever the image holds."""
    noise = np.random.default_rng(1).normal(0, 0.02, inputs.radiance.shape)
    radiance = np.clip(inputs.radiance + noise, 0, 1).astype(np.float32)
    same = with_target(replace(inputs, radiance=radiance), inputs.source)
    relit = relight_physical(same, RatioConfig())
    keeps = ~same.is_clipped & (same.sky_matte == 0)
    np.testing.assert_allclose(relit[keeps], radiance[keeps], atol=1e-4)


def test_lambert_scene_under_another_sun_is_exact(inputs: RelightInputs) -> None:
    wanted = inputs.buffers.base_colour * inputs.target.shaded
    relit = relight_physical(inputs, RatioConfig(are_shadows_refined=False, darkest_fraction=0.0))
    ground = np.s_[SKY_ROWS:]
    # But for single pixels at corners of upright surfaces, where medians are taken.
    is_exact = np.isclose(relit[ground], wanted[ground], rtol=2e-3, atol=0).all(axis=-1)
    assert is_exact.mean() > 0.999


def test_a_kerb_is_lit_as_a_kerb(rng: np.random.Generator) -> None:
    """Three rows of upright surface amid level ground, thinner than what the median over reliefs
    leaves, in the sun before and away from it now."""
    kerb, away = np.s_[70:73], sun_towards(30.0, 45.0)
    level = geometry(rng)
    normal = level.normal_world.copy()
    normal[kerb] = [-1.0, 0.0, 0.0]
    buffers = replace(level, normal_world=normal)
    source, target = (light(buffers, sun, 0.3, everywhere_lit()) for sun in (SUN, away))
    inputs = replace(
        make_inputs(rng, everywhere_lit()),
        radiance=buffers.base_colour * source.shaded,
        buffers=replace(buffers, base_colour=np.full_like(buffers.base_colour, 0.35)),
        source=source,
        target=target,
        target_sun=away,
        picture_width_px=480,
    )
    wanted = buffers.base_colour * target.shaded
    relit = relight_physical(inputs, RatioConfig(are_shadows_refined=False))
    error = np.abs(np.log(relit[kerb] / wanted[kerb]))
    assert np.median(error) < 0.14


def test_details_that_the_base_colour_lacks_survive(inputs: RelightInputs) -> None:
    """The base colour is flat grey, the picture has the texture."""
    flat = np.full_like(inputs.radiance, 0.35)
    blind = replace(inputs, buffers=replace(inputs.buffers, base_colour=flat))
    wanted = inputs.buffers.base_colour * inputs.target.shaded
    relit = relight_physical(blind, RatioConfig(are_shadows_refined=False))
    error = np.abs(relit - wanted)[SKY_ROWS:].mean()
    assert error < 0.2 * np.abs(flat * inputs.target.shaded - wanted)[SKY_ROWS:].mean()


def test_sky_is_replaced_behind_a_soft_matte(inputs: RelightInputs) -> None:
    """A half covered row holds half of the new sky and nothing of the old one."""
    black = np.zeros_like(inputs.radiance)
    matte = inputs.sky_matte.copy()
    matte[SKY_ROWS] = 0.5
    black[:SKY_ROWS] = OLD_SKY
    black[SKY_ROWS] = 0.5 * OLD_SKY
    relit = relight_physical(
        replace(inputs, radiance=black, sky_matte=matte),
        RatioConfig(are_shadows_refined=False, base_colour_deviation=1e3),
    )
    np.testing.assert_allclose(relit[:SKY_ROWS], inputs.target_sky[:SKY_ROWS], atol=1e-6)
    np.testing.assert_allclose(relit[SKY_ROWS], 0.5 * inputs.target_sky[SKY_ROWS], atol=5e-3)


def test_deep_shadow_and_clipping_stay_finite(inputs: RelightInputs) -> None:
    dark = {name: np.zeros_like(inputs.source.sky) for name in ("direct_sun", "sky", "shaded")}
    hidden = replace(
        inputs.source, sun_visibility=np.zeros_like(inputs.source.sun_visibility), **dark
    )
    black = np.zeros_like(inputs.radiance)
    clipped = np.ones_like(inputs.is_clipped)
    for case in (
        replace(inputs, source=hidden),
        replace(inputs, source=hidden, radiance=black),
        replace(inputs, is_clipped=clipped),
        replace(inputs, target=hidden),
        replace(inputs, sky_matte=np.ones_like(inputs.sky_matte)),
        replace(inputs, sky_matte=np.full_like(inputs.sky_matte, 0.5)),
    ):
        relit = relight_physical(case, RatioConfig())
        assert np.isfinite(relit).all()
        assert relit.min() >= 0
        assert relit.max() < 10


def test_a_mesh_of_another_colour_leaves_no_stain(inputs: RelightInputs) -> None:
    """A crown's mesh ends on the wall beside it, and the light turns warm: each channel weighed for
    itself, green alone was left."""
    factors = np.array([1.5, 1.0, 0.5], np.float32)
    warm = {n: getattr(inputs.source, n) * factors for n in ("direct_sun", "sky", "shaded")}
    base_colour = inputs.buffers.base_colour.copy()
    block = np.s_[40:70, 20:60]
    base_colour[block] = (0.05, 0.06, 0.02)
    case = replace(
        inputs,
        target=replace(inputs.source, **warm),
        target_sun=inputs.source_sun,
        buffers=replace(inputs.buffers, base_colour=base_colour),
    )
    relit = relight_physical(case, RatioConfig(are_shadows_refined=False))
    wanted = inputs.radiance * factors
    off = np.log(np.maximum(relit[block], 1e-3) / wanted[block])
    hue = off - off.mean(axis=-1, keepdims=True)
    assert np.abs(hue).mean() < 0.014
    assert np.abs(off).mean() < 0.19


def test_clipped_pixels_take_the_base_colour(inputs: RelightInputs) -> None:
    """Over-exposed twice: the recorded value is only a lower bound."""
    radiance = np.minimum(inputs.radiance, 0.25)
    clipped = (inputs.radiance >= 0.25).any(axis=-1) & (inputs.sky_matte == 0)
    relit = relight_physical(replace(inputs, radiance=radiance, is_clipped=clipped), RatioConfig())
    naive = relight_physical(
        replace(inputs, radiance=radiance, is_clipped=np.zeros_like(clipped)), RatioConfig()
    )
    wanted = inputs.buffers.base_colour * inputs.target.shaded
    error, naive_error = (np.abs(x - wanted)[clipped].mean() for x in (relit, naive))
    assert error < 0.48 * naive_error


def test_pixels_without_a_mesh_follow_their_surroundings(inputs: RelightInputs) -> None:
    depth = inputs.buffers.depth_z_m.copy()
    depth[60:70, 20:30] = np.inf
    holed = replace(inputs, buffers=replace(inputs.buffers, depth_z_m=depth))
    relit = relight_physical(holed, RatioConfig(are_shadows_refined=False))
    wanted = inputs.buffers.base_colour * inputs.target.shaded
    hole = np.s_[60:70, 20:30]
    np.testing.assert_allclose(relit[hole], wanted[hole], rtol=0.007)


@pytest.mark.parametrize("are_shadows_refined", [False, True])
def test_a_hole_into_a_sealed_room_follows_its_surroundings(
    inputs: RelightInputs, are_shadows_refined: bool
) -> None:
    """The mesh has a gap, and what stands behind it sees neither sky nor sun; refined shadows may
    hold that it sees the sun, since the picture is bright there."""
    sealed = np.ones((HEIGHT_PX, WIDTH_PX, 1), np.float32)
    sealed[60:70, 50:54] = 0
    dark = [
        replace(
            light,
            shaded=light.shaded * sealed,
            sky=light.sky * sealed,
            direct_sun=light.direct_sun * sealed,
            sun_visibility=light.sun_visibility * sealed[..., 0],
        )
        for light in (inputs.source, inputs.target)
    ]
    holed = replace(inputs, source=dark[0], target=dark[1])
    config = RatioConfig(are_shadows_refined=are_shadows_refined)
    whole, relit = (relight_physical(x, config)[60:70, 50:54] for x in (inputs, holed))
    np.testing.assert_allclose(relit, whole, rtol=0.002)


def test_inputs_of_unequal_size_are_named(inputs: RelightInputs) -> None:
    small = geometry(np.random.default_rng(0))
    small = replace(small, **{k: v[:4, :4] for k, v in vars(small).items() if v is not None})
    with pytest.raises(InputError, match="buffers"):
        replace(inputs, buffers=small)


def test_reflections_are_exchanged_and_the_source_comes_back(rng: np.random.Generator) -> None:
    """A road that shines against the source's sun, under a sky that it reflects elsewhere."""
    buffers = geometry(rng)
    source, target = (light(buffers, None, sky, everywhere_lit()) for sky in (1.0, 0.6))
    surface = buffers.has_surface[..., None]
    across = np.linspace(0.0, 1.0, WIDTH_PX)[None, :, None]
    shine = [surface * np.broadcast_to(most * across, source.shaded.shape) for most in (0.2, 0.3)]
    source, target = (
        replace(one, glossy=glossy.astype(np.float32), glossy_sun=np.zeros_like(one.shaded))
        for one, glossy in zip((source, target), shine, strict=True)
    )
    picture = buffers.base_colour * source.shaded + source.reflected
    wanted = buffers.base_colour * target.shaded + target.reflected
    nothing = np.zeros_like(picture)
    size = picture.shape[:2]
    inputs = RelightInputs(
        picture, np.zeros(size, bool), (~buffers.has_surface).astype(np.float32), buffers,
        source, target, nothing,
    )  # fmt: skip
    inside = buffers.has_surface
    # Up to where more is reflected than a picture is believed to hold.
    is_held = (source.reflected < 0.7 * picture).all(axis=-1) & inside
    np.testing.assert_allclose(
        relight_physical(inputs, RatioConfig())[is_held], wanted[is_held], rtol=0.02, atol=2e-3
    )
    same = relight_physical(replace(inputs, target=source), RatioConfig())
    np.testing.assert_allclose(same[inside], picture[inside], rtol=1e-4)


def test_a_posts_shadow_on_a_road_that_mirrors_the_sun_leaves_nothing(
    rng: np.random.Generator,
) -> None:
    """Beside it the sheen is a good part of the picture, in it there is none."""
    buffers = geometry(rng)
    visibility = everywhere_lit()
    visibility[:, 60:62] = 0.0
    source = light(buffers, SUN, 0.5, visibility)
    target = light(buffers, None, 0.8, everywhere_lit())
    ground = (np.arange(HEIGHT_PX) >= WALL_ROWS)[:, None, None]
    sheen = (0.4 * ground * np.ones_like(source.shaded)).astype(np.float32)
    glossy = (source.sun_visibility[..., None] * sheen).astype(np.float32)
    source = replace(source, glossy=glossy, glossy_sun=sheen)
    picture = (buffers.base_colour * source.shaded + glossy).astype(np.float32)
    inputs = RelightInputs(
        picture, np.zeros(picture.shape[:2], bool), (~buffers.has_surface).astype(np.float32),
        buffers, source, target, np.zeros_like(picture), source_sun=SUN,
        found_visibility=source.sun_visibility, picture_width_px=480,
    )  # fmt: skip
    relit, wanted = relight_physical(inputs, RatioConfig()), buffers.base_colour * target.shaded
    shadow = np.s_[WALL_ROWS + 8 : HEIGHT_PX - 8, 60:62]
    beside = np.s_[WALL_ROWS + 8 : HEIGHT_PX - 8, 50:54]
    error = [float(np.median(relit[part] / wanted[part])) for part in (shadow, beside)]
    assert error[1] == pytest.approx(1.0, abs=1e-3)
    # Median details that meshes guess took the sheen out of the shadow, too, and left .27.
    assert error[0] > 0.94


def test_the_visibility_that_all_pictures_show_takes_the_rendered_ones_place(
    inputs: RelightInputs,
) -> None:
    """Rendered without its shadow, the source leaves a dark ghost on a surface whose patterns one
    picture cannot tell from light; the found one does not. Where nothing was found, the rendering
    holds."""
    sunny = light(inputs.buffers, SUN, 0.5, everywhere_lit())
    rows, columns = np.indices(inputs.is_clipped.shape) // 6
    pattern = np.exp(0.5 - (rows + columns) % 2)[..., None].astype(np.float32)
    inputs = replace(inputs, radiance=inputs.radiance * pattern)
    wanted = inputs.buffers.base_colour * inputs.target.shaded * pattern
    found = shadow_right_of(70)
    found[:, :40] = np.nan
    shaded = np.s_[WALL_ROWS:, 75:]
    errors = []
    for assumed in (found, None):
        wrong = replace(inputs, source=sunny, found_visibility=assumed)
        relit = relight_physical(wrong, RatioConfig(darkest_fraction=0.0))
        errors.append(np.abs(np.log(relit[shaded] / wanted[shaded])).mean())
        # Filters spread some of the pattern's light beyond its squares.
        np.testing.assert_allclose(relit[WALL_ROWS:, :60], wanted[WALL_ROWS:, :60], rtol=0.085)
    assert errors[0] < 0.08
    assert errors[1] > 6 * errors[0]
