"""Baseline decomposition: radiance divided by the rendered light, shadow edges inpainted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError

# Vertices inpainted together: some 20 MB of intermediate results for any log.
_CHUNK = 1 << 15

# Settings of the baseline; the sensitivity of each was not measured.

# Fraction of the mesh's bright light (95th percentile) below which light is not trusted.
_DARK_FRACTION = 0.02
# Greatest difference of the log light between neighbours; more indicates a shadow edge, whose
# rendered position is uncertain.
_MAX_LOG_STEP = 0.25
# Number of edges from a shadow edge within which vertices are not trusted.
_EDGE_RINGS = 2
# Number of trusted vertices that are averaged at an untrusted one.
_NEIGHBOURS = 12
# Exponent on the cosine between normals in the weight of a trusted vertex.
_NORMAL_POWER = 4.0
# Greatest distance of a trusted vertex, in metres.
_MAX_DISTANCE_M = 3.0
# Least base colour in every method: charcoal.
LOWEST_BASE_COLOUR = 0.02
# Greatest base colour in every method: fresh snow.
HIGHEST_BASE_COLOUR = 0.95


def base_colour_from_radiance(
    mesh: TriMesh, irradiance_over_pi: Float32[np.ndarray, "n 3"]
) -> TriMesh:
    """Divide the radiance in a mesh's `base_colour` by the source light.

    Where the light is weak, or changes abruptly (a shadow edge of uncertain position), the quotient
    is replaced by the mean of reliable neighbours of similar normal. Without such a neighbour the
    quotient is used.

    Args:
        mesh: `base_colour` is the mean observed radiance (appearance.build.build_assets).
        irradiance_over_pi: source light at each vertex, divided by pi.

    Raises:
        InputError: the light is negative or not finite, or not one per vertex.
    """
    if len(irradiance_over_pi) != len(mesh.vertices):
        raise InputError(
            "the light must be given for every vertex",
            got=len(irradiance_over_pi),
            expected=len(mesh.vertices),
        )
    if not np.isfinite(irradiance_over_pi).all() or (irradiance_over_pi < 0).any():
        raise InputError(
            "the light of a mesh is negative or not finite",
            got=f"{irradiance_over_pi.min():g} to {irradiance_over_pi.max():g}",
            expected="finite values of 0 or more",
        )
    if len(mesh.vertices) == 0:
        return mesh
    light = irradiance_over_pi.astype(np.float64)
    brightness = light @ LUMINANCE_WEIGHTS.astype(np.float64)
    floor = max(_DARK_FRACTION * float(np.percentile(brightness, 95)), 1e-6)
    quotient = mesh.base_colour / np.maximum(light, floor)
    is_trusted = (brightness > floor) & ~_near_light_steps(mesh, brightness + floor)
    colour = inpaint_colour(
        mesh, np.clip(quotient, LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR), is_trusted
    )
    return replace(mesh, base_colour=colour.astype(np.float32))


def _near_light_steps(
    mesh: TriMesh, brightness: Float64[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Mask of vertices near an abrupt change of the light that the normals do not explain."""
    edges = _edges(mesh)
    normals = mesh.vertex_normals()
    turn = (normals[edges[:, 0]] * normals[edges[:, 1]]).sum(axis=1)
    logs = np.log(brightness)
    is_step = np.abs(logs[edges[:, 0]] - logs[edges[:, 1]]) > _MAX_LOG_STEP
    is_step &= turn > 0.9
    is_near = np.zeros(len(mesh.vertices), dtype=bool)
    is_near[edges[is_step].ravel()] = True
    for _ in range(_EDGE_RINGS):
        touched = edges[is_near[edges].any(axis=1)]
        is_near[touched.ravel()] = True
    return is_near


def _edges(mesh: TriMesh) -> Int64[np.ndarray, "e 2"]:
    faces = mesh.faces.astype(np.int64)
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def inpaint_colour(
    mesh: TriMesh, colour: Float64[np.ndarray, "n 3"], is_trusted: Bool[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Replace unreliable colours by the mean of reliable nearby vertices with similar normals."""
    from scipy.spatial import KDTree

    trusted, other = np.flatnonzero(is_trusted), np.flatnonzero(~is_trusted)
    if len(other) == 0 or len(trusted) == 0:
        return colour
    k = min(_NEIGHBOURS, len(trusted))
    tree, normals = KDTree(mesh.vertices[trusted]), mesh.vertex_normals()
    result = colour.copy()
    for start in range(0, len(other), _CHUNK):
        rows = other[start : start + _CHUNK]
        distance, index = tree.query(mesh.vertices[rows], k=k)
        distance, index = distance.reshape(len(rows), k), trusted[index.reshape(len(rows), k)]
        facing = np.clip(np.einsum("nc,nkc->nk", normals[rows], normals[index]), 0.0, 1.0)
        fraction = facing.astype(np.float64) ** _NORMAL_POWER / np.maximum(distance, 0.02) ** 2
        fraction *= distance < _MAX_DISTANCE_M
        total = fraction.sum(axis=1)
        is_found = total > 1e-9
        found = np.einsum("nk,nkc->nc", fraction, colour[index])
        result[rows[is_found]] = found[is_found] / total[is_found, None]
    return result
