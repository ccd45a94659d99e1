"""Base colour without the source light: shadows found in the pictures, the light divided out.

The paper bakes shadows into the base colour and names that its main failure (Sec. 5). Here the
source light is rendered on the reconstructed surface; what it says about shadows is a prior, and
the pictures decide (delight_labels).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from lightsim.assets.delight_config import DelightConfig
from lightsim.assets.delight_divide import base_colour_from_radiance
from lightsim.assets.delight_edges import LabelField, refine_visibility
from lightsim.assets.delight_labels import Observed, label_shadows, predict_tone_steps
from lightsim.assets.delight_light import LightAt, LightScales, SurfaceLight
from lightsim.assets.delight_surfels import (
    LidarReturns,
    Surfels,
    connect,
    lidar_tone,
    make_surfels,
)
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError

__all__ = ["DelightConfig", "Delit", "LidarReturns", "LightScales", "SurfaceLight", "delight"]

_LEAST_RADIANCE = 1e-3
_TONE_REACH_M = 0.3
_LEAST_SURFELS = 50


@dataclass(frozen=True, eq=False)
class Delit:
    """A mesh without its light.

    Args:
        mesh: with base colour and confidence.
        visibility: of the sun, at each vertex, as found.
        scales: of the light, as found or as given.
        notes: the evidence.
    """

    mesh: TriMesh
    visibility: Float32[np.ndarray, " n"]
    scales: LightScales
    notes: tuple[str, ...]


def delight(
    mesh: TriMesh,
    light_at: LightAt,
    config: DelightConfig,
    rng: np.random.Generator,
    *,
    returns: LidarReturns | None = None,
    scales: LightScales | None = None,
) -> Delit:
    """The mesh with base colour in place of the radiance that it must hold.

    Args:
        mesh: `base_colour` is the mean observed radiance (assets.build.build_assets);
            `confidence`, where there is one, says which vertices were seen.
        light_at: the source light at points of the mesh's frame.
        returns: LiDAR, whose intensity knows no shadows.
        scales: strength of the light, known from a larger surface; None to find it here.

    Raises:
        InputError: the light is negative or not finite, or not one per point.
    """
    if len(mesh.vertices) == 0:
        return Delit(mesh, np.zeros(0, np.float32), scales or _unknown(), ())
    vertices = mesh.vertices.astype(np.float64)
    light = light_at(vertices, mesh.vertex_normals().astype(np.float64)).floored()
    if len(light.sun) != len(mesh.vertices):
        raise InputError(
            "the light must be given for every vertex", got=len(light.sun), expected=len(vertices)
        )
    if config.method == "divide":
        return _divided(mesh, light, config)
    surfels = make_surfels(mesh, config.surfel_m, rng)
    if len(surfels) < _LEAST_SURFELS:
        known = scales or _unknown()
        return _finished(mesh, light, light.visibility[:, 1], known, config)
    observed, tone_gain = _observe(surfels, light_at, config, rng, returns)
    labels = label_shadows(observed, config, scales)
    field = LabelField.of(observed, labels)
    visibility = refine_visibility(
        field, vertices, mesh.vertex_normals().astype(np.float64), mesh.base_colour, light
    )
    done = _finished(mesh, light, visibility, labels.scales, config)
    return replace(done, notes=_notes(labels.scales, tone_gain) if scales is None else ())


def _unknown() -> LightScales:
    return LightScales.assumed(np.inf)


def _observe(
    surfels: Surfels,
    light_at: LightAt,
    config: DelightConfig,
    rng: np.random.Generator,
    returns: LidarReturns | None,
) -> tuple[Observed, float]:
    """What is known of the surfels, and the gain from LiDAR intensity to base colour."""
    graph = connect(surfels, config.reach_m, rng)
    light = light_at(surfels.position, surfels.normal).floored()
    log_radiance = np.log(np.maximum(surfels.radiance, _LEAST_RADIANCE))
    step, gain = np.zeros(len(graph.pairs)), 0.0
    if returns is not None and len(returns.intensity):
        tone = lidar_tone(surfels, returns, _TONE_REACH_M)
        step, gain = predict_tone_steps(graph, log_radiance, tone, light.visibility)
    return Observed(surfels, graph, log_radiance, step, light, config.surfel_m), gain


def _finished(
    mesh: TriMesh,
    light: SurfaceLight,
    visibility: Float32[np.ndarray, " n"],
    scales: LightScales,
    config: DelightConfig,
) -> Delit:
    """Radiance over light; confidence falls where the sun's share hangs on an unsure label."""
    total = light.total(scales, visibility.astype(np.float64))
    colour = np.clip(mesh.base_colour / total, config.low, config.high)
    share = light.direct(scales).sum(axis=1) / np.maximum(total.sum(axis=1), 1e-9)
    unsure = 4 * visibility * (1 - visibility) * np.minimum(share, 1.0)
    seen = np.ones(len(unsure)) if mesh.confidence is None else mesh.confidence
    confidence = (seen * (1 - 0.8 * unsure)).astype(np.float32)
    done = replace(mesh, base_colour=colour.astype(np.float32), confidence=confidence, texture=None)
    return Delit(done, visibility.astype(np.float32), scales, ())


def _divided(mesh: TriMesh, light: SurfaceLight, config: DelightConfig) -> Delit:
    """The baseline, with the light as the sky stage estimated it."""
    visibility = light.visibility[:, 1]
    scales = _unknown()
    total: Float64[np.ndarray, "n 3"] = light.total(scales, visibility.astype(np.float64))
    done = base_colour_from_radiance(mesh, total.astype(np.float32), config.divide)
    return Delit(done, visibility, scales, ("base colour: divided by the rendered light",))


def _notes(scales: LightScales, tone_gain: float) -> tuple[str, ...]:
    tone = f"LiDAR intensity predicts base colour with exponent {tone_gain:.2f}"
    if scales.pair_count == 0:
        return ("too few lit and shadowed neighbours to correct the sun's strength", tone)
    factors = ", ".join(f"{value:.2f}" for value in scales.sun)
    return (
        f"the sun's irradiance times ({factors}) agrees with {scales.pair_count} lit/shadowed "
        f"pairs (log std {scales.log_std:.2f}); the sky is the gauge",
        tone,
    )
