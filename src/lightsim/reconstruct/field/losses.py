"""Scene loss L = L_rgb + lambda_lidar L_lidar + lambda_reg L_reg (paper Sec. 3.3).

Further terms constrain the field between sparse LiDAR returns.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.reconstruct.field.sampling import RayBatch, place_samples
from lightsim.reconstruct.field.sdf_field import SceneField
from lightsim.reconstruct.field.volume_rendering import composite, crossings_m, opacities

# Distance from a return, in metres, within which samples may have weight (UniSim's epsilon).
_RETURN_BAND_M = 0.5
# Step of the finite differences, in metres. This and the next values were not measured alone;
# training as a whole is (docs/benchmarks/reconstruction.md).
_GRADIENT_STEP_M = 0.05
# Number of samples of a batch at which gradients are evaluated.
_GRADIENT_ROWS = 1024
# Least signed distance of free space, in metres.
_FREE_DISTANCE_M = 0.3
# Directions of the finite differences: four evaluations yield a gradient.
_TETRAHEDRON = ((1.0, -1.0, -1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, 1.0, 1.0))
Terms = dict[str, Float[Tensor, ""]]


def scene_loss(
    field: SceneField, rays: RayBatch, generator: torch.Generator
) -> tuple[Float[Tensor, ""], Terms]:
    """Return the weighted loss of a batch, and its unweighted terms.

    The terms `mse_srgb` (of camera pixels) and `depth_error_m` are metrics without a weight.
    """
    config = field.config
    t = place_samples(rays, generator)
    points, actor = rays.points(t)
    sdf, colour, residual, confidence = field(points, actor)
    shape = t.shape
    sdf, confidence = sdf.reshape(shape), confidence.reshape(shape)
    rendered = composite(opacities(sdf, field.beta, config.conversion))
    terms = _camera_terms(
        field, rays, rendered.mean(colour.reshape(*shape, 3)), rendered.transmittance
    )
    depth = crossings_m(t, sdf, config.conversion)
    terms |= _lidar_terms(rays, depth, sdf, confidence, rendered.weights, config)
    if config.weights.residual > 0.0:
        terms["residual"] = (confidence * residual.reshape(shape).abs()).mean()
    if config.weights.eikonal > 0.0 or config.weights.smooth > 0.0:
        terms |= _slope_terms(field, points, actor, _near_surface(rays, t, sdf), generator)
    if config.weights.surface > 0.0:
        terms["surface"] = _surface(field, rays)
    total = terms["rgb"]
    for name, weight in vars(config.weights).items():
        if weight > 0.0 and name in terms:
            total = total + weight * terms[name]
    return total, terms


def _camera_terms(
    field: SceneField,
    rays: RayBatch,
    colour: Float[Tensor, "r 3"],
    transmittance: Float[Tensor, " r"],
) -> Terms:
    """L_rgb of the camera rays, and the opacity of those into the sky."""
    is_camera = ~rays.is_lidar
    if not bool(is_camera.any()):
        return {"rgb": colour.sum() * 0.0}
    seen = colour[is_camera] + transmittance[is_camera, None] * field.sky(rays.direction[is_camera])
    predicted = field.pixel_colour(seen, rays.camera[is_camera].to(torch.int64))
    error = predicted - rays.colour[is_camera]
    squared = (error * error).sum(dim=1)
    norm = torch.sqrt(squared + 1e-8) if field.config.colour_norm == "l2" else squared
    sky = rays.sky[is_camera]
    hidden_sky = torch.where(sky > 0.5, 1.0 - transmittance[is_camera], torch.zeros_like(sky))
    return {"rgb": norm.mean(), "sky": hidden_sky.mean(), "mse_srgb": squared.detach().mean() / 3}


def _lidar_terms(
    rays: RayBatch,
    t: Float[Tensor, "r s"],
    sdf: Float[Tensor, "r s"],
    confidence: Float[Tensor, "r s"],
    weights: Float[Tensor, "r s"],
    config: NeuralConfig,
) -> Terms:
    """L_lidar, and the terms of the free space in front of returns."""
    rows = torch.nonzero(rays.is_lidar).squeeze(1)
    if len(rows) == 0:
        return {}
    measured, t, weights = rays.return_m[rows], t[rows], weights[rows]
    depth = (weights * t).sum(dim=1)
    opacity = weights.sum(dim=1)
    if config.depth_norm == "l2":
        lidar = (depth - measured).abs().mean()
    else:
        # Depth error and total opacity are independent terms.
        normalised = depth / opacity.clamp(min=1e-3)
        lidar = (
            smooth_l1_loss(normalised, measured, reduction="none", beta=0.3) / (1 + measured / 10)
        ).mean()
    gap = measured[:, None] - t
    away = weights * (gap.abs() > _RETURN_BAND_M)
    # At grazing angles, free space close to the surface is thin: a confident prior prevails.
    short = torch.relu(_FREE_DISTANCE_M - sdf[rows]) * (1 - confidence[rows])
    return {
        "lidar": lidar,
        "opacity": (1 - opacity).abs().mean(),
        "occupancy": torch.sqrt((away * away).sum(dim=1) + 1e-8).mean(),
        "free_space": (short * (gap > _RETURN_BAND_M)).mean(),
        "depth_error_m": (depth / opacity.clamp(min=1e-3) - measured).detach().abs().median(),
    }


def _near_surface(
    rays: RayBatch, t: Float[Tensor, "r s"], sdf: Float[Tensor, "r s"]
) -> Bool[Tensor, " n"]:
    """Mask of samples whose gradient is constrained to length 1 (flat)."""
    is_near_return = rays.is_lidar[:, None] & ((rays.return_m[:, None] - t).abs() < _RETURN_BAND_M)
    return (is_near_return | (sdf.detach().abs() < 0.3)).reshape(-1)


def _slope_terms(
    field: SceneField,
    points: Float[Tensor, "n 3"],
    actor: Int[Tensor, " n"],
    is_near: Bool[Tensor, " n"],
    generator: torch.Generator,
) -> Terms:
    """Mean (|grad s| - 1)^2 and |grad residual|^2 at random samples, by finite differences."""
    near = torch.nonzero(is_near).squeeze(1)
    if len(near) == 0:
        return {"eikonal": points.sum() * 0.0, "smooth": points.sum() * 0.0}
    pick = torch.randint(0, len(near), (_GRADIENT_ROWS,), generator=generator).to(near.device)
    rows = near[pick]
    corners = torch.tensor(_TETRAHEDRON, device=points.device)
    around = points[rows][:, None] + _GRADIENT_STEP_M * corners
    sdf, _, residual, confidence = field(around.reshape(-1, 3), actor[rows].repeat_interleave(4))

    def gradient(values: Float[Tensor, " m"]) -> Float[Tensor, "k 3"]:
        return (values.reshape(-1, 4, 1) * corners).sum(dim=1) / (4 * _GRADIENT_STEP_M)

    # The step at the prior's boundary is not a gradient of the field.
    known = confidence.reshape(-1, 4).amin(dim=1) > 0
    is_even = known if field.prior is not None else torch.ones_like(known)
    error = (gradient(sdf).norm(dim=1).clamp(max=3.0) - 1) ** 2
    return {
        "eikonal": (error * is_even).sum() / is_even.sum().clamp(min=1),
        "smooth": (gradient(residual) ** 2).sum(dim=1).mean(),
    }


def _surface(field: SceneField, rays: RayBatch) -> Float[Tensor, ""]:
    """Mean |s| at the returns; near ones are more accurate and have a larger weight."""
    rows = torch.nonzero(rays.is_lidar).squeeze(1)
    if len(rows) == 0:
        return rays.origin.sum() * 0.0
    # Camera rays have no return; any finite distance avoids NaN in rows that are dropped below.
    measured = rays.return_m.masked_fill(~rays.is_lidar, 1.0)
    points, actor = rays.points(measured[:, None])
    sdf, _, _, _ = field(points[rows], actor[rows])
    error = smooth_l1_loss(sdf, torch.zeros_like(sdf), reduction="none", beta=0.05)
    return (error / (1 + measured[rows] / 20)).mean()
