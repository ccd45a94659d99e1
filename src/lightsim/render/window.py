"""Window of an image as a separate image, so that no rays are traced outside it."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
from jaxtyping import Float

from lightsim.core.camera import PinholeCamera
from lightsim.core.sensors import CameraFrame
from lightsim.core.window import Window


@dataclass(frozen=True, eq=False)
class WindowFrame(CameraFrame):
    """Frame that is restricted to a window of its image.

    Rays are those of the whole image's pixels, because the time of a row depends on its number
    under a rolling shutter.

    Args:
        whole: camera of the whole image.
        corner_px: column and row of the window's first pixel.
    """

    whole: PinholeCamera = field(kw_only=True)
    corner_px: tuple[int, int] = field(kw_only=True)

    def pixel_rays(
        self, camera: PinholeCamera, uv: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Return ray origins and directions of the window's (u, v), frame `world`."""
        return super().pixel_rays(self.whole, uv + np.array(self.corner_px))


def window_view(
    frame: CameraFrame, camera: PinholeCamera, window: Window
) -> tuple[WindowFrame, PinholeCamera]:
    """Return the frame and the camera of a window of an image, which may be a window itself."""
    rows, columns = window
    # A window of a window refers to the whole image again.
    whole, (left, top) = camera, (0, 0)
    if isinstance(frame, WindowFrame):
        whole, (left, top) = frame.whole, frame.corner_px
    # All fields of the frame are copied, because a rolling shutter needs them for the rays.
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
