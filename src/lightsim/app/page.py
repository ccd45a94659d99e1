"""The shared page: a twin, its sky, actors and cameras as one HTML file that needs no server."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lightsim.app import scene
from lightsim.app.baked import LightTracer
from lightsim.app.meshes import ViewMeshes
from lightsim.app.server import LOOPBACK, open_server, stop_server
from lightsim.app.sky import arc_of_log
from lightsim.build.workspace import Workspace
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.sensors import CameraFrame
from lightsim.errors import InputError, need
from lightsim.progress import Progress
from lightsim.store.artefact import write_text

if TYPE_CHECKING:
    import viser

# Position of the initial camera in frame `ego`, metres: behind and above the ego vehicle, so that
# its cameras are visible. Chosen.
_EYE_EGO = (-9.0, 0.0, 4.5)
# Point at which it looks, frame `ego`, metres. Chosen.
_TARGET_EGO = (12.0, 0.0, 0.5)
# Its vertical field of view, degrees. Chosen.
_FOV_DEG = 60.0


def write_page(workspace: Workspace, path: Path, stem: str, progress: Progress) -> None:
    """Write one HTML file with everything at a frame: twin, actors, sky, day's arc and cameras.

    Args:
        stem: of the frame.

    Raises:
        InputError: no such frame, or the folder of the file does not exist.
        ArtefactError: the twin has not been built.
        MissingDependencyError: viser is not installed.
    """
    need("viser", extra="view")  # before the seconds of the light
    frames = frames_of(workspace.log, stem)
    meshes = LightTracer(workspace).recorded(frames, progress)
    # Viser's server serialises scenes; no client connects to it.
    server = open_server(LOOPBACK[0], 0)
    try:
        fill(server, workspace, frames, meshes)
        html = server.get_scene_serializer().as_html()
    finally:
        stop_server(server)
    write_text(path, html)


def frames_of(log: DrivingLog, stem: str) -> tuple[CameraFrame, ...]:
    """Return the frames of all cameras with a stem.

    Raises:
        InputError: there is none.
    """
    frames = tuple(frame for frame in log.frames if frame.stem == stem)
    if not frames:
        raise InputError(
            "the log has no such frame",
            where=log.name,
            got=stem,
            expected=f"one of {', '.join(log.stems)}",
        )
    return frames


def fill(
    server: viser.ViserServer,
    workspace: Workspace,
    frames: Sequence[CameraFrame],
    meshes: ViewMeshes,
) -> None:
    """Add the recorded scene at the frames of one stem, with lit meshes."""
    log, dome, time_ns = workspace.log, workspace.sky.dome, frames[0].time_ns
    world_from_ego = log.ego.held(time_ns)
    centre = world_from_ego.translation_m
    scene.show_twin(server.scene, meshes)
    scene.show_sky(server.scene, dome, centre)
    recorded = None if dome.sun is None else dome.sun.direction_world
    scene.show_sun_arc(server.scene, arc_of_log(log, time_ns), recorded, centre)
    scene.show_cameras(server.scene, log.cameras, frames)
    present = [track for track in log.actors if track.is_present(time_ns)]
    actors = scene.show_actors(server.scene, present, meshes.glb_by_actor)
    scene.place_actors(actors, present, time_ns)
    scene.show_paths(server.scene, log.actors)
    set_initial_camera(server, world_from_ego)


def set_initial_camera(server: viser.ViserServer, world_from_ego: RigidTransform) -> None:
    """Set the initial camera of new clients behind the ego vehicle, looking ahead."""
    camera = server.initial_camera
    camera.up = (0.0, 0.0, 1.0)
    camera.position = world_from_ego.apply(np.array(_EYE_EGO))
    camera.look_at = world_from_ego.apply(np.array(_TARGET_EGO))
    camera.fov = np.radians(_FOV_DEG)
