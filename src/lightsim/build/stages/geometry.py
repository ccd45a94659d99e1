"""Geometry stage: meshes of background, buildings and actors, without colours."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from lightsim.build.stages.context import Context
from lightsim.build.static_returns import static_returns
from lightsim.build.workspace import Workspace
from lightsim.core.twin import SceneAssets, parked_actor_meshes
from lightsim.geometry.completion.crowns import Crowns
from lightsim.geometry.completion.facade_cells import FacadeCells
from lightsim.geometry.completion.scene import Inputs, Scene
from lightsim.geometry.completion.table import (
    complete,
    facades_before_glass,
    level_changes,
)
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.geometry.completion.walls import find_walls
from lightsim.geometry.mesh_scene import mesh_scene
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.assets import write_assets
from lightsim.store.rooflines import write_rooflines

# Largest number of LiDAR returns from which walls, kerbs, crowns and poles are found: bounds memory
# to 84 MB (28 bytes each).
_WALL_RETURNS = 3_000_000


@dataclass(frozen=True)
class GeometryConfig:
    """Settings of the stage.

    Args:
        no_complete: steps of the completion that are left out (`completion.table.STEPS`).
    """

    no_complete: tuple[str, ...] = ()


def make_geometry(
    work: Workspace, config: GeometryConfig, folder: Path, context: Context
) -> Iterable[str]:
    """Mesh background and actors, complete unobserved parts, and write inferred casters apart."""
    inputs = completion_inputs(work, context)
    meshes, scene = measured_scene(work, inputs, context, config.no_complete)
    scene, notes = complete(inputs, scene, config.no_complete)
    write_assets(folder, replace(meshes, background=scene.background))
    write_rooflines(folder / "rooflines.npz", scene.rooflines)
    return (*meshes.notes, *notes)


def facades_of(work: Workspace, context: Context) -> list[FacadeCells]:
    """Return the features of the walls of a finished build before panes are inserted, for training
    the network that detects panes."""
    inputs = completion_inputs(work, context)
    _, scene = measured_scene(work, inputs, context)
    return facades_before_glass(inputs, complete(inputs, scene, until="panes")[0])


def completion_inputs(work: Workspace, context: Context) -> Inputs:
    """Return what the completion of a build reads."""
    log, fields = work.training_log, work.fields
    return Inputs(
        ViewEvidence(
            (f, log.cameras[f.camera_name], partial(work.sky_matte, f)) for f in log.frames
        ),
        static_returns(log, _WALL_RETURNS, np.random.default_rng(context.seed)),
        lambda: (sweep.load() for sweep in context.progress.track(log.sweeps, "walls and roofs")),
        fields.ground,
        fields.path_m,
        make_embree_caster,
        context.seed,
    )


def measured_scene(
    work: Workspace, inputs: Inputs, context: Context, without: Collection[str] = ()
) -> tuple[SceneAssets, Scene]:
    """Return the meshes from sensors and the neural field, and the scene before completion."""
    meshes = mesh_scene(
        work.training_log,
        work.fields,
        make_caster=make_embree_caster,
        progress=context.progress,
        smooth_planes=level_changes(inputs, without),
    )
    return meshes, Scene(
        meshes.background,
        Crowns.none(inputs.path_m),
        find_walls(meshes.background),
        parked=parked_actor_meshes(work.training_log, meshes),
    )
