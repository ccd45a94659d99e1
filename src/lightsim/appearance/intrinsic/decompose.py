"""Base colour without the source light: shadows found in the pictures, the light divided out.

The paper bakes shadows into the base colour and names that its main failure (Sec. 5). Here the
source light is rendered on the reconstructed surface; what it says about shadows is a prior, and
the pictures decide (`labels`).
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
    Observed,
    label_shadows,
    predict_reflectance_steps,
    rendered_visibility,
)
from lightsim.appearance.intrinsic.leaves import leaf_colours, leaf_vertices
from lightsim.appearance.intrinsic.light import LightAt, SeenPoints, SurfaceLight
from lightsim.appearance.intrinsic.panes import pane_colours, pane_vertices
from lightsim.appearance.intrinsic.reflectance import Members, materials_of
from lightsim.appearance.intrinsic.surfels import (
    Graph,
    Surfels,
    connect,
    lidar_log_reflectance,
    make_surfels,
)
from lightsim.appearance.intrinsic.texture import (
    DeepShade,
    VertexLight,
    in_255ths,
    texture_without_light,
)
from lightsim.core.colour import LUMINANCE_WEIGHTS
from lightsim.core.lidar_returns import LidarReturns
from lightsim.core.mesh import MIRROR_ROUGHNESS, Provenance, SunVisibility, TriMesh
from lightsim.errors import InputError

__all__ = [
    "Decomposition",
    "IntrinsicConfig",
    "Patches",
    "Road",
    "SurfaceLight",
    "decompose",
    "patches_of",
]

_REFLECTANCE_REACH_M = 0.3
_WEIGHTS = LUMINANCE_WEIGHTS.astype(np.float64)
_LEAST_SURFELS = 50


# Chosen while looking at log 002 and the street of seed 0; only what all do together is measured
# (docs/benchmarks/reconstruction.md, where the street of seed 1 is the fair test). The bench
# benchmarks/bench_decompose.py varies those that are still settings.

# Of what a pane of a building shows diffusely, the part that is believed to be its own curtain or
# room. Panes that are told by their darkness alone showed less of it (.3); by street 9967.
_PANE_TRUST = 0.7
# The same of what a leaf shows, of which a part is what stands behind.
_LEAF_TRUST = 0.3

# Size of the patches that carry labels, and how far above their centres light is asked for.
_SURFEL_M, _LIFT_M = 0.25, 0.08


@dataclass(frozen=True, eq=False)
class Decomposition:
    """A mesh without its light.

    Args:
        mesh: with base colour and confidence.
        visibility: of the sun, at each vertex, as found.
        notes: the evidence.
        lidar_exponent: of the LiDAR intensity that predicts base colour best, 0 where it says
            nothing; None where nobody looked.
    """

    mesh: TriMesh
    visibility: Float32[np.ndarray, " n"]
    notes: tuple[str, ...]
    lidar_exponent: float | None = None


def decompose(
    mesh: TriMesh,
    light_at: LightAt,
    config: IntrinsicConfig,
    rng: np.random.Generator,
    *,
    returns: LidarReturns | None = None,
    road: Road | None = None,
    is_symmetric: bool = False,
) -> Decomposition:
    """The mesh with base colour in place of the radiance that it must hold.

    Args:
        mesh: `base_colour` is the mean observed radiance (assets.build.build_assets);
            `confidence`, where there is one, says which vertices were seen.
        light_at: the source light at points of the mesh's frame.
        returns: LiDAR, whose intensity knows no shadows, and whose path tells pavement.
        road: along which the ground of a street goes on where nobody saw it.
        is_symmetric: one half mirrors the other, which tells the colours that nobody saw.

    Raises:
        InputError: the light is negative or not finite, or not one per point.
    """
    if len(mesh.vertices) == 0:
        return Decomposition(mesh, np.zeros(0, np.float32), ())
    vertices = SeenPoints.vertices_of(mesh)
    light = light_at(vertices).floored()
    if len(light.sun) != len(mesh.vertices):
        raise InputError(
            "the light must be given for every vertex",
            got=len(light.sun),
            expected=len(mesh.vertices),
        )
    if config.method == "divide":
        return _divided(mesh, light)
    faces = _labelled_faces(mesh)
    patches = Patches.of(mesh, faces, config, rng, returns)
    if patches is None:
        found = VertexLight(light, light.visibility[:, 1])
        return _finished(mesh, found, None, config, road, is_symmetric=is_symmetric)
    observed, reflectance_gain = patches.under(light_at)
    labels = label_shadows(observed, config)
    field = label_field(faces, observed, labels, config.edge_error_m)
    del patches, observed  # Larger than all that is left to do.
    found = VertexLight(light, _visibility(mesh, vertices.normal, light, field))
    note = f"LiDAR intensity predicts base colour with exponent {reflectance_gain:.2f}"
    notes = () if returns is None else (note,)
    done = _finished(mesh, found, field, config, road, is_symmetric=is_symmetric)
    return replace(
        done, notes=notes, lidar_exponent=None if returns is None else float(reflectance_gain)
    )


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of a mesh and what LiDAR says of them; light comes with `under`.

    Args:
        log_reflectance: of each patch as LiDAR intensity tells it; None where nobody looked.
        materials: patches whose class of material is known.
    """

    surfels: Surfels
    graph: Graph
    log_reflectance: Float64[np.ndarray, " n"] | None
    materials: tuple[Members, ...]

    @staticmethod
    def of(
        mesh: TriMesh,
        faces: Int64[np.ndarray, " k"],
        config: IntrinsicConfig,
        rng: np.random.Generator,
        returns: LidarReturns | None = None,
    ) -> Patches | None:
        """Of some faces; None where there are too few."""
        surfels = make_surfels(mesh, faces, _SURFEL_M, rng)
        if len(surfels) < _LEAST_SURFELS:
            return None
        log_reflectance, materials = None, ()
        if returns is not None and len(returns.intensity):
            log_reflectance = lidar_log_reflectance(surfels, returns, _REFLECTANCE_REACH_M)
            materials = materials_of(surfels, returns.origins)
        graph = connect(surfels, config.reach_m, rng)
        return Patches(surfels, graph, log_reflectance, materials)

    def under(self, light_at: LightAt) -> tuple[Observed, float]:
        """What is known of the patches under a light, and the gain from LiDAR intensity to base
        colour."""
        light = light_at(self.surfels.points(_LIFT_M)).floored()
        observed = Observed.of(self.surfels, self.graph, self.materials, light, _SURFEL_M)
        if self.log_reflectance is None:
            return observed, 0.0
        step, gain = predict_reflectance_steps(
            self.graph, observed.log_radiance, self.log_reflectance, light.visibility
        )
        return replace(observed, reflectance_step=step), gain


def patches_of(
    mesh: TriMesh,
    config: IntrinsicConfig,
    rng: np.random.Generator,
    *,
    returns: LidarReturns | None = None,
) -> Patches | None:
    """Patches of all faces on which pictures say where shadows lie; None where there are too few.

    Args:
        mesh, returns: as for `decompose`.
    """
    return Patches.of(mesh, _labelled_faces(mesh), config, rng, returns)


def _labelled_faces(mesh: TriMesh) -> Int64[np.ndarray, " k"]:
    """Faces on which the pictures say where shadows lie: not those that no picture shows, nor those
    of the background proxy, on which shadows fall where they happen to, and which is larger than
    all that was measured; nor panes, which are dark in any light; nor leaves, which shade each
    other below the size of a patch."""
    is_told = ~mesh.comes_from(Provenance.BACKGROUND_PROXY)
    is_told &= ~leaf_vertices(mesh)[mesh.faces[:, 0]]
    if mesh.confidence is not None:
        is_told &= (mesh.confidence[mesh.faces] > 0).any(axis=1)
    return np.flatnonzero(is_told & (mesh.face_roughness() >= MIRROR_ROUGHNESS))


def _visibility(
    mesh: TriMesh,
    normals: Float[np.ndarray, "n 3"],
    light: SurfaceLight,
    field: LabelField,
) -> Float32[np.ndarray, " n"]:
    """Of the sun at each vertex: as labels have it, or as rendered where there are none."""
    reflected = light.reflections
    seen = ShadedPoints(
        mesh.vertices,
        normals.astype(np.float32),
        mesh.base_colour,
        light.diffuse.astype(np.float32),
        light.sun,
        reflected.rest,
        reflected.sun,
    )
    visibility = rendered_visibility(light).astype(np.float32)
    is_labelled = np.zeros(len(visibility), dtype=bool)
    is_labelled[mesh.faces[field.faces]] = True
    rows = np.flatnonzero(is_labelled)
    visibility[rows] = refine_visibility(field, seen.at(rows))
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
    """Radiance over light; confidence falls where the sun's fraction hangs on an unsure label."""
    visibility = found.visibility.astype(np.float64)
    total = np.maximum(found.light.total(visibility), 1e-6)
    colour = found.light.base_colour(mesh.base_colour, visibility)
    colour = np.clip(colour, LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR)
    fraction = found.light.sun.sum(axis=1) / total.sum(axis=1)
    unsure = 4 * visibility * (1 - visibility) * np.minimum(fraction, 1.0)
    seen = np.ones(len(unsure)) if mesh.confidence is None else mesh.confidence
    open_sky = float(np.percentile(found.light.diffuse @ _WEIGHTS, 95))
    shade = _deep_shade(mesh, colour, total @ _WEIGHTS / max(open_sky, 1e-9), seen > 0, config)
    trust = shade.trust
    if is_symmetric:
        is_known = (shade.trust >= 1.0) & (seen > 0)
        # The quotient of a colour that was filled in and of its own light says nothing.
        fill, is_filled = body_colours(mesh, shade.blended(colour), is_known)
        shade = DeepShade(np.where(is_filled, 0.0, shade.trust), fill)
    else:
        is_pane = pane_vertices(mesh)
        fill = pane_colours(mesh, shade.blended(colour), is_pane, seen > 0)
        shade = shade.where(is_pane, _PANE_TRUST, fill)
        is_leaf = leaf_vertices(mesh) & ~is_pane
        fill = leaf_colours(mesh, colour, is_leaf, shade.trust > 0)
        shade = shade.where(is_leaf, _LEAF_TRUST, fill)
    texture, texel = mesh.texture, None
    if texture is not None:
        limits = (LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR)
        texture, texel = texture_without_light(mesh, texture, found, field, limits, shade)
    done = replace(
        mesh,
        base_colour=shade.blended(colour).astype(np.float32),
        confidence=(seen * (1 - 0.8 * unsure) * (0.2 + 0.8 * shade.trust)).astype(np.float32),
        texture=texture,
        sun_visibility=SunVisibility(in_255ths(found.visibility), texel),
    )
    if road is not None:
        done = with_hidden_surfaces(done, trust, road)
    return Decomposition(done, found.visibility, ())


def _deep_shade(
    mesh: TriMesh,
    colour: Float64[np.ndarray, "n 3"],
    sky_view_factor: Float64[np.ndarray, " n"],
    is_seen: Bool[np.ndarray, " n"],
    config: IntrinsicConfig,
) -> DeepShade:
    """Under vehicles and in deep corners nearly all light is stray light that no model knows: the
    quotient there says little, surfaces beside them more. That of a colour which nobody saw and of
    its own light says nothing. `sky_view_factor`: light over an open sky's."""
    trust = np.where(is_seen, np.interp(sky_view_factor, config.deep_shade, (0.0, 1.0)), 0.0)
    fill = fill_unseen(mesh, colour, trust >= 1.0, np.median(colour, axis=0))
    return DeepShade(trust, fill)


def _divided(mesh: TriMesh, light: SurfaceLight) -> Decomposition:
    """The baseline, with the light as the sky stage estimated it."""
    found = VertexLight(light, light.visibility[:, 1])
    total = light.total(found.visibility)
    done = base_colour_from_radiance(mesh, total.astype(np.float32))
    if mesh.texture is not None:
        limits = (LOWEST_BASE_COLOUR, HIGHEST_BASE_COLOUR)
        texture, _ = texture_without_light(mesh, mesh.texture, found, None, limits)
        done = replace(done, texture=texture)
    return Decomposition(done, found.visibility, ("divided by the rendered light",))
