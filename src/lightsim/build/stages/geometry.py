"""Geometry stage: meshes of background, buildings and actors, without colours."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from lightsim.build.stages.context import Context
from lightsim.build.static_returns import static_returns
from lightsim.build.workspace import Workspace
from lightsim.core.buildings import Roofline
from lightsim.core.lidar_returns import LidarReturns
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.twin import SceneAssets, parked_actor_meshes
from lightsim.geometry.completion.before_sky import without_sky
from lightsim.geometry.completion.buildings import MeasuredScene, complete_buildings
from lightsim.geometry.completion.crown_colours import is_green
from lightsim.geometry.completion.crown_shapes import unseen_leaves
from lightsim.geometry.completion.crowns import Beams, find_crowns
from lightsim.geometry.completion.facade_cells import FacadeCells, facade_cells
from lightsim.geometry.completion.far_field import build_far_field
from lightsim.geometry.completion.flatten import flatten_walls
from lightsim.geometry.completion.glass import find_glass
from lightsim.geometry.completion.glazing import glaze
from lightsim.geometry.completion.kerbs import find_kerbs, with_edges, with_kerbs
from lightsim.geometry.completion.leaf_cards import cards_above, crown_cards, without_shreds
from lightsim.geometry.completion.ledges import find_ledges, with_ledges
from lightsim.geometry.completion.pole_meshes import with_poles
from lightsim.geometry.completion.poles import find_poles, raise_poles
from lightsim.geometry.completion.shipped_glass import shipped_glass_odds
from lightsim.geometry.completion.silhouettes import View
from lightsim.geometry.completion.walls import find_walls
from lightsim.geometry.mesh_scene import mesh_scene
from lightsim.geometry.simplify import simplify_planar
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.assets import write_assets
from lightsim.store.rooflines import write_rooflines

# Largest number of LiDAR returns from which walls, kerbs, crowns and poles are found: bounds memory
# to 84 MB (28 bytes each).
_WALL_RETURNS = 3_000_000


@dataclass(frozen=True, eq=False)
class _Measured:
    """Geometry from sensors and the neural field, before completion."""

    meshes: SceneAssets
    scene: MeasuredScene
    returns: LidarReturns
    beams: Beams
    notes: tuple[str, ...]


def make_geometry(work: Workspace, _: None, folder: Path, context: Context) -> Iterable[str]:
    """Mesh background and actors, complete unobserved parts, and write inferred casters apart."""
    measured = _measured(work, context)
    background, rooflines, notes = _completed(work, measured, context)
    write_assets(folder, replace(measured.meshes, background=background))
    write_rooflines(folder / "rooflines.npz", rooflines)
    return (*measured.meshes.notes, *notes, *measured.notes)


def facades_of(work: Workspace, context: Context) -> list[FacadeCells]:
    """Return the features of the walls of a finished build before panes are inserted, for training
    the network that detects panes."""
    measured = _measured(work, context)
    return _closed(work, measured, context)[2]


def _measured(work: Workspace, context: Context) -> _Measured:
    log, fields = work.training_log, work.fields
    returns = static_returns(log, _WALL_RETURNS, np.random.default_rng(context.seed))
    kerbs = find_kerbs(returns.points, fields.ground, fields.path_m)

    # Planes are smoothed on each level's mesh before decimation, which would fix the noise.
    def smooth_planes(mesh: TriMesh, voxel_m: float) -> TriMesh:
        return with_kerbs(flatten_walls(mesh, voxel_m, returns.points), kerbs, voxel_m)

    meshes = mesh_scene(
        log,
        fields,
        make_caster=make_embree_caster,
        progress=context.progress,
        smooth_planes=smooth_planes,
    )
    meshes = replace(meshes, background=with_edges(meshes.background, kerbs))
    walls = find_walls(meshes.background)
    beams = _beams(returns)
    found = find_crowns(beams, walls, fields.ground, fields.path_m)
    # Clusters of scattered returns are crowns only if the pictures show green there.
    caster = make_embree_caster([meshes.background])
    crowns = found.only(is_green(found, _views(work), caster))
    poles = find_poles(returns.points, returns.origins, fields.ground, fields.path_m)
    poles = raise_poles(poles, partial(_views, work))
    # Cards replace the surface fused within crowns, which is shredded; then surface is removed
    # where the pictures show sky behind it. Poles and cards are added afterwards, so that neither
    # step removes them.
    cards = crown_cards(crowns, np.random.default_rng(context.seed))
    surface = without_shreds(meshes.background, crowns)
    surface = without_sky(surface, _views(work), fields.ground, make_embree_caster)
    background = with_poles(surface, poles)
    background = concatenate_meshes([background, cards])
    # Leaves that no beam reached are searched for against everything found so far.
    caster = make_embree_caster([background])
    unseen = unseen_leaves(crowns, beams, walls, _views(work), caster)
    rest = cards_above(crowns, unseen, crowns.voxel_m, np.random.default_rng(context.seed))
    background = concatenate_meshes([background, rest])
    scene = MeasuredScene(background, walls, crowns, parked_actor_meshes(log, meshes))
    notes = (
        f"{sum(len(k.edge_m) for k in kerbs) // 2} m of kerbs have vertical faces",
        f"{len(poles)} poles, posts and trunks are represented by rods",
        f"{len(crowns)} crowns are represented by {len(cards.faces) // 2} cards, and their parts "
        f"without beams by {len(rest.faces) // 2}; {len(found) - len(crowns)} more are not green",
    )
    return _Measured(meshes, scene, returns, beams, notes)


def _closed(
    work: Workspace, measured: _Measured, context: Context
) -> tuple[TriMesh, list[Roofline], list[FacadeCells], int]:
    """Return the background completed by buildings, their rooflines, the features of their walls,
    and the number of new faces."""
    log, fields, scene = work.training_log, work.fields, measured.scene
    facades, rooflines = complete_buildings(
        scene,
        partial(_views, work),
        (sweep.load() for sweep in context.progress.track(log.sweeps, "walls and roofs")),
        fields.ground,
        measured.beams,
        make_caster=make_embree_caster,
    )
    background = concatenate_meshes([scene.background, simplify_planar(facades)])
    cells = facade_cells(
        scene.walls,
        ((frame, log.cameras[frame.camera_name]) for frame in log.frames),
        measured.returns.points,
        make_embree_caster([background]),
    )
    return background, rooflines, cells, len(facades.faces)


def _completed(
    work: Workspace, measured: _Measured, context: Context
) -> tuple[TriMesh, list[Roofline], tuple[str, ...]]:
    """Return the background completed by buildings, panes and far field, the rooflines, and
    notes."""
    fields = work.fields
    background, rooflines, cells, closing = _closed(work, measured, context)
    # Panes and ledges lie on completed facades, and the far field fills what remains without
    # surface: hence this order.
    panes = find_glass(cells, shipped_glass_odds())
    ledges = find_ledges([r.wall for r in rooflines], measured.beams.ends, fields.ground)
    background = with_ledges(glaze(background, panes), ledges)
    far = build_far_field(
        background, _views(work), fields.ground, fields.path_m, make_caster=make_embree_caster
    )
    notes = (
        f"{closing} faces close windows and raise facades, {len(far.faces)} are "
        f"beyond the LiDAR's range; {len(rooflines)} walls have a roof: inferred, not measured",
        f"{len(panes)} panes of glass and {len(ledges)} ledges were added to walls",
    )
    return concatenate_meshes([background, far]), rooflines, notes


def _views(work: Workspace) -> Iterable[View]:
    """Yield frames with their camera and sky matte."""
    log = work.training_log
    return ((f, log.cameras[f.camera_name], work.sky_matte(f)) for f in log.frames)


def _beams(returns: LidarReturns) -> Beams:
    """Return the beams except those that end on actors at rest."""
    is_used = ~returns.is_on_actor
    return Beams(returns.origins[is_used], returns.points[is_used])
