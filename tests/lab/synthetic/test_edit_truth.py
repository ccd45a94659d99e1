"""Edits of the street generator: our own reader understands them, and the truth shows them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightsim.scenario.asset_library import AssetLibrary
from lightsim.scenario.edits import Ego, Insert, Move, Remove, parse_scenario
from lightsim.store.meshes import write_glb
from lightsim_lab.synthetic.edit_truth import model_of
from lightsim_lab.synthetic.edits import INSERTED_ID, TrueEdit, absent, choose_edits, staged_street
from lightsim_lab.synthetic.geometry import Snapshot
from lightsim_lab.synthetic.participants import Participant
from lightsim_lab.synthetic.plan import StreetConfig, plan_street
from lightsim_lab.synthetic.rig import mount_cameras
from lightsim_lab.synthetic.skies import build_sky, sky_specs
from lightsim_lab.synthetic.street import Street, build_street
from lightsim_lab.synthetic.truth import compute_buffers
from lightsim_lab.synthetic.writer import camera_pose


@pytest.fixture(scope="module")
def street() -> Street:
    return staged_street(build_street(plan_street(3), 13.0))


@pytest.fixture(scope="module")
def edits(street: Street) -> dict[str, TrueEdit]:
    """Chosen by two cameras, coarser than any real one."""
    config = replace(StreetConfig(), width_px=160, height_px=90, truth_stems=(3,))
    cameras = mount_cameras(street.plan, config)
    cameras = tuple(m for m in cameras if m.camera.name in ("front_camera", "back_camera"))
    sun = build_sky(sky_specs(street.plan)[0], street.plan, 64).sun
    assert sun is not None
    return {e.name: e for e in choose_edits(street, config, cameras, sun.direction_world)}


def test_our_own_reader_understands_the_edits(edits: dict[str, TrueEdit]) -> None:
    kinds = {"remove": Remove, "move": Move, "insert": Insert, "ego": Ego}
    assert {name.split("-")[0] for name in edits} == {*kinds, "none"}
    for name, edit in edits.items():
        value = {"version": 1, "name": name, "edits": list(edit.entries)}
        read = parse_scenario(value, Path("SCENARIO.json")).edits
        assert [type(e) for e in read] == [kinds[name.split("-")[0]] for _ in edit.entries]
        assert edit.views


def _centres(cast: tuple[Participant, ...]) -> np.ndarray:
    return np.array([a.street_from_actor(0.3).translation_m for a in cast])


def test_an_edit_changes_one_participant_and_keeps_all_numbers(
    street: Street, edits: dict[str, TrueEdit]
) -> None:
    ids = [a.actor_id for a in street.participants]
    for name, edit in edits.items():
        assert [a.actor_id for a in edit.participants] == ids
        step = _centres(edit.participants) - _centres(street.participants)
        changed = np.flatnonzero(np.abs(step).max(axis=1) > 0).tolist()
        if name.startswith(("none", "ego")):
            assert not changed
            continue
        named = edit.entries[0].get("actor", INSERTED_ID)
        assert [ids[i] for i in changed] == [named]
        if name.startswith("move"):
            ahead_m = edit.entries[0]["offset_m"][0]
            assert np.linalg.norm(step[changed]) == pytest.approx(abs(ahead_m))


def test_the_truth_of_a_removal_differs_only_by_the_car_and_its_shadow(
    street: Street, edits: dict[str, TrueEdit]
) -> None:
    config = replace(StreetConfig(), width_px=160, height_px=90)
    sky = build_sky(sky_specs(street.plan)[0], street.plan, 64)
    edit = edits["remove-parked"]
    number = [a.actor_id for a in street.participants].index(edit.entries[0]["actor"])
    view = edit.views[0]
    pose = camera_pose(street.plan, config, view.mounted, view.time_s)
    before, after = (
        compute_buffers(
            Snapshot(
                street,
                [street.plan.world_from_street @ a.street_from_actor(view.time_s) for a in people],
            ),
            view.mounted.camera,
            pose,
            sky,
        )
        for people in (street.participants, edit.participants)
    )
    is_car = before["actor_index"] == number
    assert is_car.sum() > 20
    assert not (after["actor_index"] == number).any()
    assert (before["depth_z_m"] == after["depth_z_m"])[~is_car].all()
    gained = (after["sun_visibility"] - before["sun_visibility"])[~is_car]
    assert gained.min() >= 0
    assert (gained > 0.5).sum() > 5


def test_the_inserted_model_reads_as_the_car_that_the_truth_shows(
    street: Street, tmp_path: Path
) -> None:
    model = model_of(street)
    write_glb(tmp_path / "car.glb", model)
    asset = AssetLibrary(tmp_path, {}, tmp_path).load("car.glb")
    np.testing.assert_allclose(
        np.sort(asset.mesh.vertices, axis=0), np.sort(model.vertices, axis=0), atol=1e-5
    )
    bonnet = asset.mesh.vertices[asset.mesh.vertices[:, 0] > 2.0]
    assert bonnet[:, 2].max() < 0.3
    roughness = {m.name: m.roughness for m in asset.mesh.materials}
    assert roughness["car_glass"] == pytest.approx(0.12)
    car = street.participants[-1]
    assert car.actor_id == INSERTED_ID
    assert car.start_m == absent(car).start_m
