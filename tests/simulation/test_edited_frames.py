"""Edits in pictures against closed forms: a box that is taken out of a picture, or put into one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from tests.render.rendering_scenes import constant_sky, look_at, plane, sun_sky
from tests.tiny_world import (
    ABOVE,
    BOX_LWH_M,
    GAIN,
    GROUND,
    LENS,
    NOTHING,
    TinyWorkspace,
    driving_box,
    in_shadow,
    meets_box,
    psnr_db,
    rays,
    scenario_of,
    tiny_world,
    with_pictures,
)

from lightsim.core.colour import srgb8_from_linear
from lightsim.core.dome import SkyDome
from lightsim.core.fields import GroundMap
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import SunVisibility
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.apply import apply_edits
from lightsim.scenario.edits import Edit, Insert, Move, Remove, Waypoint
from lightsim.scenario.ground import StandingGround
from lightsim.simulation.labels import actor_labels, amodal_mask
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relighter import RelightConfig, Relighter, RelitFrame
from lightsim.simulation.source_image import may_be_in_picture
from lightsim.simulation.target_sky import SkyFacts, TargetSky

SUNNY = sun_sky(np.radians(30.0), 35.0, 0.15)
OVERCAST = constant_sky((0.6, 0.6, 0.6))
FLAT = StandingGround(
    GroundMap(
        np.array([-60.0, -60.0]), 1.0, np.zeros((121, 121), np.float32), np.ones((121, 121), bool)
    )
)
BOX_GONE = (Remove("edit 1", "car"),)


def photographed(
    sky: SkyDome, edits: Sequence[Edit] = (), view: RigidTransform = ABOVE
) -> TinyWorkspace:
    """The tiny world with the pictures that a camera takes of it, after edits, under a sky."""
    return with_pictures(tiny_world(sky, view), pictures_of(sky, tuple(edits), view))


@cache
def pictures_of(
    sky: SkyDome, edits: tuple[Edit, ...], view: RigidTransform
) -> Mapping[str, np.ndarray]:
    """By stem; many tests look at the same."""
    work = tiny_world(sky, view)
    scenario = edited(work, edits)
    renderer = FrameRenderer(work.assets.background, NOTHING, TransportConfig(bounces=2), 0)
    pictures = {}
    for frame in work.log.frames:
        traced = renderer.trace(scenario, frame, LENS)
        radiance = traced.buffers.base_colour * traced.light(sky).shaded
        pictures[frame.stem] = srgb8_from_linear(radiance * GAIN)
    return pictures


def edited(work: TinyWorkspace, edits: Sequence[Edit]) -> Scenario:
    return edits_of(scenario_of(work), work, edits)


def edits_of(recorded: Scenario, work: TinyWorkspace, edits: Sequence[Edit]) -> Scenario:
    asset, _ = driving_box()
    return apply_edits(recorded, edits, lambda _: asset, FLAT, work.log)


def test_an_actor_that_an_edit_removed_cannot_be_edited() -> None:
    """The error listed all actors but this one, as if its id were wrong."""
    again = Move("edit 2", "car", offset_m=(1.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"edit 2: an edit before this one has removed"):
        edited(tiny_world(SUNNY), [*BOX_GONE, again])


def simulated(
    work: TinyWorkspace,
    edits: Sequence[Edit],
    sky: SkyDome | None = None,
    method: str = "network",
) -> RelitFrame:
    """The middle frame with edits under another sky; None is the source's."""
    recorded = scenario_of(work)
    return frame_of(work, recorded, edits_of(recorded, work, edits), sky, method=method)


def frame_of(
    work: TinyWorkspace,
    recorded: Scenario,
    scenario: Scenario,
    sky: SkyDome | None = None,
    number: int = 1,
    method: str = "network",
) -> RelitFrame:
    options = RelightOptions(name="tiny", method=method)
    relighter = Relighter(work, work.log, RelightConfig(), options, recorded)
    target = relighter.target(
        TargetSky(sky or work.sky.dome, SkyFacts("source"), is_source=sky is None)
    )
    (found,) = relighter.relit(scenario.frames[number], scenario, [target])
    return found


def shows_box_or_shadow(frame: CameraFrame, sky: SkyDome) -> np.ndarray:
    origin, directions = rays(frame)
    shown = meets_box(np.broadcast_to(origin, directions.shape), directions, frame)
    return shown if sky.sun is None else shown | in_shadow(frame, sky.sun.direction_world)


@pytest.mark.parametrize("sky", [SUNNY, OVERCAST], ids=["sunny", "overcast"])
def test_a_removed_box_takes_its_shadow_along(sky: SkyDome) -> None:
    work, wanted = photographed(sky), photographed(sky, BOX_GONE).log.frames[1].load_srgb8()
    found = simulated(work, BOX_GONE)
    recorded = work.log.frames[1].load_srgb8()
    assert psnr_db(recorded, wanted) < 36
    assert psnr_db(found.image_srgb8, wanted) > 57
    kept = ~found.source.is_edited
    assert (found.image_srgb8[kept] == recorded[kept]).all()
    # Farther than the light that the box takes from the ground reaches, nothing is touched.
    assert kept.mean() > 0.6
    assert not (kept & shows_box_or_shadow(work.log.frames[1], sky)).any()


def test_the_shaded_side_of_a_removed_box_says_nothing_of_the_ground_behind_it() -> None:
    away = -SUNNY.sun.direction_world if SUNNY.sun is not None else np.zeros(3)
    eye = np.array([*(20 * away[:2] / np.linalg.norm(away[:2])), 8.0])
    view = look_at(eye.tolist(), [0.0, 0.0, 0.0])
    work = photographed(SUNNY, view=view)
    wanted = photographed(SUNNY, BOX_GONE, view).log.frames[1].load_srgb8()
    found = simulated(work, BOX_GONE)
    assert psnr_db(work.log.frames[1].load_srgb8(), wanted) < 30
    assert psnr_db(found.image_srgb8, wanted) > 50


def test_the_same_box_put_back_gives_the_picture_back() -> None:
    """Into an empty street, where its own track led: the box, its shadow and what lies under it."""
    work, wanted = photographed(SUNNY, BOX_GONE), photographed(SUNNY)
    empty = edited(work, BOX_GONE)
    track = driving_box()[1]
    x, y, z = track.world_from_actor(work.log.frames[1].time_ns).translation_m
    here = Waypoint(x_m=x, y_m=y, z_m=z - BOX_LWH_M[2] / 2, yaw_deg=0.0)
    back = edits_of(empty, work, (Insert("edit 2", "box", "again", (here,)),))
    found = frame_of(work, empty, back)
    assert psnr_db(work.log.frames[1].load_srgb8(), wanted.log.frames[1].load_srgb8()) < 30
    assert psnr_db(found.image_srgb8, wanted.log.frames[1].load_srgb8()) > 49
    kept = ~found.source.is_edited
    assert not (kept & shows_box_or_shadow(work.log.frames[1], SUNNY)).any()
    assert back.number_by_actor["again"] == 1


def test_a_moved_box_leaves_one_place_for_the_other() -> None:
    work = photographed(SUNNY)
    move = (Move("edit 1", "car", offset_m=(8.0, 0.0, 0.0)),)
    wanted = photographed(SUNNY, move).log.frames[1].load_srgb8()
    found = simulated(work, move)
    assert psnr_db(work.log.frames[1].load_srgb8(), wanted) < 28
    assert psnr_db(found.image_srgb8, wanted) > 48


def test_an_edited_street_is_relit_as_if_it_had_been_recorded() -> None:
    """As the street without the box is relit, and as the truth is: by default and by physics."""
    work, evening = photographed(SUNNY), sun_sky(np.radians(170.0), 60.0, 0.15)
    wanted = photographed(evening, BOX_GONE).log.frames[1].load_srgb8()
    for method in ("network", "physical"):
        found = simulated(work, BOX_GONE, evening, method)
        recorded = simulated(photographed(SUNNY, BOX_GONE), BOX_GONE, evening, method)
        assert psnr_db(found.image_srgb8, recorded.image_srgb8) > 58
        assert psnr_db(found.image_srgb8, wanted) > 43


def test_frames_without_edits_are_the_recorded_bytes_and_cost_no_ray(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nothing is traced for the source's own sky; where the box is far out of the picture neither,
    but with another sky the frame is relit."""

    def refused(*_: object) -> None:
        raise AssertionError("a ray was traced")

    work = photographed(SUNNY)
    far = (Insert("edit 1", "box", "far", (Waypoint(x_m=0.0, y_m=50.0, yaw_deg=0.0),)),)
    monkeypatch.setattr(FrameRenderer, "trace", refused)
    for edits in ((), far):
        found = simulated(work, edits)
        assert (found.image_srgb8 == work.log.frames[1].load_srgb8()).all()
        assert not found.source.is_edited.any()
    with pytest.raises(AssertionError, match="a ray was traced"):
        simulated(work, BOX_GONE)


def test_labels_tell_how_much_of_an_actor_is_hidden() -> None:
    """A box of the same size right over the other hides it; alone, all of it is seen."""
    work = photographed(SUNNY)
    x, y, z = driving_box()[1].world_from_actor(work.log.frames[1].time_ns).translation_m
    above = Waypoint(x_m=x, y_m=y, z_m=z + 2.0, yaw_deg=0.0)
    scenario = edited(work, (Insert("edit 1", "box", "roof", (above,)),))
    placements = {p.track.actor_id: p for p in scenario.placements}
    frame = scenario.frames[1]
    shown = {name: amodal_mask(p, frame, LENS) for name, p in placements.items()}
    assert (shown["car"] <= shown["roof"]).all()
    origin, directions = rays(frame)
    wanted = meets_box(np.broadcast_to(origin, directions.shape), directions, frame)
    assert (shown["car"] == wanted).all()
    labels = actor_labels(scenario, frame, LENS, np.where(shown["roof"], 1, -1).astype(np.int32))
    assert [label.visibility for label in labels] == [0.0, 1.0]
    assert labels[0].visible_box is None
    assert labels[1].amodal_box == labels[1].visible_box


def test_the_shadow_of_a_parked_box_that_is_gone_is_not_believed() -> None:
    """The twin found shade all over the ground. Where the box stood before the sun, nobody knows
    what is there without it; everywhere else the shade stays."""
    sun = SUNNY.sun
    assert sun is not None
    ground = plane(60.0, 1, GROUND)
    ground = replace(ground, sun_visibility=SunVisibility(np.zeros(len(ground.vertices), np.uint8)))
    work = tiny_world(SUNNY, background=ground)
    (recorded,) = scenario_of(work).placements
    mesh = recorded.asset.mesh
    seen = SunVisibility(np.full(len(mesh.vertices), 255, np.uint8))
    parked = replace(
        recorded, asset=replace(recorded.asset, mesh=replace(mesh, sun_visibility=seen))
    )
    scenario = replace(scenario_of(work), placements=(), vacated=(parked,))
    renderer = FrameRenderer(ground, NOTHING, TransportConfig(), 0)
    frame = scenario.frames[1]
    found = renderer.trace(scenario, frame, LENS).found_visibility(sun)
    assert found is not None
    assert np.isnan(found[in_shadow(frame, sun.direction_world)]).all()
    far = np.logical_not(binary_dilation(shows_box_or_shadow(frame, SUNNY), iterations=4))
    assert (found[far] == 0).all()


def test_what_may_be_left_out_is_neither_seen_nor_shades_anything() -> None:
    """Cameras all around, that look anywhere: where the box or its shadow shows, it is told."""
    rng = np.random.default_rng(3)
    work = tiny_world(SUNNY)
    (placement,) = scenario_of(work).placements
    sun = SUNNY.sun
    assert sun is not None
    told = 0
    for _ in range(200):
        view = look_at(rng.uniform(-25, 25, 3) + [0, 0, 28], rng.uniform(-60, 60, 3) * [1, 1, 0])
        frame = replace(work.log.frames[1], world_from_camera=view)
        may = may_be_in_picture(placement, frame, LENS, sun.direction_world.astype(np.float32))
        assert may or not shows_box_or_shadow(frame, SUNNY).any()
        told += not may
    assert told > 20
