"""The 3D scene of the viewer: twin, sky with the sun's handle, cameras, and the actors' boxes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from jaxtyping import Float

from lightsim.app import scene
from lightsim.app.baked import actor_surface
from lightsim.app.editor import ActorBox
from lightsim.app.glb import unlit_glb
from lightsim.app.meshes import ViewMeshes
from lightsim.app.sky import arc_of_log
from lightsim.build.workspace import Workspace
from lightsim.core.dome import SkyDome
from lightsim.core.scenario import Scenario
from lightsim.store.names import file_names

if TYPE_CHECKING:
    import viser

# Distance of the sun's handle, metres: nearer than the farthest depth that a picture behind the
# scene can have.
_SUN_M = 140.0
# Its radius, metres: 2 degrees wide. Chosen.
_SUN_RADIUS_M = 2.5
# Colour of the sun's handle.
_SUN_RGB = (255, 214, 64)
# Colour of the boxes of recorded actors.
_BOX_RGB = (64, 200, 255)
# Colour of the boxes of edited actors.
_EDITED_RGB = (96, 220, 130)
# Colour of boxes in conflict.
_CONFLICT_RGB = (255, 64, 48)
# Colour of the selected actor's box.
_SELECTED_RGB = (255, 255, 255)


class SceneView:
    """Nodes of one log in viser's scene.

    Args:
        server: of the viewer.
        workspace: with the twin.
        meshes: of the twin, in the light of the recorded sky.
        recorded: the log without edits.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        workspace: Workspace,
        meshes: ViewMeshes,
        recorded: Scenario,
    ) -> None:
        self._server = server
        self._log = log = workspace.log
        self._dome = dome = workspace.sky.dome
        nodes = server.scene
        self._twin = scene.show_twin(nodes, meshes)
        self._centre = log.ego.held(log.frames[0].time_ns).translation_m
        self._sky = scene.show_sky(nodes, dome, self._centre)
        self._exposure_ev = 0.0
        arc = arc_of_log(log, log.frames[0].time_ns)
        recorded_sun = None if dome.sun is None else dome.sun.direction_world
        self._arc = scene.show_sun_arc(nodes, arc, recorded_sun, self._centre)
        self._sun = nodes.add_glb("/sky/sun", _sun_glb())
        first = {frame.camera_name: frame for frame in reversed(log.frames)}
        self._cameras = scene.show_cameras(nodes, log.cameras, first.values())
        self._actors = scene.show_actors(nodes, recorded.tracks, meshes.glb_by_actor)
        self._on_click: Callable[[str], None] = lambda _: None
        for actor_id in self._actors:
            self._make_clickable(actor_id)
        self._paths = scene.show_paths(nodes, recorded.tracks)
        self._direction: Float[np.ndarray, "3"] | None = recorded_sun
        self._place_sun()
        self._is_looking = False

    def on_select(self, act: Callable[[str], None]) -> None:
        """Call `act` with the id of an actor that a user clicks."""
        self._on_click = act

    def on_sun_dragged(self, act: Callable[[Float[np.ndarray, "3"], bool], None]) -> None:
        """Call `act` with the unit vector to which a user drags the sun, and whether it begins."""

        @self._sun.on_drag("left")
        async def _(event: Any) -> None:
            towards = np.array(event.end_position) - self._centre
            act(towards / np.linalg.norm(towards), event.phase == "start")

    def show_stem(self, stem: str) -> None:
        """Move sky and cameras to a frame."""
        for frame in self._log.frames:
            if frame.stem == stem:
                scene.set_camera(self._cameras[frame.camera_name], frame)
                self._centre = self._log.ego.held(frame.time_ns).translation_m
        self._sky.position = self._arc.parent.position = self._centre
        self._place_sun()

    def show_sun(self, direction_world: Float[np.ndarray, "3"] | None) -> None:
        """Move the sun's handle; None hides it."""
        self._direction = direction_world
        self._place_sun()

    def show_sky(self, dome: SkyDome, exposure_ev: float) -> None:
        """Show another sky on the dome; the light of the meshes changes with `show_meshes`."""
        if (dome, exposure_ev) == (self._dome, self._exposure_ev):
            return
        self._dome, self._exposure_ev = dome, exposure_ev
        scene.set_sky(self._sky, dome, exposure_ev)
        self.show_sun(None if dome.sun is None else dome.sun.direction_world)

    def show_meshes(self, meshes: ViewMeshes) -> None:
        """Show twin and actors in another light."""
        shown = [(self._twin.background, meshes.background), (self._twin.inferred, meshes.inferred)]
        for actor_id, glb in meshes.glb_by_actor.items():
            if actor_id in self._actors:
                shown.append((self._actors[actor_id].mesh, glb))
        for handle, glb in shown:
            # Unchanged meshes are not sent again.
            if handle is not None and glb is not None and handle.glb_data != glb:
                handle.glb_data = glb

    def show_actors(
        self, scenario: Scenario, boxes: Mapping[str, ActorBox], selected: str | None
    ) -> None:
        """Place the actors of a scenario; edited ones, and those in conflict, are coloured.

        Until `show_meshes`, moved actors keep their light, and inserted ones are lit like open
        ground.
        """
        for placement in scenario.placements:
            track = placement.track
            if track.actor_id not in self._actors:
                names = file_names([*self._actors, track.actor_id])
                self._actors[track.actor_id] = scene.show_actor(
                    self._server.scene,
                    names[track.actor_id],
                    track,
                    actor_surface(placement.asset.mesh).lit_by_open_sky(
                        self._dome, self._exposure_ev
                    ),
                )
                self._make_clickable(track.actor_id)
        for actor_id, handle in self._actors.items():
            box = boxes.get(actor_id)
            scene.place_actor(handle, None if box is None else box.world_from_actor)
            if box is not None:
                colour = np.array(_colour(box, actor_id == selected), np.uint8)
                handle.box.colors = np.broadcast_to(colour, (12, 2, 3))
        if self._is_looking:
            self.set_camera_view(True)

    def set_camera_view(self, is_camera_view: bool) -> None:
        """Hide the objects that the background picture shows: twin, sky and meshes of actors."""
        self._is_looking = is_camera_view
        self._sky.visible = self._twin.background.visible = not is_camera_view
        if self._twin.inferred is not None:
            self._twin.inferred.visible = not is_camera_view
        for handle in self._cameras.values():
            handle.visible = not is_camera_view
        for actor in self._actors.values():
            if actor.mesh is not None:
                actor.mesh.visible = not is_camera_view

    def _place_sun(self) -> None:
        self._sun.visible = self._direction is not None
        if self._direction is not None:
            self._sun.position = self._centre + _SUN_M * self._direction

    def _make_clickable(self, actor_id: str) -> None:
        mesh = self._actors[actor_id].mesh
        if mesh is None:
            return

        @mesh.on_click
        async def _(_: Any) -> None:
            self._on_click(actor_id)


def _sun_glb() -> bytes:
    """Return the sun's handle: a ball without shading."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=_SUN_RADIUS_M)
    vertices = ball.vertices.astype(np.float32)
    uv = np.zeros((len(vertices), 2), np.float32)
    colour = np.broadcast_to(np.array(_SUN_RGB, np.uint8), (8, 8, 3))
    return unlit_glb(vertices, ball.faces.astype(np.int32), uv, np.ascontiguousarray(colour))


def _colour(box: ActorBox, is_selected: bool) -> tuple[int, int, int]:
    if box.is_in_conflict:
        return _CONFLICT_RGB
    if is_selected:
        return _SELECTED_RGB
    return _EDITED_RGB if box.is_edited else _BOX_RGB
