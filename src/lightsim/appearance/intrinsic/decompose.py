"""Intrinsic decomposition: radiance of a mesh into base colour and source light.

The paper's base colours contain shadows, its main limitation (Sec. 6). Here the source light is
rendered on the reconstructed surface. The rendered shadows are a prior; the final shadows are
estimated from the images (`labels`), before radiance is divided by light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from lightsim.appearance.colour import fill_unseen
from lightsim.appearance.intrinsic.bodies import body_colours
from lightsim.appearance.intrinsic.config import IntrinsicConfig
from lightsim.appearance.intrinsic.divide import (
    HIGHEST_BASE_COLOUR,
    LOWEST_BASE_COLOUR,
    base_colour_from_radiance,
)
from lightsim.appearance.intrinsic.edges import (
    LabelField,
    ShadedPoints,
    label_field,
    refine_visibility,
)
from lightsim.appearance.intrinsic.hidden_surfaces import Road, with_hidden_surfaces
from lightsim.appearance.intrinsic.labels import (
    ObservedSurfels,
    label_shadows,
    rendered_visibility,
)
from lightsim.appearance.intrinsic.leaves import leaf_colours, leaf_vertices
from lightsim.appearance.intrinsic.light import LightAt, ObservedPoints, SurfaceLight
from lightsim.appearance.intrinsic.panes import pane_colours, pane_vertices
from lightsim.appearance.intrinsic.reflectance import Members, materials_of
from lightsim.appearance.intrinsic.surfels import Graph, Surfels, connect, make_surfels
from lightsim.appearance.intrinsic.texture import (
    DeepShade,
    VertexLight,
    in_255ths,
    texture_without_light,
)
from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.mesh import MIRROR_ROUGHNESS, Provenance, SunVisibility, TriMesh
from lightsim.errors import InputError

__all__ = [
    "Decomposition",
    "IntrinsicConfig",
    "MeshSurfels",
    "Road",
    "SurfaceLight",
    "decompose",
    "mesh_surfels",
]

_WEIGHTS = LUMINANCE_WEIGHTS.astype(np.float64)

# The values below were chosen on log 002 and synthetic street 0. Only their joint effect is
# measured (docs/benchmarks/reconstruction.md, test street 1). benchmarks/bench_decompose.py varies
# those that are settings.

# Least number of surfels of a mesh with shadow labels.
_MIN_SURFELS = 50
# Maximum weight of the quotient on a building's pane: the fraction of its radiance that is not a
# reflection but comes from behind it. Chosen on street 9967; sensitivity not measured.
_PANE_WEIGHT = 0.7
# Maximum weight of the quotient on a leaf: the rest is background behind the crown.
_LEAF_WEIGHT = 0.3
# Size of a surfel, in metres.
_SURFEL_M = 0.25
# Height above a surfel's centre at which light is evaluated, in metres.
_LIFT_M = 0.08


@dataclass(frozen=True, eq=False)
class Decomposition:
    """Result of `decompose`.

    Args:
        mesh: with base colour and confidence.
        visibility: estimated sun visibility of each vertex.
    """

    mesh: TriMesh
    visibility: Float32[np.ndarray, " n"]


def decompose(
    mesh: TriMesh,
    light_at: LightAt,
    config: IntrinsicConfig,
    rng: np.random.Generator,
    *,
    path_world: Float[np.ndarray, "p 3"] | None = None,
    road: Road | None = None,
    is_symmetric: bool = False,
) -> Decomposition:
    """Replace the radiance of a mesh by base colour.

    Args:
        mesh: `base_colour` is the mean observed radiance (appearance.build.build_assets); a
            `confidence` of 0 marks unobserved vertices.
        light_at: source light at points in the mesh's frame.
        config: settings.
        rng: random numbers for surfels and pairs.
        path_world: positions of the cameras along the drive, which indicate the pavement.
        road: driven path, along which unobserved ground and fronts are completed.
        is_symmetric: the mesh is symmetric about y = 0, so that one half completes the other.

    Raises:
        InputError: the light is negative or not finite, or not one per point.
    """
    if len(mesh.vertices) == 0:
        return Decomposition(mesh, np.zeros(0, np.float32))
    vertices = ObservedPoints.vertices_of(mesh)
    light = light_at(vertices).with_min_sky()
    if len(light.sun) != len(mesh.vertices):
        raise InputError(
            "the light must be given for every vertex",
            got=len(light.sun),
            expected=len(mesh.vertices),
        )
    if config.method == "divide":
        return _divided(mesh, light)
    faces = _labelled_faces(mesh)
    patches = MeshSurfels.of(mesh, faces, config, rng, path_world)
    if patches is None:
        found = VertexLight(light, light.visibility[:, 1])
        return _finished(mesh, found, None, config, road, is_symmetric=is_symmetric)
    observed = patches.with_light(light_at)
    labels = label_shadows(observed, config)
    field = label_field(faces, observed, labels, config.edge_error_m)
    del patches, observed  # The largest arrays; the texture needs the memory next.
    found = VertexLight(light, _visibility(mesh, light, field))
    return _finished(mesh, found, field, config, road, is_symmetric=is_symmetric)


@dataclass(frozen=True, eq=False)
class MeshSurfels:
    """Surfels of a mesh without light.

    Args:
        surfels, graph: patches, and the pairs that are compared.
        materials: surfels of known material classes.
    """

    surfels: Surfels
    graph: Graph
    materials: tuple[Members, ...]

    @staticmethod
    def of(
        mesh: TriMesh,
        faces: Int64[np.ndarray, " k"],
        config: IntrinsicConfig,
        rng: np.random.Generator,
        path_world: Float[np.ndarray, "p 3"] | None = None,
    ) -> MeshSurfels | None:
        """Make the patches of some faces; None if there are too few."""
        surfels = make_surfels(mesh, faces, _SURFEL_M, rng)
        if len(surfels) < _MIN_SURFELS:
            return None
        materials = () if path_world is None else materials_of(surfels, path_world)
        return MeshSurfels(surfels, connect(surfels, config.reach_m, rng), materials)

    def with_light(self, light_at: LightAt) -> ObservedSurfels:
        """Add a light; return the evidence for labels."""
        light = light_at(self.surfels.points(_LIFT_M)).with_min_sky()
        return ObservedSurfels.of(self.surfels, self.graph, self.materials, light, _SURFEL_M)


def mesh_surfels(
    mesh: TriMesh,
    config: IntrinsicConfig,
    rng: np.random.Generator,
    path_world: Float[np.ndarray, "p 3"] | None = None,
) -> MeshSurfels | None:
    """Make the patches of all faces on which images indicate shadows; None if there are too few.

    Args:
        mesh, config, rng, path_world: as for `decompose`.
    """
    return MeshSurfels.of(mesh, _labelled_faces(mesh), config, rng, path_world)


def _labelled_faces(mesh: TriMesh) -> Int64[np.ndarray, " k"]:
    """Return the faces on which shadows can be labelled.

    Excluded are unobserved faces; the background proxy, whose position is arbitrary and whose area
    exceeds all measured surface; panes, which are dark in any light; and leaves, whose mutual
    shadows are smaller than a patch.
    """
    is_usable = ~mesh.has_provenance(Provenance.BACKGROUND_PROXY)
    is_usable &= ~leaf_vertices(mesh)[mesh.faces[:, 0]]
    if mesh.confidence is not None:
        is_usable &= (mesh.confidence[mesh.faces] > 0).any(axis=1)
    return np.flatnonzero(is_usable & (mesh.face_roughness() >= MIRROR_ROUGHNESS))


def _visibility(mesh: TriMesh, light: SurfaceLight, field: LabelField) -> Float32[np.ndarray, " n"]:
    """Return the sun visibility of each vertex: from labels, or rendered where there are none."""
    visibility = rendered_visibility(light).astype(np.float32)
    is_labelled = np.zeros(len(visibility), dtype=bool)
    is_labelled[mesh.faces[field.faces]] = True
    rows = np.flatnonzero(is_labelled)
    visibility[rows] = refine_visibility(field, ShadedPoints.vertices_of(mesh, light).at(rows))
    return visibility


def _finished(
    mesh: TriMesh,
    found: VertexLight,
    field: LabelField | None,
    config: IntrinsicConfig,
    road: Road | None,
    *,
    is_symmetric: bool,
) -> Decomposition:
    """Divide radiance by light; confidence is low where uncertain labels change the result."""
    visibility = found.visibility.astype(np.float64)
    total = np.maximum(found.light.total(visibility), 1e-6)
    colour = found.light.base_colour(mesh.base_colour, visibility)
    colour = np.clip(colour, LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR)
    fraction = found.light.sun.sum(axis=1) / total.sum(axis=1)
    unsure = 4 * visibility * (1 - visibility) * np.minimum(fraction, 1.0)
    seen = np.ones(len(unsure)) if mesh.confidence is None else mesh.confidence
    open_sky = float(np.percentile(found.light.diffuse @ _WEIGHTS, 95))
    shade = _deep_shade(mesh, colour, total @ _WEIGHTS / max(open_sky, 1e-9), seen > 0, config)
    quotient_weight = shade.quotient_weight
    if is_symmetric:
        is_known = (shade.quotient_weight >= 1.0) & (seen > 0)
        # The quotient of an interpolated radiance and the local light is meaningless: weight 0.
        fill, is_filled = body_colours(mesh, shade.blended(colour), is_known)
        shade = DeepShade(np.where(is_filled, 0.0, shade.quotient_weight), fill)
    else:
        is_pane = pane_vertices(mesh)
        fill = pane_colours(mesh, shade.blended(colour), is_pane, seen > 0)
        shade = shade.where(is_pane, _PANE_WEIGHT, fill)
        is_leaf = leaf_vertices(mesh) & ~is_pane
        fill = leaf_colours(mesh, colour, is_leaf, shade.quotient_weight > 0)
        shade = shade.where(is_leaf, _LEAF_WEIGHT, fill)
    texture, texel = mesh.texture, None
    if texture is not None:
        limits = (LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR)
        texture, texel = texture_without_light(mesh, texture, found, field, limits, shade)
    done = replace(
        mesh,
        base_colour=shade.blended(colour).astype(np.float32),
        confidence=(seen * (1 - 0.8 * unsure) * (0.2 + 0.8 * shade.quotient_weight)).astype(
            np.float32
        ),
        texture=texture,
        sun_visibility=SunVisibility(in_255ths(found.visibility), texel),
    )
    if road is not None:
        done = with_hidden_surfaces(done, quotient_weight, road)
    return Decomposition(done, found.visibility)


def _deep_shade(
    mesh: TriMesh,
    colour: Float64[np.ndarray, "n 3"],
    sky_view_factor: Float64[np.ndarray, " n"],
    is_seen: Bool[np.ndarray, " n"],
    config: IntrinsicConfig,
) -> DeepShade:
    """Return weight and fill of vertices in deep shade, such as under vehicles and in corners.

    Most light there is indirect light that the model omits, so the base colour of the surface
    around is a better estimate than the quotient. Unobserved vertices have weight 0.

    Args:
        sky_view_factor: light as a fraction of an open sky's.
    """
    quotient_weight = np.where(
        is_seen, np.interp(sky_view_factor, config.deep_shade, (0.0, 1.0)), 0.0
    )
    fill = fill_unseen(mesh, colour, quotient_weight >= 1.0, np.median(colour, axis=0))
    return DeepShade(quotient_weight, fill)


def _divided(mesh: TriMesh, light: SurfaceLight) -> Decomposition:
    """Baseline decomposition: division by the light that the sky stage estimated."""
    found = VertexLight(light, light.visibility[:, 1])
    total = light.total(found.visibility)
    done = base_colour_from_radiance(mesh, total.astype(np.float32))
    if mesh.texture is not None:
        limits = (LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR)
        texture, _ = texture_without_light(mesh, mesh.texture, found, None, limits)
        done = replace(done, texture=texture)
    return Decomposition(done, found.visibility)
