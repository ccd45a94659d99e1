"""The shared page: a twin, its sky, actors and cameras as one HTML file that needs no server."""

from __future__ import annotations

import socket
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lightsim.app import scene
from lightsim.app.meshes import view_meshes
from lightsim.app.sky import sun_arc
from lightsim.build.workspace import Workspace
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.errors import InputError, need
from lightsim.progress import Progress
from lightsim.store.artefact import write_text

if TYPE_CHECKING:
    import viser

_LOOPBACK = "127.0.0.1"
# Initial camera: position and looked-at point in frame `ego`, metres, and vertical field of view.
# Behind and above the ego vehicle, whose cameras are then in the picture. Chosen.
_EYE_EGO, _TARGET_EGO, _FOV_DEG = (-9.0, 0.0, 4.5), (12.0, 0.0, 0.5), 60.0


def write_page(workspace: Workspace, path: Path, stem: str, progress: Progress) -> None:
    """Write one HTML file with everything at a frame: twin, actors, sky, day's arc and cameras.

    Args:
        stem: of the frame.

    Raises:
        InputError: no such frame, or the folder of the file does not exist.
        ArtefactError: the twin has not been built.
        MissingDependencyError: viser is not installed.
    """
    need("viser", extra="view")
    time_ns = time_of(workspace.log, stem)
    with loopback_server() as server:
        fill(server, workspace, stem, time_ns, progress)
        html = server.get_scene_serializer().as_html()
    write_text(path, html)


def time_of(log: DrivingLog, stem: str) -> int:
    """Return the time of the first camera's frame with a stem.

    Raises:
        InputError: no such frame.
    """
    times = [frame.time_ns for frame in log.frames if frame.stem == stem]
    if not times:
        raise InputError(
            "the log has no such frame",
            where=log.name,
            got=stem,
            expected=f"{', '.join(log.stems)}",
        )
    return times[0]


def fill(
    server: viser.ViserServer, workspace: Workspace, stem: str, time_ns: int, progress: Progress
) -> None:
    """Add the recorded scene at a frame, and set the initial camera behind the ego vehicle."""
    log, dome = workspace.log, workspace.sky.dome
    meshes = view_meshes(workspace, progress)
    world_from_ego = log.ego.held(time_ns)
    centre = world_from_ego.translation_m
    scene.show_twin(server.scene, meshes)
    scene.show_sky(server.scene, dome, centre)
    scene.show_lights(server.scene, dome)
    utc = None if log.geo is None or log.geo.clock is None else log.geo.clock.utc_minus_log_ns
    arc = None if log.geo is None or utc is None else sun_arc(log.geo, time_ns + utc)
    recorded = None if dome.sun is None else dome.sun.direction_world
    scene.show_sun_arc(server.scene, arc, recorded, centre)
    frames = [frame for frame in log.frames if frame.stem == stem]
    scene.show_cameras(server.scene, log.cameras, frames)
    actors = scene.show_actors(server.scene, log.actors, meshes.glb_by_actor)
    scene.place_actors(actors, log.actors, time_ns)
    scene.show_paths(server.scene, log.actors)
    look_ahead(server, world_from_ego)


def look_ahead(server: viser.ViserServer, world_from_ego: RigidTransform) -> None:
    """Set the initial camera of new clients behind the ego vehicle, looking ahead."""
    camera = server.initial_camera
    camera.up = (0.0, 0.0, 1.0)
    camera.position = world_from_ego.apply(np.array(_EYE_EGO))
    camera.look_at = world_from_ego.apply(np.array(_TARGET_EGO))
    camera.fov = np.radians(_FOV_DEG)


@contextmanager
def loopback_server() -> Generator[viser.ViserServer]:
    """Run viser's server, which serialises scenes, on a free port of this machine alone."""
    import viser

    with socket.socket() as probe:
        probe.bind((_LOOPBACK, 0))
        port = probe.getsockname()[1]
    server = viser.ViserServer(host=_LOOPBACK, port=port, verbose=False)
    try:
        yield server
    finally:
        server.stop()
