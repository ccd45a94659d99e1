"""Writer of scenario.json: a scenario, with the actors' boxes of every frame as labels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightsim.core.actors import ActorTrack
from lightsim.core.frames import Trajectory
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.store.artefact import write_json

SCENARIO_NAME = "scenario.json"


def write_scenario(folder: Path, scenario: Scenario, **found: Any) -> None:
    """Write FOLDER/scenario.json, which `lightsim simulate` accepts as SCENARIO.json.

    Args:
        folder: existing folder.
        scenario: the scenario; poses of all actors and frames are written, too.
        found: further entries for people, such as facts of the sky and settings.
    """
    sky = scenario.sky
    write_json(
        folder / SCENARIO_NAME,
        {
            # Version of the file's format.
            "version": 1,
            "name": scenario.name,
            "sky": None if sky is None else sky.sky,
            "sky_yaw_deg": None if sky is None else sky.yaw_deg,
            "sky_scale": None if sky is None else sky.scale,
            "move_sun": None if sky is None else sky.move_sun,
            "sun_factor": None if sky is None else sky.sun_factor,
            "edits": scenario.edits,
            "seed": scenario.seed,
            "notes": scenario.notes,
            **found,
            **scenario_entries(scenario),
        },
    )


def scenario_entries(scenario: Scenario) -> dict[str, Any]:
    """Return the entries of scenario.json with cameras, poses and boxes."""
    ego = scenario.ego
    return {
        "cameras": scenario.cameras,
        "ego": None if ego is None else _poses(ego),
        "actors": [_actor(scenario, track) for track in scenario.tracks],
        "frames": [_frame(scenario, frame) for frame in scenario.frames],
    }


def _poses(trajectory: Trajectory) -> dict[str, Any]:
    name = f"{trajectory.dst}_from_{trajectory.src}"
    return {"times_ns": trajectory.times_ns, name: trajectory.matrices}


def _box(scenario: Scenario, track: ActorTrack) -> dict[str, Any]:
    return {
        "actor_id": track.actor_id,
        "number": scenario.number_by_actor[track.actor_id],
        "kind": track.kind,
        "label": track.label,
        "size_lwh_m": track.size_lwh_m,
    }


def _actor(scenario: Scenario, track: ActorTrack) -> dict[str, Any]:
    assets = [p.asset.actor_id for p in scenario.placements if p.track is track]
    return {
        **_box(scenario, track),
        "is_moving": track.is_moving,
        "is_removed": track.actor_id in scenario.removed,
        "asset": assets[0] if assets else None,
        **_poses(track.trajectory),
    }


def _frame(scenario: Scenario, frame: ScenarioFrame) -> dict[str, Any]:
    return {
        "camera": frame.camera_name,
        "frame": frame.stem,
        "source": frame.source,
        "time_ns": frame.time_ns,
        "world_from_camera": frame.world_from_camera.matrix,
        "actors": [
            {
                **_box(scenario, track),
                "world_from_actor": track.world_from_actor(frame.time_ns).matrix,
            }
            for track in scenario.tracks_at(frame.time_ns)
        ],
    }
