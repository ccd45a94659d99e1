"""A part of a picture as a picture of its own, so that nothing is traced beside it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
from jaxtyping import Float

from lightsim.core.camera import PinholeCamera
from lightsim.core.sensors import CameraFrame
from lightsim.core.window import Window


@dataclass(frozen=True, eq=False)
class WindowFrame(CameraFrame):
    """A frame seen through a window of its picture: rays are those of the whole picture's pixels,
    whose rows know their time where the shutter rolls."""

    whole: PinholeCamera = field(kw_only=True)
    corner_px: tuple[int, int] = field(kw_only=True)

    def pixel_rays(
        self, camera: PinholeCamera, uv: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Of the window's (u, v)."""
        return super().pixel_rays(self.whole, uv + np.array(self.corner_px))


def seen_through(
    frame: CameraFrame, camera: PinholeCamera, window: Window
) -> tuple[WindowFrame, PinholeCamera]:
    """The frame and the camera of a window of its picture, which may be a window itself."""
    rows, columns = window
    whole, (left, top) = camera, (0, 0)
    if isinstance(frame, WindowFrame):
        whole, (left, top) = frame.whole, frame.corner_px
    values = {f.name: getattr(frame, f.name) for f in fields(CameraFrame)}
    part = replace(
        camera,
        width_px=columns.stop - columns.start,
        height_px=rows.stop - rows.start,
        cx=camera.cx - columns.start,
        cy=camera.cy - rows.start,
    )
    corner_px = left + columns.start, top + rows.start
    return WindowFrame(**values, whole=whole, corner_px=corner_px), part
