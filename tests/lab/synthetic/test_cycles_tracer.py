"""Streets by Cycles against Mitsuba. Needs an interpreter with bpy (LIGHTSIM_BLENDER_PYTHON)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float32

from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import Sun
from lightsim.core.frames import RigidTransform
from lightsim.errors import InputError, MissingDependencyError
from lightsim.progress import SilentProgress
from lightsim.render.reference.blender import find_bpy
from lightsim.store.hdr import read_sky
from lightsim.store.images import read_srgb8
from lightsim_lab.synthetic import edit_truth, generate, synthesize, synthesize_edits
from lightsim_lab.synthetic.cycles_tracer import CyclesTracer
from lightsim_lab.synthetic.edits import TrueEdit, View
from lightsim_lab.synthetic.plan import StreetConfig, plan_street
from lightsim_lab.synthetic.renderers import StreetRenderer
from lightsim_lab.synthetic.rig import MountedCamera
from lightsim_lab.synthetic.sensor import DEFAULT_SENSOR, CameraSensor, camera_isp
from lightsim_lab.synthetic.shapes import Part, box, rectangle
from lightsim_lab.synthetic.skies import build_sky, sky_specs
from lightsim_lab.synthetic.street import Street
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


def unedited(
    street: Street, _: StreetConfig, cameras: tuple[MountedCamera, ...], __: object
) -> tuple[TrueEdit, ...]:
    """Return an edit without change, with a view of the front camera."""
    return (TrueEdit("none", (), street.participants, (View(cameras[0], 1),)),)


@pytest.mark.slow
@pytest.mark.blender
def test_a_street_by_cycles_records_its_renderer_and_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyoidn", reason="needs the extra `denoise`")
    needs_blender()
    config = StreetConfig(48, 27, 2, 10, truth_stems=(1,), buffer_stems=(), dome_height_px=16)
    config = replace(config, samples=2, truth_samples=2, environment_height_px=32)
    monkeypatch.setattr(generate, "config_of", lambda _: config)
    monkeypatch.setattr(edit_truth, "config_of", lambda _: config)
    monkeypatch.setattr(generate, "sky_specs", lambda plan: sky_specs(plan)[:2])
    # The choice of edits takes long and depends on no renderer.
    monkeypatch.setattr(edit_truth, "choose_edits", unedited)
    truths, means = {}, {}
    for renderer in (StreetRenderer(), StreetRenderer("cycles")):
        folder, progress = tmp_path / renderer.name, SilentProgress()
        for make in (synthesize, synthesize_edits):
            make(
                folder, seed=3, size="small", progress=progress, is_denoised=True, renderer=renderer
            )
        truths[renderer.name] = json.loads((folder / "truth" / "truth.json").read_text())
        files = sorted((folder / "log" / "camera").glob("*/*.jpg"))
        assert len(files) == 12
        assert len(list((folder / "truth" / "relit").glob("*/*/*.jpg"))) == 6
        frame = "front_camera/01"
        edited = read_srgb8(folder / f"truth/edits/none/frames/{frame}.png")
        recorded = read_srgb8(folder / f"log/camera/{frame}.jpg")
        assert edited.mean() == pytest.approx(recorded.mean(), rel=0.03)
        means[renderer.name] = np.mean([read_srgb8(file).mean() for file in files])
    ours, theirs = truths["cycles"], truths["mitsuba"]
    assert ours.pop("renderer")["version"].startswith("4.")
    assert ours.pop("sensor") == vars(StreetRenderer("cycles").sensor)
    assert ours.pop("command") == theirs.pop("command") + " --renderer cycles"
    assert ours == theirs
    # The longer exposure outweighs the darker diffuse lobe and the compressed highlights.
    assert 1.0 < means["cycles"] / means["mitsuba"] < 1.2
    skies = [read_sky(tmp_path / name / "truth/skies/source.exr").radiance for name in means]
    factor = 2.0 ** StreetRenderer("cycles").sensor.exposure_ev
    # Files are compressed with small errors.
    assert skies[1].sum() / skies[0].sum() == pytest.approx(factor, rel=0.01)


def test_a_missing_blender_is_reported_before_anything_is_written(tmp_path: Path) -> None:
    renderer = StreetRenderer("cycles", blender_python=Path("/nowhere/python"))
    with pytest.raises(MissingDependencyError, match="--blender-python"):
        synthesize(
            tmp_path / "street", seed=3, size="small", progress=SilentProgress(), renderer=renderer
        )
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="--device"):
        StreetRenderer("cycles", "cuda")


def test_a_longer_exposure_brightens_all_light_of_a_sky() -> None:
    plan = plan_street(5)
    sky = build_sky(sky_specs(plan)[0], plan, 32)
    longer = sky.exposed(1.0)
    assert sky.sun is not None
    assert longer.sun is not None
    np.testing.assert_allclose(longer.smooth, 2 * sky.smooth)
    np.testing.assert_allclose(longer.sun.irradiance, 2 * sky.sun.irradiance)
    assert sky.exposed(0.0) is sky


def test_highlights_are_compressed_and_the_noise_is_that_of_the_sensor(
    rng: np.random.Generator,
) -> None:
    steps = np.linspace(0.0, 4.0, 400, dtype=np.float32)[None, :, None].repeat(3, axis=2)
    sensor = CameraSensor(knee=0.5)
    plain = camera_isp(steps, np.ones(3), None)
    toned = camera_isp(steps, np.ones(3), None, sensor)
    np.testing.assert_array_equal(toned[steps < 0.5], plain[steps < 0.5])
    assert (np.diff(toned[0, :, 0].astype(int)) >= 0).all()
    # Twice the clipping level keeps a detail; far above it, pixels are white.
    assert plain[0, 200, 0] == 255
    assert 240 < toned[0, 200, 0] < 255
    dark = np.full((200, 200, 3), 0.18, dtype=np.float32)
    sigma = [
        camera_isp(dark, np.ones(3), rng, one).std()
        for one in (DEFAULT_SENSOR, StreetRenderer("cycles").sensor)
    ]
    # sqrt(2e-4 x 0.18 + 3e-3^2) over sqrt(5e-5 x 0.18 + 1e-3^2).
    assert sigma[1] / sigma[0] == pytest.approx(2.12, rel=0.05)
