"""Streets by Cycles against Mitsuba. Needs an interpreter with bpy (LIGHTSIM_BLENDER_PYTHON)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from jaxtyping import Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun
from lightsim.core.frames import RigidTransform
from lightsim.errors import MissingDependencyError
from lightsim.render.reference.blender import find_bpy
from lightsim_lab.synthetic.cycles_tracer import CyclesTracer
from lightsim_lab.synthetic.shapes import Part, box, rectangle
from lightsim_lab.synthetic.textures import Finish, constant
from lightsim_lab.synthetic.tracer import PathTracer
from lightsim_lab.synthetic.tracing import Placed, StreetTracer

_ALBEDO = 0.5
_SKY = 0.4
# A pixel is 0.25 m on the ground; the principal point is not in the middle.
_CAMERA = PinholeCamera("above", 32, 24, 40.0, 40.0, 17.0, 10.0)
_MARGIN_PX = (1, -2)
_HEIGHT_M = 10.0
_SUN = Sun(np.array([0.6, 0.0, 0.8]), np.array([3.0, 2.5, 2.0], np.float32))
# Camera's x is the world's x, and its y (down) the world's -y.
_POSE = RigidTransform.from_rotation(
    "world", "above", np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, _HEIGHT_M])
)
_FLOOR = rectangle("grey", (-20.0, -20.0, 0.0), (40.0, 0, 0), (0, 40.0, 0))
_BOX = box("grey", (-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))


def needs_blender() -> None:
    try:
        find_bpy()
    except MissingDependencyError as error:
        pytest.skip(f"no Blender: {error}")


def grey() -> dict[str, Finish]:
    """Return a dull finish without a specular lobe."""
    base_colour = np.full((2, 2, 3), _ALBEDO, dtype=np.float32)
    return {"grey": Finish(base_colour, (1.0, 1.0), constant(1.0), specular=0.0)}


def checked() -> dict[str, Finish]:
    """Return a texture of 4 x 3 m without symmetry: each of its 4 x 3 texels has another colour."""
    steps = np.linspace(0.1, 0.8, 12, dtype=np.float32).reshape(3, 4)
    base_colour = np.stack([steps, 0.9 - steps, np.full_like(steps, 0.3)], axis=-1)
    return {"grey": Finish(base_colour, (4.0, 3.0), constant(1.0), specular=0.0)}


def rendered(
    kind: type[CyclesTracer] | type[PathTracer],
    finishes: dict[str, Finish],
    sun: Sun | None,
    positions: Sequence[Sequence[float]] = (),
    samples: int = 96,
) -> list[Float32[np.ndarray, "h w 3"]]:
    """Return images of a floor, with a box of 1 m at each of some positions."""
    actors = [Placed("actor", (_BOX,))] if positions else []
    sky = np.full((16, 32, 3), _SKY, dtype=np.float32)
    floor: list[Part] = [_FLOOR]
    tracer: StreetTracer = kind(floor, actors, finishes, sky, sun)
    images = []
    for position in positions or ((),):
        if len(position):
            pose = RigidTransform.from_rotation("world", "actor", np.eye(3), np.array(position))
            tracer.place({"actor": pose})
        images.append(tracer.render(_CAMERA, _MARGIN_PX, _POSE, samples, 1))
    return images


def pixel(x_m: float, y_m: float) -> tuple[int, int]:
    """Return row and column of a point of the ground."""
    camera = _CAMERA
    column = camera.cx + camera.fx * x_m / _HEIGHT_M
    return int(camera.cy - camera.fy * y_m / _HEIGHT_M), int(column)


@pytest.mark.slow
@pytest.mark.blender
@pytest.mark.parametrize("kind", [CyclesTracer, PathTracer])
def test_light_on_a_matt_plane_is_that_of_the_formula(
    kind: type[CyclesTracer] | type[PathTracer],
) -> None:
    if kind is CyclesTracer:
        needs_blender()
    (under_sky,) = rendered(kind, grey(), None)
    (lit,) = rendered(kind, grey(), _SUN)
    # Burley's diffuse lobe is brighter than Lambert's at grazing light, and Blender's is Lambert's.
    tolerance = 0.01 if kind is CyclesTracer else 0.08
    assert under_sky.mean() == pytest.approx(_ALBEDO * _SKY, rel=tolerance)
    expected = _ALBEDO * (_SKY + _SUN.irradiance * _SUN.direction_world[2] / np.pi)
    np.testing.assert_allclose(lit.mean(axis=(0, 1)), expected, rtol=tolerance)


@pytest.mark.slow
@pytest.mark.blender
def test_both_renderers_agree_in_light_and_shadow_and_actors_move() -> None:
    needs_blender()
    # Boxes 1.5 m above the ground, with the shadow beside them.
    positions = ((1.0, 0.0, 2.0), (1.0, 1.0, 2.0))
    ours = rendered(CyclesTracer, grey(), _SUN, positions)
    theirs = rendered(PathTracer, grey(), _SUN, positions)
    for (_, y, z), a, b in zip(positions, ours, theirs, strict=True):
        # The sun is in direction +x: the shadow is displaced towards -x.
        row, column = pixel(1.0 - z * 0.75, y)
        shadow = (slice(row - 1, row + 1), slice(column - 1, column + 1))
        lit = (slice(18, 24), slice(0, 32))
        assert a[shadow].mean() < 0.5 * a[lit].mean()
        for region in (shadow, lit):
            assert a[region].mean() == pytest.approx(b[region].mean(), rel=0.08)
    change = np.abs(ours[0] - ours[1]).mean(axis=2)
    assert change.max() > 0.2
    # An unmoved part of the picture differs by the noise alone, which has the same seed.
    assert change[18:].max() < 0.02


@pytest.mark.slow
@pytest.mark.blender
def test_textures_repeat_with_the_same_scale_and_orientation() -> None:
    needs_blender()
    (ours,) = rendered(CyclesTracer, checked(), None, samples=384)
    (theirs,) = rendered(PathTracer, checked(), None, samples=384)
    # Each is relative to its mean, as the diffuse lobes differ. Mitsuba's noise is 2 % of a pixel.
    ours, theirs = ours / ours.mean(), theirs / theirs.mean()
    assert np.median(np.abs(ours - theirs)) < 0.03
    # Texels are 4 pixels wide: a texture that is flipped or shifted by one differs by far more.
    for other in (theirs[::-1], theirs[:, ::-1], np.roll(theirs, 4, axis=1)):
        assert np.median(np.abs(ours - other)) > 0.1
    # Texture coordinates of the floor begin at its corner (-20, -20).
    rays = _CAMERA.directions(_CAMERA.pixel_centres())
    ground = rays[..., :2] / rays[..., 2:] * [_HEIGHT_M, -_HEIGHT_M] + 20.0
    exact = checked()["grey"].look_up(ground.reshape(-1, 2)).reshape(ours.shape)
    np.testing.assert_allclose(ours, exact / exact.mean(), atol=0.05)


@pytest.mark.slow
@pytest.mark.blender
def test_the_suns_disc_is_visible_and_has_its_irradiance() -> None:
    needs_blender()
    sky = np.zeros((16, 32, 3), dtype=np.float32)
    tracer = CyclesTracer([_FLOOR], [], grey(), sky, _SUN)
    # Looking at the sun: z is its direction, and the focal length makes it 12 pixels wide.
    z = _SUN.direction_world
    y = np.array([0.0, 1.0, 0.0])
    turn = np.stack([np.cross(y, z), y, z], axis=1)
    pose = RigidTransform.from_rotation("world", "above", turn, np.array([0.0, 0.0, 2.0]))
    camera = PinholeCamera("up", 32, 24, 1300.0, 1300.0, 16.0, 12.0)
    image = tracer.render(camera, (0, 0), pose, 16, 0)
    irradiance = image.sum(axis=(0, 1)) / 1300.0**2
    np.testing.assert_allclose(irradiance, _SUN.irradiance, rtol=0.05)
    assert image[0].max() == 0
