"""Relighting asks any renderer for the light of source and target: `relight --renderer`."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from tests.render.rendering_scenes import constant_sky, sun_sky
from tests.simulation.test_moving_shadow import recorded
from tests.tiny_world import TinyWorkspace, on_ground, scenario_of

from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import MissingDependencyError
from lightsim.progress import SilentProgress
from lightsim.render.options import LightChoice
from lightsim.render.reference import cycles
from lightsim.render.reference.blender import find_bpy
from lightsim.render.reference.path_tracer import PathTracer
from lightsim.simulation.claims import settings_of
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import make_frames
from lightsim.simulation.relighter import RelightConfig, Relighter, RelitFrame
from lightsim.simulation.target_sky import SkyFacts, TargetSky

SKY = sun_sky(np.radians(30.0), 35.0, 0.15)
PYTHON = Path("python-with-blender")


def relit(work: TinyWorkspace, choice: LightChoice) -> RelitFrame:
    options = RelightOptions(name="tiny", renderer=choice)
    relighter = Relighter(work, work.log, RelightConfig(), options)
    scenario = scenario_of(work)
    targets = [relighter.target(TargetSky(SKY, SkyFacts("source")))]
    (found,) = relighter.relit(scenario.frames[1], scenario, targets)
    return found


class PretendedCycles(PathTracer):
    """Blender is not here: Mitsuba takes the same shots."""

    pythons: list[object] = []  # noqa: RUF012
    shots = 0

    def __init__(self, python: object) -> None:
        super().__init__()
        self.pythons.append(python)

    def render_shots(self, *args):  # type: ignore[override]
        PretendedCycles.shots += len(args[3])
        return super().render_shots(*args)


def test_every_sky_takes_three_shots_of_cycles(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sun, the sky and all light, under the source and under the target."""
    monkeypatch.setattr(cycles, "Cycles", PretendedCycles)
    choice = LightChoice(renderer="cycles", rays=8, blender_python=PYTHON)
    lit_alike(choice)
    assert PretendedCycles.pythons == [PYTHON]
    assert PretendedCycles.shots == 6


@pytest.mark.slow
@pytest.mark.blender
def test_light_of_blender_relights_as_light_transport_does() -> None:
    try:
        find_bpy()
    except MissingDependencyError as error:
        pytest.skip(f"no Blender: {error}")
    lit_alike(LightChoice(renderer="cycles", rays=16))


def lit_alike(choice: LightChoice) -> None:
    """The renderer's light, and what it makes of a picture, are those of light transport."""
    work = recorded(constant_sky((0.6, 0.6, 0.6)))
    ours, theirs = relit(work, LightChoice()), relit(work, choice)
    assert ours.lights is not None
    assert theirs.lights is not None
    ground = on_ground(work.log.frames[1])
    for a, b in zip(ours.lights, theirs.lights, strict=True):
        assert not np.array_equal(a.shaded, b.shaded)
        for name in ("shaded", "ratio"):
            means = [getattr(light, name)[ground].mean(axis=0) for light in (a, b)]
            np.testing.assert_allclose(*means, rtol=0.03, err_msg=name)
    means = [frame.radiance[ground].mean(axis=0) for frame in (ours, theirs)]
    np.testing.assert_allclose(*means, rtol=0.03)


@pytest.mark.skipif(find_spec("bpy") is not None, reason="Blender is in this interpreter")
def test_a_missing_blender_is_told_before_anything_is_replaced() -> None:
    """A workspace that nobody built would refuse everything else first."""
    work = recorded(constant_sky((0.6, 0.6, 0.6)))
    choice = LightChoice(renderer="cycles", blender_python=Path(sys.executable))
    options = RelightOptions(name="tiny", renderer=choice, overwrite=True)
    with pytest.raises(MissingDependencyError, match="bpy"):
        make_frames(work, scenario_of(work), options, SilentProgress())


def test_who_renders_the_light_is_part_of_a_scenarios_settings() -> None:
    def settings(choice: LightChoice) -> dict:
        return settings_of(RelightOptions(name="x", renderer=choice), SkyChoice("sun:180,60"), 1.0)

    plain = settings(LightChoice())
    assert "renderer" not in plain
    made = settings(LightChoice(renderer="cycles"))
    assert made == settings(LightChoice(renderer="cycles", blender_python=PYTHON))
    others = [settings(LightChoice(renderer="path")), settings(LightChoice(rays=8)), plain]
    assert all(other != made for other in others)
