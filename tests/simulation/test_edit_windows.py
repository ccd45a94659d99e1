"""Only what edits reach is traced, and it is traced as in the whole picture."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from scipy import ndimage
from tests.simulation.test_edited_frames import BOX_GONE, SUNNY, edited, shows_box_or_shadow
from tests.tiny_world import ABOVE, LENS, NOTHING, TinyWorkspace, scenario_of, tiny_world

from lightsim.core.scenario import Scenario, changed_placements
from lightsim.render.frame_renderer import FrameRenderer, TransportFrame
from lightsim.render.transport.matrix import TransportConfig
from lightsim.simulation.edit_window import edit_window

NOBODY = np.zeros((LENS.height_px, LENS.width_px), dtype=bool)


def traced(work: TinyWorkspace, scenario: Scenario) -> tuple[FrameRenderer, TransportFrame]:
    renderer = FrameRenderer(work.assets.background, NOTHING, TransportConfig(bounces=2), 0)
    return renderer, renderer.trace(scenario, work.log.frames[1], LENS)


def test_a_part_of_a_frame_has_the_light_of_the_whole() -> None:
    _, whole = traced(tiny_world(SUNNY, ABOVE), scenario_of(tiny_world(SUNNY, ABOVE)))
    rows, columns = window = slice(20, 70), slice(8, 60)
    is_wanted = np.zeros((50, 52), dtype=bool)
    is_wanted[10:40, 10:45] = True
    part = whole.part(window, is_wanted)
    assert (part.geometry.has_surface == (is_wanted & whole.geometry.has_surface[window])).all()
    # A window of a window is one of the picture.
    inner = part.part((slice(10, 40), slice(10, 44)), is_wanted[10:40, 10:44])
    assert inner.view[0].time_ns == whole.view[0].time_ns
    # Light is smoothed over traced neighbours, which lie up to 6 pixels away.
    inside = np.asarray(ndimage.binary_erosion(is_wanted, iterations=6), dtype=bool)
    light = whole.light(SUNNY)
    for name in ("sky", "bounce"):
        expected = getattr(light, name)[rows, columns]
        np.testing.assert_array_equal(getattr(part.light(SUNNY), name)[inside], expected[inside])
        found = getattr(inner.light(SUNNY), name)[6:-6, 6:-6]
        np.testing.assert_array_equal(found, expected[10:40, 10:44][6:-6, 6:-6])
        assert (getattr(part.light(SUNNY), name)[~is_wanted] == 0).all()


def test_what_an_edit_leaves_is_not_looked_at_again() -> None:
    """The geometry is that of the scenario, seen anew."""
    work = tiny_world(SUNNY, ABOVE)
    recorded = scenario_of(work)
    scenario = edited(work, BOX_GONE)
    renderer, known = traced(work, scenario)
    changed = changed_placements(recorded, scenario, known.view[0].time_ns)
    assert changed is not None
    beside = renderer.trace_changed_pixels(known, recorded, changed[0] + changed[1])
    anew = renderer.trace(recorded, *known.view)
    assert (beside.geometry.actor_index != known.geometry.actor_index).any()
    for field in fields(anew.geometry):
        values = [getattr(frame.geometry, field.name) for frame in (beside, anew)]
        np.testing.assert_array_equal(*values)


def test_edits_reach_what_shows_them_and_their_light_and_no_more() -> None:
    work = tiny_world(SUNNY, ABOVE)
    recorded = scenario_of(work)
    scenario = edited(work, BOX_GONE)
    renderer, after = traced(work, scenario)
    frame = work.log.frames[1]
    changed = changed_placements(recorded, scenario, frame.time_ns)
    assert changed is not None
    before = renderer.trace_changed_pixels(after, recorded, changed[0] + changed[1])
    sky = renderer.prepare(SUNNY)
    found = edit_window((before, after), changed, ([0], []), NOBODY, sky)
    assert found is not None
    reached = NOBODY.copy()
    reached[found.window] = found.is_reached
    assert reached[shows_box_or_shadow(frame, SUNNY)].all()
    light = [view.light(sky).shaded for view in (before, after)]
    is_changed = np.any(np.abs(np.log(light[1] / light[0])) > 0.05, axis=-1)
    # Single rays that meet the box from far away are noise.
    assert (is_changed & reached).sum() > 0.98 * is_changed.sum()
    assert reached.mean() < 0.6
    # A blurred layer is not cut off.
    corner = NOBODY.copy()
    corner[0, 0] = True
    found = edit_window((before, after), changed, ([0], []), corner, sky)
    assert found is not None
    assert not reached[0, 0]
    assert found.is_reached[0, 0]


def test_edits_that_change_nothing_reach_nothing() -> None:
    work = tiny_world(SUNNY, ABOVE)
    recorded = scenario_of(work)
    renderer, known = traced(work, recorded)
    (placement,) = recorded.placements_at(work.log.frames[1].time_ns)
    pose = placement.track.trajectory
    matrices = pose.matrices.copy()
    # Deep under the street, where its shadow falls on nothing.
    matrices[:, 2, 3] -= 10_000
    track = replace(placement.track, trajectory=replace(pose, matrices=matrices))
    away = replace(placement, track=track)
    sky = renderer.prepare(SUNNY)
    assert edit_window((known, known), ((away,), ()), ([], []), NOBODY, sky) is None
