"""The 3D window as a camera of the recording: pose, field of view and picture behind the scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.app.picture_layers import fitted
from lightsim.core.camera import PinholeCamera
from lightsim.core.frames import quaternion_from_matrix
from lightsim.core.sensors import CameraFrame

if TYPE_CHECKING:
    import viser

# Distance of a client's camera from its position below which it counts as rounding, in metres.
_SAME_M = 1e-3
# Difference of the inner product of two unit quaternions from 1 that counts as rounding.
_SAME_QUATERNION = 1e-4
# Difference of the aspect ratio of a window that counts as rounding.
_SAME_ASPECT = 1e-3
# Quality of JPEG pictures for the clients: 40 to 80 kB at 480 x 270. Chosen.
_JPEG_QUALITY = 85


class CameraView:
    """Fixes the cameras of all clients at a frame of the recording while `is_on`."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._is_on = False
        self._picture: tuple[Any, Any, PinholeCamera, CameraFrame] | None = None
        self._aspects: dict[int, float] = {}

        @server.on_client_connect
        async def _(client: viser.ClientHandle) -> None:
            @client.camera.on_update
            async def _(_: viser.CameraHandle) -> None:
                self._moved(client)

            self._apply(client)

        @server.on_client_disconnect
        async def _(client: viser.ClientHandle) -> None:
            self._aspects.pop(client.client_id, None)

    @property
    def is_on(self) -> bool:
        """True if clients have the view of the recording camera."""
        return self._is_on

    @is_on.setter
    def is_on(self, value: bool) -> None:
        self._is_on = value
        for client in self._server.get_clients().values():
            if value:
                self._apply(client)
            else:
                client.scene.set_background_image(None)

    def show(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        depth_z_m: Float32[np.ndarray, "h w"] | None,
        camera: PinholeCamera,
        frame: CameraFrame,
    ) -> None:
        """Set the picture, its camera and its frame."""
        self._picture = (image, depth_z_m, camera, frame)
        for client in self._server.get_clients().values():
            self._apply(client)

    def _moved(self, client: viser.ClientHandle) -> None:
        """Reset a client's camera to its pose, or fit the picture to another window."""
        if not self._is_on or self._picture is None:
            return
        wxyz, position = _pose(self._picture[3])
        camera = client.camera
        is_there = (
            np.abs(camera.position - position).max() < _SAME_M
            and abs(abs(float(camera.wxyz @ wxyz)) - 1.0) < _SAME_QUATERNION
        )
        is_fitted = abs(self._aspects.get(client.client_id, 0.0) - camera.aspect) < _SAME_ASPECT
        if not is_fitted:
            self._apply(client)
        elif not is_there:
            self._place(client, float(camera.fov))

    def _apply(self, client: viser.ClientHandle) -> None:
        if not self._is_on or self._picture is None:
            return
        image, depth, camera, _ = self._picture
        aspect = float(client.camera.aspect)
        window = fitted(image, depth, camera, aspect)
        self._aspects[client.client_id] = aspect
        self._place(client, window.vertical_fov_rad)
        client.scene.set_background_image(
            window.image, format="jpeg", jpeg_quality=_JPEG_QUALITY, depth=window.depth_m
        )

    def _place(self, client: viser.ClientHandle, fov_rad: float) -> None:
        assert self._picture is not None
        with client.atomic():
            client.camera.wxyz, client.camera.position = _pose(self._picture[3])
            client.camera.fov = fov_rad


def _pose(frame: CameraFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (quaternion, w first) and position of a camera; axes are those of OpenCV."""
    pose = frame.world_from_camera
    return quaternion_from_matrix(pose.rotation), pose.translation_m
