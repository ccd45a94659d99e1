"""Joint bilateral upsampling of light from traced pixels to all pixels, along surfaces.

Kopf et al. 2007, doi:10.1145/1276377.1276497.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8

from lightsim.core.buffers import GBuffers
from lightsim.render.transport.faces import TransportConfig


@dataclass(frozen=True, eq=False)
class BilateralUpsampling:
    """Weights of the traced points that light each of n points; made once for all skies.

    Args:
        rows: of the traced points.
        weights: with sum 1 over the first `count`.
        count: number of traced points; 0 without a surface nearby.
    """

    rows: Int32[np.ndarray, "n q"]
    weights: Float32[np.ndarray, "n q"]
    count: UInt8[np.ndarray, " n"]

    def __call__(self, values: Float32[np.ndarray, "t c"]) -> Float32[np.ndarray, "n c"]:
        """Return values of the traced points at the n points."""
        # Points without a traced point nearby remain 0.
        out = np.zeros((len(self.rows), values.shape[1]), dtype=np.float32)
        self.add(values, out, np.arange(len(out)))
        return out

    def add(
        self,
        values: Float32[np.ndarray, "t c"],
        out: Float32[np.ndarray, "m c"],
        place: Int64[np.ndarray, " n"],
    ) -> None:
        """Add values of the traced points to the rows `place` of `out`, which are distinct."""
        from lightsim.render.transport.kernels import weighted_rows

        weighted_rows(self.rows, self.weights, self.count, values, place, out)


@dataclass(frozen=True, eq=False)
class TracedPixels:
    """Positions of the traced points of one frame.

    Args:
        index: number of each block's traced point, -1 without a surface.
        surface: position and normal of each.
        width: of the image, pixels.
    """

    index: Int32[np.ndarray, "hb wb"]
    surface: Float32[np.ndarray, "t 6"]
    width: int

    def upsampling_to_centres(
        self, pixel: Int64[np.ndarray, " n"], gbuffers: GBuffers, config: TransportConfig
    ) -> BilateralUpsampling:
        """Return the weights for the centres of (flat) pixels with a surface."""
        return self.upsampling(
            pixel,
            gbuffers.ray_starts_world.reshape(-1, 3)[pixel],
            gbuffers.normal_world.reshape(-1, 3)[pixel],
            gbuffers.depth_z_m.reshape(-1)[pixel],
            config,
        )

    def upsampling(
        self,
        pixel: Int32[np.ndarray, " n"] | Int64[np.ndarray, " n"],
        position_world: Float32[np.ndarray, "n 3"],
        normal_world: Float32[np.ndarray, "n 3"],
        depth_z_m: Float32[np.ndarray, " n"],
        config: TransportConfig,
    ) -> BilateralUpsampling:
        """Return the weights for points on surfaces that are visible in the given (flat) pixels."""
        from lightsim.render.transport.kernels import joint_weights

        # Fixed room for each point; `count` has the number that is used.
        size = (2 * config.filter_radius + 1) ** 2
        upsampling = BilateralUpsampling(
            np.zeros((len(pixel), size), dtype=np.int32),
            np.zeros((len(pixel), size), dtype=np.float32),
            np.zeros(len(pixel), dtype=np.uint8),
        )
        joint_weights(
            (self.index, self.surface, config.shading_step_px, config.filter_radius, self.width),
            pixel,
            position_world,
            normal_world,
            depth_z_m,
            upsampling.rows,
            upsampling.weights,
            upsampling.count,
        )
        return upsampling
