"""Handles with which a user drags and turns an actor, or the waypoints of its path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from lightsim.app.editor import ActorBox
from lightsim.app.paths import headings_deg
from lightsim.core.frames import quaternion_from_matrix
from lightsim.scenario.edits import Path3, Waypoint

if TYPE_CHECKING:
    import viser

# Size of the handle of an actor, in metres. Chosen.
_ACTOR_M = 3.0
# Size of the handle of a waypoint, in metres. Chosen.
_POINT_M = 1.2


class Gizmos:
    """Handles for one actor: one at its box, or one at each waypoint.

    Args:
        nodes: viser's scene.
        on_box: called with the new place and the phase (start, update, end) of a drag of the box.
        on_point: the same with the number of the waypoint first.
    """

    def __init__(
        self,
        nodes: viser.SceneApi,
        on_box: Callable[[Waypoint, str], None],
        on_point: Callable[[int, Waypoint, str], None],
    ) -> None:
        self._nodes = nodes
        self._on_box, self._on_point = on_box, on_point
        self._box = self._handle("/edit/actor", _ACTOR_M, on_box)
        self._points: list[viser.TransformControlsHandle] = []
        self._headings_deg: list[float] = []

    def show_box(self, box: ActorBox | None) -> None:
        """Show the handle at a box; None hides it."""
        self._hide_points()
        self._box.visible = box is not None
        if box is not None:
            self._box.position = box.world_from_actor.translation_m
            yaw = Rotation.from_euler("z", box.world_from_actor.yaw_rad).as_matrix()
            self._box.wxyz = quaternion_from_matrix(yaw)

    def show_path(self, path: Path3, heights_m: Sequence[float]) -> None:
        """Show a handle at each waypoint.

        Args:
            heights_m: height of each handle, frame `world`.
        """
        self._box.visible = False
        for number in range(len(self._points), len(path)):
            self._points.append(self._point(number))
        self._headings_deg = headings_deg(path).tolist()
        for number, handle in enumerate(self._points):
            handle.visible = number < len(path)
            if number < len(path):
                point = path[number]
                handle.position = np.array([point.x_m, point.y_m, heights_m[number]])
                yaw = Rotation.from_euler("z", self._headings_deg[number], degrees=True)
                handle.wxyz = quaternion_from_matrix(yaw.as_matrix())

    def heading_deg(self, number: int) -> float:
        """Return the heading with which the handle of a waypoint was shown."""
        return self._headings_deg[number]

    def _hide_points(self) -> None:
        for handle in self._points:
            handle.visible = False

    def _point(self, number: int) -> viser.TransformControlsHandle:
        def act(place: Waypoint, phase: str) -> None:
            self._on_point(number, place, phase)

        return self._handle(f"/edit/waypoint{number}", _POINT_M, act)

    def _handle(
        self, name: str, size_m: float, act: Callable[[Waypoint, str], None]
    ) -> viser.TransformControlsHandle:
        handle = self._nodes.add_transform_controls(
            name,
            scale=size_m,
            # Actors stand on the ground: they move in its plane and turn about the vertical.
            active_axes=(True, True, False),
            depth_test=False,
            visible=False,
        )

        @handle.on_update
        async def _(event: Any) -> None:
            target = event.target
            w, x, y, z = target.wxyz
            yaw_deg = float(np.degrees(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))
            x_m, y_m = float(target.position[0]), float(target.position[1])
            act(Waypoint(x_m=x_m, y_m=y_m, yaw_deg=yaw_deg), event.phase)

        return handle
