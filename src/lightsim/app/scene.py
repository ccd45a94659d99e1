"""Display-only nodes of the viewer's scene: twin, sky, cameras, actors and paths.

Each function adds nodes to viser's scene and returns their handles. Frame `world` is the scene's
own: viser's scenes are z up.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float64, UInt8

from lightsim.app.meshes import ViewMeshes
from lightsim.app.sky import DOME_RADIUS_M, SunArc, dome_glb
from lightsim.core.actors import ActorTrack
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome, disc_directions
from lightsim.core.frames import RigidTransform, quaternion_from_matrix
from lightsim.core.sensors import CameraFrame
from lightsim.store.names import file_names

if TYPE_CHECKING:
    import viser

# Edges of a box as pairs of the corners of `ActorTrack.corners_actor`, whose indices have one bit
# per axis: corners of an edge differ in one bit.
_EDGES = np.array([(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])
# Distance of lines on the dome from the centre, as a fraction of the dome's radius: in front of it.
_ON_DOME = 0.98
# Radius of the ring around the recorded sun, degrees. Chosen.
_RING_DEG = 2.5
# Radius of the hour marks, degrees. Chosen.
_MARK_DEG = 0.8
# Volume of the pyramid of a camera is that of a cube with this edge, metres.
_FRUSTUM_M = 1.0
# Widest picture on a camera's pyramid, pixels.
_PICTURE_PX = 480
# Colour of the day's arc.
_ARC_RGB = (255, 196, 64)
# Colour of the recorded sun's ring.
_SUN_RGB = (255, 240, 120)
# Colour of boxes.
_BOX_RGB = (64, 200, 255)
# Colour of paths.
_PATH_RGB = (96, 220, 130)
# Colour of camera pyramids.
_CAMERA_RGB = (235, 235, 235)


@dataclass(frozen=True, eq=False)
class TwinHandles:
    """Static scene, and the unobserved surfaces that cast shadows."""

    background: viser.GlbHandle
    inferred: viser.GlbHandle | None


@dataclass(frozen=True, eq=False)
class ArcHandles:
    """Arc of the day, hour marks with labels, and the ring around the recorded sun; None where
    unknown."""

    parent: viser.FrameHandle
    arc: viser.LineSegmentsHandle | None
    hours: tuple[viser.LabelHandle, ...]
    recorded: viser.LineSegmentsHandle | None


@dataclass(frozen=True, eq=False)
class ActorHandle:
    """One actor: its pose is that of `frame`; box and mesh are children."""

    frame: viser.FrameHandle
    box: viser.LineSegmentsHandle
    mesh: viser.GlbHandle | None


def show_twin(scene: viser.SceneApi, meshes: ViewMeshes) -> TwinHandles:
    """Add the static scene, which has its light, and switch the client's own lights off."""
    scene.configure_default_lights(enabled=False)
    # By default the client also lights the scene by its built-in picture of a warehouse.
    scene.configure_environment_map(None)
    background = scene.add_glb("/twin/background", meshes.background)
    if meshes.inferred is None:
        return TwinHandles(background, None)
    return TwinHandles(background, scene.add_glb("/twin/inferred", meshes.inferred))


def show_sky(
    scene: viser.SceneApi,
    dome: SkyDome,
    centre_world_m: Float[np.ndarray, "3"],
    exposure_ev: float = 0.0,
) -> viser.GlbHandle:
    """Add the sky dome around a point, such as the ego vehicle; it moves with `handle.position`."""
    return scene.add_glb(
        "/sky/dome",
        dome_glb(dome, exposure_ev),
        position=centre_world_m,
    )


def set_sky(handle: viser.GlbHandle, dome: SkyDome, exposure_ev: float = 0.0) -> None:
    """Show another sky on the dome."""
    handle.glb_data = dome_glb(dome, exposure_ev)


def show_cameras(
    scene: viser.SceneApi,
    cameras: Mapping[str, PinholeCamera],
    frames: Iterable[CameraFrame],
) -> dict[str, viser.CameraFrustumHandle]:
    """Add a pyramid with the recorded picture for each frame of different cameras.

    Returns:
        The handles by the camera's name.
    """
    names = file_names(cameras)
    return {
        frame.camera_name: _show_camera(scene, names, cameras[frame.camera_name], frame)
        for frame in frames
    }


def set_camera(handle: viser.CameraFrustumHandle, frame: CameraFrame) -> None:
    """Show another frame of the same camera."""
    handle.wxyz, handle.position = _pose(frame.world_from_camera)
    handle.image = _small(frame.load_srgb8())


def _show_camera(
    scene: viser.SceneApi, names: Mapping[str, str], camera: PinholeCamera, frame: CameraFrame
) -> viser.CameraFrustumHandle:
    wxyz, position = _pose(frame.world_from_camera)
    return scene.add_camera_frustum(
        f"/cameras/{names[camera.name]}",
        vertical_fov_rad(camera),
        aspect(camera),
        scale=_FRUSTUM_M,
        color=_CAMERA_RGB,
        image=_small(frame.load_srgb8()),
        format="jpeg",
        wxyz=wxyz,
        position=position,
    )


def vertical_fov_rad(camera: PinholeCamera) -> float:
    """Return the vertical field of view; the offset of the principal point is not included."""
    return 2.0 * float(np.arctan(camera.height_px / (2.0 * camera.fy)))


def aspect(camera: PinholeCamera) -> float:
    """Return width over height of the image plane, which differ from pixels if fx and fy do."""
    return camera.width_px / camera.fx / (camera.height_px / camera.fy)


def _small(srgb8: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Return every n-th pixel, so that the picture is at most `_PICTURE_PX` wide."""
    step = -(-srgb8.shape[1] // _PICTURE_PX)
    return np.ascontiguousarray(srgb8[::step, ::step])


def show_sun_arc(
    scene: viser.SceneApi,
    arc: SunArc | None,
    recorded_world: Float[np.ndarray, "3"] | None,
    centre_world_m: Float[np.ndarray, "3"],
) -> ArcHandles:
    """Add the arc of the day with hour marks (UTC) and a ring around the recorded sun.

    All are children of one frame at the centre of the dome.

    Args:
        arc: None where it is unknown.
        recorded_world: unit vector towards the recorded sun; None where it is unknown.
    """
    parent = scene.add_frame("/sky/arc", show_axes=False, position=centre_world_m)
    hours: list[viser.LabelHandle] = []
    line = None
    if arc is not None:
        marks = [_ring(way, _MARK_DEG) for way in arc.hours.values()]
        points = np.concatenate([segments(arc.directions_world), *marks])
        line = _line(scene, "/sky/arc/day", points * _ON_DOME * DOME_RADIUS_M, _ARC_RGB)
        for hour, way in arc.hours.items():
            place = way * _ON_DOME * DOME_RADIUS_M
            hours.append(scene.add_label(f"/sky/arc/{hour:02}", f"{hour:02}:00", position=place))
    ring = None
    if recorded_world is not None:
        points = _ring(recorded_world, _RING_DEG) * _ON_DOME * DOME_RADIUS_M
        ring = _line(scene, "/sky/arc/recorded", points, _SUN_RGB)
    return ArcHandles(parent, line, tuple(hours), ring)


def _ring(direction: Float[np.ndarray, "3"], radius_deg: float) -> Float64[np.ndarray, "n 2 3"]:
    """Return the segments of a circle on the unit sphere."""
    across = disc_directions(direction, 90.0, 1)[0]
    across -= (across @ direction) * direction
    across /= np.linalg.norm(across)
    angle = np.linspace(0.0, 2 * np.pi, 33)[:, None]
    side = np.cos(angle) * across + np.sin(angle) * np.cross(direction, across)
    radius = np.radians(radius_deg)
    return segments(np.cos(radius) * direction + np.sin(radius) * side)


def show_actors(
    scene: viser.SceneApi, tracks: Iterable[ActorTrack], glb_by_actor: Mapping[str, bytes]
) -> dict[str, ActorHandle]:
    """Add box and mesh of each actor, hidden until `place_actor` is called; by actor id."""
    track_by_id = {track.actor_id: track for track in tracks}
    return {
        actor_id: show_actor(scene, name, track_by_id[actor_id], glb_by_actor.get(actor_id))
        for actor_id, name in file_names(track_by_id).items()
    }


def show_actor(
    scene: viser.SceneApi, name: str, track: ActorTrack, glb: bytes | None
) -> ActorHandle:
    """Add box and mesh of one actor as the node /actors/NAME, hidden.

    Args:
        name: without a slash, which would make a child of another node.
        glb: None for an actor that was not reconstructed.
    """
    frame = scene.add_frame(f"/actors/{name}", show_axes=False, visible=False)
    box = scene.add_line_segments(
        f"/actors/{name}/box", track.corners_actor[_EDGES], _BOX_RGB, thickness=0.03
    )
    mesh = None if glb is None else scene.add_glb(f"/actors/{name}/mesh", glb)
    return ActorHandle(frame, box, mesh)


def place_actor(handle: ActorHandle, world_from_actor: RigidTransform | None) -> None:
    """Show an actor at a pose; None hides it."""
    handle.frame.visible = world_from_actor is not None
    if world_from_actor is not None:
        handle.frame.wxyz, handle.frame.position = _pose(world_from_actor)


def place_actors(
    handles: Mapping[str, ActorHandle], tracks: Iterable[ActorTrack], time_ns: int
) -> None:
    """Show the actors where they are at a time, and hide those that are not present."""
    poses = {t.actor_id: t.world_from_actor(time_ns) for t in tracks if t.is_present(time_ns)}
    for actor_id, handle in handles.items():
        place_actor(handle, poses.get(actor_id))


def show_paths(
    scene: viser.SceneApi, tracks: Iterable[ActorTrack]
) -> dict[str, viser.LineSegmentsHandle]:
    """Add the paths of the moving actors at the lower side of their boxes; by actor id."""
    track_by_id = {t.actor_id: t for t in tracks if t.is_moving and len(t.trajectory) > 1}
    handles: dict[str, viser.LineSegmentsHandle] = {}
    for actor_id, name in file_names(track_by_id).items():
        track = track_by_id[actor_id]
        below = track.trajectory.positions_m - [0.0, 0.0, track.size_lwh_m[2] / 2]
        handles[actor_id] = _line(scene, f"/paths/{name}", segments(below), _PATH_RGB)
    return handles


def segments(points: Float[np.ndarray, "n 3"]) -> Float64[np.ndarray, "m 2 3"]:
    """Return the pieces of a polyline."""
    return np.stack([points[:-1], points[1:]], axis=1).astype(np.float64)


def _line(
    scene: viser.SceneApi,
    name: str,
    points: Float64[np.ndarray, "n 2 3"],
    colour: tuple[int, int, int],
) -> viser.LineSegmentsHandle:
    return scene.add_line_segments(name, points, colour, thickness=2.0, thickness_units="screen")


def _pose(
    world_from_node: RigidTransform,
) -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "3"]]:
    """Return rotation (quaternion, w first) and position of a node."""
    return quaternion_from_matrix(world_from_node.rotation), world_from_node.translation_m
