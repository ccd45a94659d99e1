"""An edit seen by two cameras, and by successive frames, is one edit."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from benchmarks.view_agreement import colour_difference, overlap, picture_shifts_px
from scipy.ndimage import binary_erosion
from tests.render.rendering_scenes import look_at, plane
from tests.simulation.test_edited_frames import SUNNY, edits_of, frame_of, photographed
from tests.tiny_world import ABOVE, LENS, TinyWorkspace, rendered, scenario_of, tiny_world

from lightsim.core.buffers import BACKGROUND
from lightsim.core.colour import luminance
from lightsim.core.frames import RigidTransform
from lightsim.scenario.edits import Insert, Move, Waypoint
from lightsim_lab.metrics.consistency import View, match

BESIDE = look_at([9.0, -12.0, 26.0], [1.0, 1.0, 0.0], up=(0.0, 1.0, 0.0))
HERE = Waypoint(x_m=5.0, y_m=1.0, yaw_deg=40.0)
THERE = (Waypoint(time_s=0.0, x_m=-6.0, y_m=-4.0), Waypoint(time_s=1.0, x_m=-6.0, y_m=3.0))
EDITS = (Insert("edit 1", "box", "new", (HERE,)), Move("edit 2", "car", THERE))
NEW = (0, 1)


@cache
def edited_view(view: RigidTransform, number: int) -> tuple[View, np.ndarray]:
    """A frame with edits, and where they darken the ground."""
    work = photographed(SUNNY, (), view)
    recorded = scenario_of(work)
    scenario = edits_of(recorded, work, EDITS)
    made = frame_of(work, recorded, scenario, None, number)
    assert made.traced is not None
    frame = made.frame
    poses = {
        scenario.number_by_actor[p.track.actor_id]: p.world_from_actor(frame.time_ns)
        for p in scenario.placements_at(frame.time_ns)
    }
    buffers = made.traced.geometry
    plain = luminance(rendered(work, frame, SUNNY)[1].unshadowed)
    light = luminance(made.source.radiance / np.maximum(buffers.base_colour, 0.01))
    is_dark = (buffers.actor_index == BACKGROUND) & (light < 0.7 * plain)
    return View(frame, LENS, buffers, made.source.radiance, poses), is_dark


@pytest.mark.parametrize("pair", ["cameras", "frames"])
def test_two_views_of_an_edit_agree(pair: str) -> None:
    a, dark_a = edited_view(ABOVE, 1)
    b, dark_b = edited_view(BESIDE, 1) if pair == "cameras" else edited_view(ABOVE, 2)
    for number in NEW:
        found = match(a, b, a.buffers.actor_index == number)
        assert len(found.pixel) > 60
        # At its edges one view has one face of the box where the other has the next.
        assert np.quantile(found.error_px, 0.9) < 2e-5
        # Pixels at edges are mixed with what is behind them.
        assert np.median(colour_difference(a, b, found)) < 0.012
    ground = match(a, b, a.buffers.actor_index == BACKGROUND)
    assert np.quantile(ground.error_px, 0.9) < 2e-5
    if pair == "cameras":
        assert dark_a.sum() > 100
        # A pixel covers 0.31 m: the shadows' edges are a pixel wide.
        both, either = overlap(dark_a, dark_b, ground)
        assert either > 100
        assert both > 0.8 * either
        rows, columns = ground.pixel.T
        seen_b = dark_b[ground.other]
        in_shadow = np.asarray(binary_erosion(dark_a), dtype=bool)[rows, columns]
        in_light = np.asarray(binary_erosion(~dark_a), dtype=bool)[rows, columns]
        # Four rays to the sun tell the penumbra of the box that was there: one pixel may err.
        assert (in_shadow & ~seen_b).sum() <= 1
        assert not (in_light & seen_b).any()


def test_a_view_that_is_wrong_is_told() -> None:
    """The box half a metre above where it should be, another colour, another shadow."""
    (a, dark), (b, _) = edited_view(ABOVE, 1), edited_view(BESIDE, 1)
    is_new = a.buffers.actor_index == 1
    right = match(a, b, is_new)
    raised = RigidTransform.from_rotation("world", "world", np.eye(3), np.array([0.0, 0.0, 0.5]))
    wrong = replace(b, world_from_actor={n: raised @ p for n, p in b.world_from_actor.items()})
    assert np.median(match(a, wrong, is_new).error_px) > 0.5
    brighter = replace(b, radiance=np.float32(1.2) * b.radiance)
    assert np.median(colour_difference(a, brighter, right)) == pytest.approx(np.log(1.2), abs=0.02)
    ground = match(a, b, a.buffers.actor_index == BACKGROUND)
    both, either = overlap(dark, np.zeros_like(dark), ground)
    assert both == 0 < either


@pytest.mark.parametrize("shift_m", [0.0, 0.1])
def test_the_shift_of_pictures_is_measured(shift_m: float) -> None:
    """A pattern on the ground, in the second view beside where it is in the first."""

    def painted(work: TinyWorkspace, shift_m: float) -> View:
        frame = work.log.frames[1]
        buffers, _ = rendered(work, frame, SUNNY)
        x, y, _ = np.moveaxis(buffers.position_world, 2, 0)
        x = x - shift_m
        grey = 0.4 + 0.1 * (np.sin(1.7 * x + y) + np.sin(2.1 * y - 0.6 * x))
        radiance = np.repeat(grey[..., None], 3, axis=2).astype(np.float32)
        return View(frame, LENS, buffers, radiance, {})

    one, other = (tiny_world(SUNNY, view, plane(60.0, 1)) for view in (ABOVE, BESIDE))
    a, b = painted(one, 0.0), painted(other, shift_m)
    found = match(a, b, a.buffers.actor_index == BACKGROUND)
    shifts = picture_shifts_px(a, b, found)
    assert len(shifts) >= 6
    assert np.median(shifts) == pytest.approx(shift_m * LENS.fx / 30.0, abs=0.03)
