"""`image` from the log's pictures, against those very pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.render.rendering_scenes import sun_sky
from tests.simulation.test_edited_frames import pictures_of
from tests.tiny_world import (
    ABOVE,
    GAIN,
    LENS,
    TinyWorkspace,
    psnr_db,
    scenario_of,
    tiny_world,
    with_pictures,
)

from lightsim.core.colour import linear_from_srgb8, srgb8_from_linear
from lightsim.core.scenario import Scenario
from lightsim.errors import InputError
from lightsim.progress import SilentProgress
from lightsim.render.options import RendererChoice
from lightsim.render.renderers import make_renderer
from lightsim.scenario.apply import driven_beside
from lightsim.scenario.replay import replay
from lightsim.simulation import relight_methods
from lightsim.simulation.buffers import Layout, _claim, _settings, write_frames
from lightsim.simulation.options import RelightOptions, RenderOptions
from lightsim.simulation.picture_images import PictureImages, shown_by_pictures
from lightsim.simulation.target_sky import SkyFacts, TargetSky
from lightsim.store.artefact import hash_names, json_ready, read_json, write_json
from lightsim.store.images import read_exr
from lightsim.store.weights import list_weights

SKY = sun_sky(np.radians(30.0), 35.0, 0.15)
OPTIONS = RenderOptions(what=("image",))
HELD_OUT = frozenset({"01"})


def workspace(red: frozenset[str] = frozenset()) -> TinyWorkspace:
    """The tiny world, some of whose pictures are red: whoever looks at one is found out."""
    pictures = dict(pictures_of(SKY, (), ABOVE))
    nothing = np.zeros_like(pictures["00"]) + np.array([255, 0, 0], np.uint8)
    work = with_pictures(tiny_world(SKY), pictures | dict.fromkeys(red, nothing))
    work.__dict__["held_out"] = HELD_OUT
    return work


def image(work: TinyWorkspace, scenario: Scenario, number: int) -> np.ndarray:
    skies = {"source": TargetSky(SKY, SkyFacts("source"), is_source=True)}
    images = PictureImages(work, work.log, scenario, OPTIONS, skies)
    (found,) = images.of(scenario.frames[number], ("source",))
    return found


def test_a_recorded_frame_is_its_picture(tmp_path: Path) -> None:
    work = workspace()
    scenario = shown_by_pictures(scenario_of(work), work.held_out)
    skies = {"source": TargetSky(SKY, SkyFacts("source"), is_source=True)}
    images = PictureImages(work, work.log, scenario, OPTIONS, skies)
    renderer = make_renderer(
        RendererChoice(backend="embree"), work.assets.background, work.inferred, 0, has_images=False
    )
    layout = Layout(tmp_path, ("image", "shaded"), ("source",))
    prepared = {"source": renderer.prepare(SKY)}
    frames = scenario.frames[:1]
    cameras = {LENS.name: LENS}
    write_frames(layout, renderer, scenario, cameras, frames, prepared, SilentProgress(), images)
    written = read_exr(tmp_path / "image" / LENS.name / "00.exr")
    np.testing.assert_array_equal(written, linear_from_srgb8(frames[0].load_srgb8()) / GAIN)
    assert layout.is_done(frames[0])


def test_a_held_out_frame_is_seen_by_the_others_alone() -> None:
    work = workspace()
    replayed = replay(work.twin, "tiny", work.log.frames)
    scenario = shown_by_pictures(replayed, work.held_out)
    assert [f.source for f in scenario.frames] == ["recorded", "rendered", "recorded"]
    found = image(work, scenario, 1)
    np.testing.assert_array_equal(found, image(workspace(red=HELD_OUT), scenario, 1))
    # The box drives: where its shadow falls in a picture, that picture is not believed (29 dB).
    truth = work.log.frames[1].load_srgb8()
    assert psnr_db(srgb8_from_linear(found * GAIN), truth) > 43


def test_an_actor_keeps_the_outline_that_its_reconstruction_lacks() -> None:
    """The twin's box ends a pixel before the recorded one, which left its rim on the ground."""
    work = workspace()
    car = work.assets.actors["car"]
    smaller = car.mesh.vertices * np.array([0.85, 0.7, 1.0], np.float32)
    actors = {"car": replace(car, mesh=replace(car.mesh, vertices=smaller))}
    work.__dict__["assets"] = replace(work.assets, actors=actors)
    work.__dict__["twin"] = replace(work.twin, assets=work.assets)
    replayed = replay(work.twin, "tiny", work.log.frames)
    found = image(work, shown_by_pictures(replayed, work.held_out), 1)
    truth = work.log.frames[1].load_srgb8()
    # What is left is its shadow, a pixel too narrow as well (32.2 dB with the rim on the ground).
    assert psnr_db(srgb8_from_linear(found * GAIN), truth) > 32.8


def test_an_offset_moves_the_cameras_with_the_ego_vehicle() -> None:
    scenario = scenario_of(workspace())
    moved = driven_beside(scenario, (1.0, 2.0, 0.0))
    assert {f.source for f in moved.frames} == {"rendered"}
    for frame, was in zip(moved.frames, scenario.frames, strict=True):
        step = frame.world_from_camera.translation_m - was.world_from_camera.translation_m
        np.testing.assert_allclose(step, [1.0, 2.0, 0.0], atol=1e-12)
    assert RelightOptions(name="n", ego_offset_m="0,1.5,0").ego_offset == (0.0, 1.5, 0.0)
    for wrong in ("1,2", "a,b,c", "1,2,inf"):
        with pytest.raises(InputError, match="--ego-offset-m"):
            RelightOptions(name="n", ego_offset_m=wrong)


def test_denoising_is_for_rendered_images() -> None:
    denoised = RendererChoice(denoise=True)
    with pytest.raises(InputError, match="--image-from twin"):
        RenderOptions(what=("image",), renderer=denoised)
    assert not RenderOptions(what=("image",), image_from="twin", renderer=denoised).has_pictures


def claim(out: Path, settings: dict[str, Any]) -> None:
    _claim(Layout(out, ("image",), (), hash_names(settings)), settings, {})


def test_a_folder_keeps_the_weights_and_the_code_that_its_images_were_made_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TinyWorkspace, "record", lambda self, stage: {"key": stage}, raising=False)
    work = workspace()
    twin_alone = replace(OPTIONS, image_from="twin")
    before, twin_before = (_settings(work, chosen, 1.0) for chosen in (OPTIONS, twin_alone))
    assert before["method"] == "network"
    claim(tmp_path, before)
    claim(tmp_path, before)
    assert read_json(tmp_path / "render.json") == json_ready(before)

    other = {**list_weights(), "relight-network": {"relight-network.safetensors": "00"}}
    monkeypatch.setattr(relight_methods, "list_weights", lambda folder: other)
    assert _settings(work, twin_alone, 1.0) == twin_before
    with pytest.raises(InputError, match=r"other settings.*weights = 00.*--out"):
        claim(tmp_path, _settings(work, OPTIONS, 1.0))
    with pytest.raises(InputError, match=r"other settings.*relighting"):
        claim(tmp_path, {**before, "relighting": {**before["relighting"], "exposure_s": 1.0}})

    changed = {**before["sources"], "lightsim/relighting/physical/ratio.py": "00"}
    with pytest.raises(InputError, match=r"another version.*physical/ratio\.py changed.*--out"):
        claim(tmp_path, {**before, "sources": changed})
    write_json(tmp_path / "render.json", {"schema": 12, **before, "sources": None})
    with pytest.raises(InputError, match=r"another version.*no record of it"):
        claim(tmp_path, before)
