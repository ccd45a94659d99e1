"""Radiometric closure of a built twin against its recorded pictures; needs no ground truth."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
from jaxtyping import UInt8

from lightsim.appearance.intrinsic.light import ObservedPoints
from lightsim.build.assemble import roofs_over
from lightsim.build.measures import QUICK, held_out_tasks, observed_radiance
from lightsim.build.quality.frame_report import FramesReport
from lightsim.build.quality.frames import score_frames
from lightsim.build.source_light import IRRADIANCE, SourceLight
from lightsim.build.workspace import Workspace
from lightsim.core.colour import srgb8_from_linear
from lightsim.core.found_visibility import with_found_visibility
from lightsim.core.frames import RigidTransform
from lightsim.core.sensors import CameraFrame
from lightsim.errors import ArtefactError
from lightsim.progress import Progress, SilentProgress
from lightsim.render.frame_renderer import FrameRenderer, TransportFrame
from lightsim.render.image import scene_image, sky_image
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.replay import replay
from lightsim_lab.metrics.closure import ClosureReport, measure_closure, surface_classes

# Number of sampled vertices, far more than the percentiles need.
_SAMPLES = 100_000
# Minimum confidence of a vertex whose colour was observed rather than interpolated.
_MIN_CONFIDENCE = 0.5
# Diffuse bounces of the rendered light.
_BOUNCES = 4
# Mean radiance, in scene units, above which some of the averaged pictures were clipped.
_CLIPPED = 0.9


def closure(workspace: Workspace, progress: Progress | None = None) -> ClosureReport:
    """Measure base colour x light over the observed radiance of the static scene.

    Held-out frames rendered from base colours under the source sky, and from the twin's observed
    radiance, are also scored. The light is that of the twin's sky with rendered sun visibility,
    which also classifies samples as lit or shadowed. Samples are observed, unclipped vertices,
    drawn uniformly.

    Raises:
        ArtefactError: the twin has not been built, or was built from other meshes.
    """
    seen, twin = workspace.assets.background, workspace.twin.assets.background
    if seen.vertices.shape != twin.vertices.shape or not np.array_equal(
        seen.vertices, twin.vertices
    ):
        raise ArtefactError(
            "the vertices of the twin and of the textures differ",
            where=workspace.folder("twin"),
            remedy="Build again.",
        )
    confidence = np.ones(len(seen.vertices)) if seen.confidence is None else seen.confidence
    is_usable = (confidence > _MIN_CONFIDENCE) & (seen.base_colour < _CLIPPED).all(axis=1)
    rows = np.flatnonzero(is_usable)
    # A fixed seed makes figures of two builds comparable.
    rng = np.random.default_rng(0)
    rows = rng.choice(rows, min(_SAMPLES, len(rows)), replace=False)
    vertices = ObservedPoints.vertices_of(seen).at(rows)
    source = SourceLight(
        workspace.training_log,
        workspace.assets,
        roofs_over(workspace.assets.background, workspace.rooflines),
        workspace.sky.dome,
        IRRADIANCE,
        0,
    )
    light_at = source.on(RigidTransform.identity("world", "world"))
    light = light_at(vertices).with_min_sky()
    visibility = light.visibility[:, 1].astype(np.float64)
    predicted = light.total(visibility) * twin.base_colour[rows]
    predicted += light.reflections.total(visibility)
    classes = surface_classes(vertices.normal, visibility)
    report = measure_closure(predicted, seen.base_colour[rows], classes)
    if not workspace.held_out:
        return report
    return replace(report, frames=source_frames(workspace, progress or SilentProgress()))


def source_frames(workspace: Workspace, progress: Progress) -> FramesReport:
    """Score held-out frames rendered from base colour, light and reflections of the source sky.

    Methods: rendered sun visibility ("lit again"), the twin's estimated sun visibility ("lit as
    found"), and the twin's observed radiance ("radiance texture").
    """
    log, twin, dome = workspace.log, workspace.twin, workspace.sky.dome
    transport = TransportConfig(bounces=_BOUNCES)
    renderer = FrameRenderer(twin.assets.background, workspace.unobserved_occluders, transport, 0)
    scenario = replay(twin, "source", log.frames)
    sky = renderer.prepare(dome)

    # Two methods render the same frame in succession and use one trace.
    @lru_cache(maxsize=1)
    def trace(frame: CameraFrame) -> TransportFrame:
        return renderer.trace(scenario, frame, log.cameras[frame.camera_name])

    def lit(frame: CameraFrame, *, is_as_found: bool) -> UInt8[np.ndarray, "h w 3"]:
        camera, traced = log.cameras[frame.camera_name], trace(frame)
        light = traced.light(sky)
        if is_as_found and sky.sun is not None:
            found = traced.found_visibility(sky.sun)
            light = with_found_visibility(light, traced.buffers, sky.sun, found)
        radiance = scene_image(traced.buffers, light, sky_image(dome, camera, frame))
        return srgb8_from_linear(radiance * twin.assets.camera_gains[frame.camera_name])

    methods = {
        "lit again": partial(lit, is_as_found=False),
        "lit as found": partial(lit, is_as_found=True),
        "radiance texture": observed_radiance(workspace),
    }
    return score_frames(held_out_tasks(workspace, methods), QUICK, progress=progress)
