"""Does a built twin give back what its cameras saw? Needs no ground truth."""

from __future__ import annotations

import numpy as np

from lightsim.appearance.intrinsic.light import SeenPoints
from lightsim.core.frames import RigidTransform
from lightsim.errors import ArtefactError
from lightsim.evaluate.closure import ClosureReport, measure_closure, surface_classes
from lightsim.pipeline.assemble import roofs_over
from lightsim.pipeline.source_light import SourceLight
from lightsim.pipeline.stages.light import IRRADIANCE
from lightsim.pipeline.workspace import Workspace

_SAMPLES = 100_000
_LEAST_CONFIDENCE = 0.5
"""Below it the colour was filled in, not seen."""
_CLIPPED = 0.9
"""Mean radiance, scene units, from which on some of the pictures were clipped."""


def closure(workspace: Workspace) -> ClosureReport:
    """Base colour x the twin's light over the radiance that the cameras saw of the static scene.

    The light is the one of the twin's sky, with the sun's visibility as rendered. Samples are
    vertices that were seen and not clipped, evenly drawn; "lit" and "shadowed" are so by rendering.

    Raises:
        ArtefactError: the twin has not been built, or was built of other meshes.
    """
    seen, twin = workspace.assets.background, workspace.twin.assets.background
    if seen.vertices.shape != twin.vertices.shape or not np.array_equal(
        seen.vertices, twin.vertices
    ):
        raise ArtefactError(
            "twin and textures have other vertices",
            where=workspace.folder("twin"),
            remedy="Build again.",
        )
    confidence = np.ones(len(seen.vertices)) if seen.confidence is None else seen.confidence
    is_usable = (confidence > _LEAST_CONFIDENCE) & (seen.base_colour < _CLIPPED).all(axis=1)
    rows = np.flatnonzero(is_usable)
    rng = np.random.default_rng(0)
    rows = rng.choice(rows, min(_SAMPLES, len(rows)), replace=False)
    vertices = SeenPoints.vertices_of(seen).at(rows)
    source = SourceLight(
        workspace.training_log,
        workspace.assets,
        roofs_over(workspace.assets.background, workspace.rooflines),
        workspace.sky.dome,
        IRRADIANCE,
        0,
    )
    light_at = source.on(RigidTransform.identity("world", "world"))
    light = light_at(vertices).floored()
    visibility = light.visibility[:, 1].astype(np.float64)
    predicted = light.total(visibility) * twin.base_colour[rows]
    if light.reflected is not None:
        predicted = predicted + light.reflected.total(visibility)
    classes = surface_classes(vertices.normal, visibility)
    return measure_closure(predicted, seen.base_colour[rows], classes)
