"""`lightsim render`: parts, resuming, several skies, and what is refused."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import InputError, MissingDependencyError
from lightsim.progress import SilentProgress
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.image import visible_sky
from lightsim.render.options import RendererChoice
from lightsim.render.renderers import Renderer, make_renderer, renderer_settings
from lightsim.render.transport.faces import TransportConfig
from lightsim.render.transport.sky import prepare_sky
from lightsim.simulation.buffers import Layout, write_frames
from lightsim.simulation.options import RenderOptions
from lightsim.simulation.skies import parse_sky
from lightsim.store.images import read_exr
from render.rendering_scenes import (
    box,
    camera,
    constant_sky,
    look_at,
    plane,
    random_sky,
    sun_sky,
)

T = TypeVar("T")
WHAT = ("depth", "ao", "shaded", "shadow", "image")
SKIES = ("a", "b")


class Interrupting(SilentProgress):
    """Raises KeyboardInterrupt after n frames."""

    def __init__(self, after: int) -> None:
        self.left = after

    def track(self, items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
        for item in items:
            if self.left == 0:
                raise KeyboardInterrupt
            self.left -= 1
            yield item


def no_image() -> np.ndarray:
    raise AssertionError("rendering reads no image")


def frames() -> tuple[ScenarioFrame, ...]:
    """Seven views of a box; each meets faces that the others do not."""
    return tuple(
        ScenarioFrame(
            "test",
            f"{k:02}",
            k,
            look_at([6 * np.cos(k), 6 * np.sin(k), 2], [0, 0, 0.5]),
            no_image,
            source="rendered",
        )
        for k in range(7)
    )


def renderer() -> FrameRenderer:
    scene = box([0, 0, 1], [1, 2, 2])
    ground = plane(half_m=8.0, cells=6)
    config = TransportConfig(sky_rays=8, pixel_samples=4)
    return FrameRenderer(ground, scene, config, 3, inferred_is_visible=True, is_sampled=True)


def run(out: Path, part: tuple[ScenarioFrame, ...], progress: SilentProgress | None = None) -> None:
    layout = Layout(out, WHAT, SKIES)
    made = renderer()
    domes = dict(
        zip(SKIES, (random_sky(np.random.default_rng(0)), sun_sky(1.0, 40.0)), strict=True)
    )
    skies = {name: made.prepare(dome) for name, dome in domes.items()}
    pending = [frame for frame in part if not layout.is_done(frame)]
    scenario = Scenario("test", (), ())
    cameras = {"test": camera(24, 18, 20.0)}
    write_frames(layout, made, scenario, cameras, pending, skies, progress or SilentProgress())


def contents(folder: Path) -> dict[str, bytes]:
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("whole")
    run(folder, frames())
    return contents(folder)


def test_one_tracing_writes_all_skies_where_the_interface_says(whole: dict[str, bytes]) -> None:
    stems = [frame.stem for frame in frames()]
    shared = [f"{what}/test/{stem}.exr" for what in ("depth", "ao") for stem in stems]
    light = [f"{s}/{w}/test/{n}.exr" for s in SKIES for w in WHAT[2:] for n in stems]
    assert sorted(whole) == sorted(shared + light)


def test_parts_of_the_frames_make_the_whole_run(tmp_path: Path, whole: dict[str, bytes]) -> None:
    for part in (slice(5, 7), slice(0, 2), slice(2, 5)):
        run(tmp_path, frames()[part])
    assert contents(tmp_path) == whole


def test_a_run_that_was_stopped_goes_on_to_the_same_files(
    tmp_path: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, frames(), Interrupting(2))
    assert len(contents(tmp_path)) == 2 * (2 + 2 * 3)
    written = 0

    def failing(path: Path, picture: np.ndarray, mark: str) -> None:
        nonlocal written
        written += 1
        if written == 4:
            raise KeyboardInterrupt
        write(path, picture, mark=mark)

    from lightsim.simulation import buffers as rendering

    write = rendering.write_exr
    monkeypatch.setattr(rendering, "write_exr", failing)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, frames())
    assert len(contents(tmp_path)) == 2 * (2 + 2 * 3) + 3
    monkeypatch.undo()
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.exr")}
    run(tmp_path, frames())
    assert contents(tmp_path) == whole
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())


def test_one_sky_has_no_folder_of_its_own(tmp_path: Path) -> None:
    layout = Layout(tmp_path, WHAT, ("only",))
    assert layout.light(frames()[0], "only")["shaded"] == tmp_path / "shaded" / "test" / "00.exr"


@pytest.mark.parametrize(
    ("sky", "name"),
    [
        ("source", "source"),
        ("sun:120.5,35,3", "sun_120.5_35_3"),
        ("time:2019-05-11T01:59:16Z", "time_2019-05-11T01_59_16Z"),
        ("skies/a b&c.hdr", "a_b_c"),
        ("/x/.hidden.exr", "hidden"),
    ],
)
def test_names_of_skies_are_fit_for_files(sky: str, name: str) -> None:
    assert parse_sky(SkyChoice(sky)).name == name


@pytest.mark.parametrize(
    "skies", [("a/x.hdr", "b/x.exr"), ("sun:1,2", "sun:1,2"), ("Depth.hdr",), ("X.hdr", "x.exr")]
)
def test_two_skies_of_one_name_are_refused(skies: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="one folder"):
        RenderOptions(what=("shaded",), sky=skies)


def test_light_needs_a_sky() -> None:
    with pytest.raises(InputError, match="--sky"):
        RenderOptions(what=("shaded",), sky=())


def test_a_chosen_number_of_rays_is_used() -> None:
    ground, none = plane(), plane(cells=0)
    choice = RendererChoice(backend="embree", rays=5)
    made = make_renderer(choice, ground, none, 0, has_images=False)
    assert isinstance(made, Renderer)
    scenario = Scenario("test", (), ())
    traced = made.trace(scenario, frames()[0], camera(8, 6, 6.0))
    np.testing.assert_allclose(traced.buffers.ambient_occlusion, 1.0, atol=1e-6)
    with pytest.raises(InputError, match="--rays"):
        RendererChoice(rays=0)


def test_the_ray_table_and_the_path_tracer_take_the_same_picture() -> None:
    """Of light and sky; a path tracer's rough surfaces reflect a little more."""
    ground, none = plane(half_m=8.0, cells=8), plane(cells=0)
    scenario = Scenario("test", (), ())
    sky = sun_sky(1.0, 40.0, 0.4, rows=64)
    shaded, images = [], []
    for choice in (RendererChoice(rays=64), RendererChoice(renderer="path", rays=16)):
        made = make_renderer(choice, ground, none, 0, has_images=True)
        traced = made.trace(scenario, frames()[0], camera(16, 12, 12.0))
        prepared = made.prepare(sky)
        # Light belongs to the surface alone: in pixels half covered it is as bright as in whole.
        shaded.append(traced.light(prepared).shaded[traced.buffers.has_surface].mean(0))
        images.append(traced.image(prepared))
    np.testing.assert_allclose(*shaded, rtol=0.03)
    np.testing.assert_allclose(images[0][0], images[1][0], rtol=1e-3)
    np.testing.assert_allclose(images[0].mean((0, 1)), images[1].mean((0, 1)), rtol=0.15)


def test_the_visible_sun_has_its_light() -> None:
    frame = replace(frames()[0], world_from_camera=look_at([0, 0, 1], [10, 0, 1]))
    view = camera(200, 200, 8000.0)
    sky = prepare_sky(sun_sky(0.0, 0.0, 0.25))
    assert sky.sun is not None
    seen = visible_sky(sky, frame, view) - 0.25
    np.testing.assert_allclose(seen.sum((0, 1)) / 8000.0**2, sky.sun.irradiance, rtol=0.02)


def test_what_stands_behind_the_street_gives_no_light() -> None:
    made = renderer()
    traced = made.trace(Scenario("test", (), ()), frames()[0], camera(24, 18, 20.0))
    dome, behind = constant_sky((0.1, 0.1, 0.1)), constant_sky((0.9, 0.2, 0.3))
    plain, other = made.prepare(dome), made.prepare(dome, behind)
    pictures = [traced.image(sky) for sky in (plain, other)]
    np.testing.assert_allclose(pictures[1][0], np.tile([0.9, 0.2, 0.3], (24, 1)), rtol=1e-5)
    np.testing.assert_array_equal(pictures[0][-1], pictures[1][-1])
    np.testing.assert_array_equal(traced.light(plain).shaded, traced.light(other).shaded)


def test_pictures_are_right(tmp_path: Path) -> None:
    run(tmp_path, frames()[:1])
    depth = read_exr(tmp_path / "depth" / "test" / "00.exr")
    shadow = read_exr(tmp_path / "b" / "shadow" / "test" / "00.exr")
    image = read_exr(tmp_path / "a" / "image" / "test" / "00.exr")
    assert np.isfinite(depth).any()
    assert shadow.min() >= 0
    assert shadow.max() <= 1
    assert (image[0] > 0).all()


def test_impossible_numbers_of_bounces_are_refused() -> None:
    assert renderer_settings(RendererChoice(renderer="path", bounces=8))["bounces"] == 8
    with pytest.raises(InputError, match="from 1 to 64"):
        RendererChoice(bounces=65)
    with pytest.raises(InputError, match="bounces"):
        RendererChoice(bounces=0)


def test_denoising_needs_its_package_before_anything_is_rendered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    mesh = TriMesh("world", np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32),
                   np.zeros((0, 3), np.float32))  # fmt: skip
    choice = RendererChoice(denoise=True)
    with pytest.raises(MissingDependencyError, match="denoise"):
        make_renderer(choice, mesh, mesh, 0, has_images=True)
    make_renderer(choice, mesh, mesh, 0, has_images=False)
