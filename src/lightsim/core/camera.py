"""The pinhole camera (CONVENTIONS: Pixels). Frame `camera`: x right, y down, z forward."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from lightsim.errors import InputError


@dataclass(frozen=True)
class PinholeCamera:
    """Intrinsics in pixels; the centre of the first pixel is (0.5, 0.5)."""

    name: str
    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        values = np.array([self.fx, self.fy, self.cx, self.cy])
        is_bad_size = self.width_px < 1 or self.height_px < 1
        if not np.isfinite(values).all() or self.fx <= 0 or self.fy <= 0 or is_bad_size:
            raise InputError(
                "the intrinsics are not valid for a pinhole camera",
                where=f"camera '{self.name}'",
                got=f"{self.width_px}x{self.height_px} px, fx fy cx cy {values.tolist()}",
                expected="1x1 px or more, finite numbers, fx and fy above 0",
            )

    def scaled(self, scale: float) -> PinholeCamera:
        """The camera of the image resized to round(size * scale)."""
        width = max(1, round(self.width_px * scale))
        height = max(1, round(self.height_px * scale))
        # The factors of the rounded sizes, not `scale`. Pixel coordinates start at the corner of
        # the first pixel, so that cx and cy scale without an offset of half a pixel.
        sx, sy = width / self.width_px, height / self.height_px
        return replace(
            self,
            width_px=width,
            height_px=height,
            fx=self.fx * sx,
            cx=self.cx * sx,
            fy=self.fy * sy,
            cy=self.cy * sy,
        )

    def pixel_centres(self) -> Float[np.ndarray, "h w 2"]:
        """(u, v) of every pixel centre."""
        u, v = np.meshgrid(np.arange(self.width_px) + 0.5, np.arange(self.height_px) + 0.5)
        return np.stack([u, v], axis=-1)

    def directions(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Unit viewing directions in frame `camera` through (u, v)."""
        x = (uv[..., 0] - self.cx) / self.fx
        y = (uv[..., 1] - self.cy) / self.fy
        directions = np.stack([x, y, np.ones_like(x)], axis=-1)
        return directions / np.linalg.norm(directions, axis=-1, keepdims=True)

    def project(
        self, points_camera: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """(u, v) of points in frame `camera`, and whether they fall inside the image.

        Points at or behind the camera plane get NaN and False.
        """
        # Points behind the camera would project to mirrored pixels inside the image.
        z = points_camera[:, 2]
        is_front = z > 1e-6
        safe_z = np.where(is_front, z, 1.0)
        u = self.fx * points_camera[:, 0] / safe_z + self.cx
        v = self.fy * points_camera[:, 1] / safe_z + self.cy
        inside = is_front & (u >= 0) & (u < self.width_px) & (v >= 0) & (v < self.height_px)
        uv = np.stack([u, v], axis=-1)
        uv[~is_front] = np.nan
        return uv, inside
