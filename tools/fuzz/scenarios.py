"""SCENARIO.json from strangers, with the models that it names."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from lightsim.scenario.edits import read_scenario_request
from lightsim.simulation.claims import opened_for
from lightsim.simulation.edited import asset_library, edited_scenario
from lightsim.simulation.options import SimulateOptions
from lightsim.simulation.relight import replayed
from lightsim.store.artefact import read_json

from .containers import mutate_glb
from .mutations import Rng, mutate_json, pick
from .seeds import Seeds

_ASSETS = (
    "cone", "car", "truck", "model.glb", "./model.glb", "work#{actor}", "nowhere.glb", "nowhere",
    "../../model.glb", "/dev/zero", "/dev/zero.glb", "work#nobody", "#", "scenario.json", "a\0.glb",
    "scenario.json#x", "~", "", "x" * 5000, "work/twin/background.glb",
)  # fmt: skip
_ACTORS = ("{actor}", "all", "all-moving", "nobody", "", "\0", "{actor} ", "new")


def write_scenario_case(seeds: Seeds, folder: Path, rng: Rng) -> str:
    """An honest scenario with every kind of edit; damage to it, to its model, or to its words."""
    shutil.copytree(seeds.work, folder / "work")
    shutil.copyfile(next((seeds.work / "twin" / "actors").glob("*.glb")), folder / "model.glb")
    actors = [entry["actor_id"] for entry in read_json(seeds.work / "twin" / "twin.json")["actors"]]
    scenario = _honest(actors)
    path = folder / "scenario.json"
    way = rng.random()
    words = "honest"
    if way < 0.3:
        edit = pick(rng, [e for e in scenario["edits"] if "asset" in e or "actor" in e])
        key = "asset" if "asset" in edit else "actor"
        edit[key] = pick(rng, _ASSETS if key == "asset" else _ACTORS).format(actor=actors[0])
        words = f"{key} {edit[key]!r:.60}"
    path.write_text(json.dumps(scenario))
    if 0.3 <= way < 0.45:
        words = mutate_glb(folder / "model.glb", rng)
    elif way >= 0.45:
        # Most of what can be wrong is in the edits.
        part = scenario["edits"] if rng.random() < 0.8 else scenario
        data, words = mutate_json(json.dumps(part).encode(), rng)
        head = json.dumps({**scenario, "edits": "@"}).encode()
        path.write_bytes(head.replace(b'"@"', data) if part is scenario["edits"] else data)
    return words


def _honest(actors: list[str]) -> dict:
    path = [
        {"time_s": 0.0, "x_m": 1.0, "y_m": 2.0},
        {"time_s": 0.1, "x_m": 2.0, "y_m": 2.5},
        {"time_s": 0.2, "x_m": 3.5, "y_m": 2.0},
    ]
    edits = [
        {"do": "remove", "actor": actors[0]},
        {"do": "move", "actor": actors[1], "offset_m": [1.0, 0.5, 0.0]},
        {"do": "move", "actor": actors[1], "trajectory": path},
        {"do": "insert", "asset": "cone", "at": {"x_m": 3.0, "y_m": 1.0, "yaw_deg": 30.0}},
        {"do": "insert", "asset": "model.glb", "id": "new", "trajectory": path},
        {"do": "ego", "offset_m": [0.0, 1.0, 0.0]},
    ]
    return {"version": 1, "name": "edited", "sky": "source", "edits": edits}


def read_scenario(folder: Path) -> None:
    """`lightsim simulate` up to the frames: where everybody stands, and with which shape."""
    asked = read_scenario_request(folder / "scenario.json")
    options = SimulateOptions().completed(asked.name, asked.sky)
    with opened_for(folder / "work", options) as workspace:
        library = asset_library(folder / "library", folder)
        scenario = edited_scenario(workspace, replayed(workspace, options), asked, library)
    for frame in scenario.frames:
        matrices = [frame.world_from_camera.matrix]
        for placement in scenario.placements_at(frame.time_ns):
            matrices.append(placement.world_from_actor(frame.time_ns).matrix)
            matrices.append(placement.mesh_at(frame.time_ns).vertices)
        if not all(np.isfinite(matrix).all() for matrix in matrices):
            raise AssertionError("accepted, but not finite")
    if len(scenario.number_by_actor) != len(scenario.tracks):
        raise AssertionError("accepted, but two actors have one number")
