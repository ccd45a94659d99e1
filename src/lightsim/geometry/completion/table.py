"""Completion of the measured scene: an ordered table of steps.

Each step adds surface that sensors did not resolve, or removes surface that they contradict. A step
reads the scene that the steps above it made. Any of them can be omitted;
`benchmarks/completion_worth.py` prints the gain of each.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lightsim.core.checks import check_choice
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.geometry.completion.before_sky import remove_before_sky
from lightsim.geometry.completion.buildings import complete_walls
from lightsim.geometry.completion.crown_colours import is_green
from lightsim.geometry.completion.crown_shapes import unseen_leaves
from lightsim.geometry.completion.crowns import find_crowns
from lightsim.geometry.completion.facade_cells import FacadeCells, facade_cells
from lightsim.geometry.completion.far_field import build_far_field
from lightsim.geometry.completion.far_walls import find_far_walls
from lightsim.geometry.completion.flatten import flatten_walls
from lightsim.geometry.completion.glass import find_glass
from lightsim.geometry.completion.glazing import glaze
from lightsim.geometry.completion.kerbs import with_edges, with_kerbs
from lightsim.geometry.completion.leaf_cards import cards_above, crown_cards, without_crown_surface
from lightsim.geometry.completion.ledges import find_ledges, with_ledges
from lightsim.geometry.completion.pitched_roofs import find_pitched_roofs
from lightsim.geometry.completion.pole_meshes import with_poles
from lightsim.geometry.completion.poles import extend_poles, find_poles
from lightsim.geometry.completion.scene import Inputs, Scene
from lightsim.geometry.completion.shipped_glass import shipped_glass_log_odds
from lightsim.geometry.simplify import simplify_planar

ChangeScene = Callable[[Inputs, Scene], tuple[Scene, str]]
ChangeLevel = Callable[[TriMesh, float], TriMesh]


@dataclass(frozen=True)
class Step:
    """One step of the completion.

    Args:
        name: name of the step.
        reads: what it reads besides the background.
        adds: what it adds or removes.
        reason: the error that it corrects.
        on_scene: returns the changed scene and a note; the note may be empty.
        on_level: returns the function that changes the mesh of one level of the field. It runs
            before decimation, which would preserve noise. Its second argument is the distance
            between the level's samples, in metres.
    """

    name: str
    reads: str
    adds: str
    reason: str
    on_scene: ChangeScene | None = None
    on_level: Callable[[Inputs], ChangeLevel] | None = None


def complete(
    inputs: Inputs, scene: Scene, without: Collection[str] = (), until: str | None = None
) -> tuple[Scene, list[str]]:
    """Return the completed scene, and the notes of the steps.

    Args:
        inputs: views, beams and ground map.
        scene: the measured scene.
        without: names of steps that are left out.
        until: name of the first step that is not run; None: all are run.

    Raises:
        FrameMismatchError: a mesh is not in frame world.
        InputError: a matte does not fit its camera.
    """
    notes = []
    for step in STEPS:
        if step.name == until:
            break
        if step.name not in without and step.on_scene is not None:
            scene, note = step.on_scene(inputs, scene)
            notes += [note] if note else []
    return scene, notes


def level_changes(inputs: Inputs, without: Collection[str] = ()) -> ChangeLevel:
    """Return the function that applies all steps which change levels of the field."""
    steps = [s.on_level(inputs) for s in STEPS if s.on_level and s.name not in without]

    def change(mesh: TriMesh, voxel_m: float) -> TriMesh:
        for step in steps:
            mesh = step(mesh, voxel_m)
        return mesh

    return change


def check_steps(names: Sequence[str]) -> None:
    """Check that all names are names of steps.

    Raises:
        InputError: a name is unknown.
    """
    for name in names:
        check_choice("--no-complete", name, [step.name for step in STEPS])


def facades_before_glass(inputs: Inputs, scene: Scene) -> list[FacadeCells]:
    """Return the features of each wall from which panes are found."""
    return facade_cells(
        scene.walls, inputs.evidence, inputs.returns.points, scene.caster(inputs.make_caster)
    )


def _flat_walls(inputs: Inputs) -> ChangeLevel:
    return lambda mesh, voxel_m: flatten_walls(mesh, voxel_m, inputs.returns.points)


def _kerbs_of_level(inputs: Inputs) -> ChangeLevel:
    return lambda mesh, voxel_m: with_kerbs(mesh, inputs.kerbs, voxel_m)


def _kerbs(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    length = sum(len(kerb.edge_m) for kerb in inputs.kerbs) // 2
    scene = replace(scene, background=with_edges(scene.background, inputs.kerbs))
    return scene, f"{length} m of kerbs have vertical faces"


def _crowns(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    found = find_crowns(inputs.beams, scene.walls, inputs.ground, inputs.path_m)
    # Clusters of scattered returns are crowns only if the images show green there.
    crowns = found.select(is_green(found, inputs.evidence, scene.caster(inputs.make_caster)))
    # Cards replace the fused surface within crowns, which is fragmented.
    background = without_crown_surface(scene.background, crowns)
    note = f"{len(found) - len(crowns)} volumes of scattered returns are not green"
    return replace(scene, background=background, crowns=crowns), note


def _false_surfaces(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    background = remove_before_sky(
        scene.background, inputs.evidence, inputs.ground, inputs.make_caster
    )
    return replace(scene, background=background), ""


def _poles(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    returns = inputs.returns
    poles = find_poles(returns.points, returns.origins, inputs.ground, inputs.path_m)
    poles = extend_poles(poles, inputs.evidence)
    scene = replace(scene, background=with_poles(scene.background, poles))
    return scene, f"{len(poles)} poles, posts and trunks are represented by rods"


def _leaves(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    cards = crown_cards(scene.crowns, np.random.default_rng(inputs.seed))
    scene = replace(scene, background=concatenate_meshes([scene.background, cards]))
    return scene, f"{len(scene.crowns)} crowns are represented by {len(cards.faces) // 2} cards"


def _crown_tops(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    crowns, caster = scene.crowns, scene.caster(inputs.make_caster)
    unseen = unseen_leaves(crowns, inputs.beams, scene.walls, inputs.evidence, caster)
    cards = cards_above(crowns, unseen, crowns.voxel_m, np.random.default_rng(inputs.seed))
    scene = replace(scene, background=concatenate_meshes([scene.background, cards]))
    return scene, f"{len(cards.faces) // 2} cards are in parts of crowns without beams"


def _far_walls(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    if not scene.walls:
        return scene, ""
    caster = scene.caster(inputs.make_caster, with_parked=True)
    sources = inputs.beams, inputs.evidence, scene.crowns, inputs.ground, caster
    return replace(scene, far_walls=find_far_walls(scene.walls, *sources)), ""


def _pitched_roofs(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    roofs = find_pitched_roofs(scene.background, inputs.ground, scene.caster(inputs.make_caster))
    solids = [mesh for roof in roofs for mesh in roof.solid()]
    background = concatenate_meshes([scene.background, *solids])
    scene = replace(scene, background=background, pitched_roofs=roofs)
    return (
        scene,
        f"{len(roofs)} measured slopes of roofs are continued beyond their ridge: inferred",
    )


def _roofs(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    added, rooflines = complete_walls(inputs, scene)
    count = sum(len(part.faces) for part in added)
    parts = [simplify_planar(concatenate_meshes(added))] if added else []
    background = concatenate_meshes([scene.background, *parts])
    return replace(scene, background=background, rooflines=rooflines), (
        f"{count} faces close windows and raise facades; {len(rooflines)} walls have a roof: "
        "inferred, not measured"
    )


def _panes(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    panes = find_glass(facades_before_glass(inputs, scene), shipped_glass_log_odds())
    scene = replace(scene, background=glaze(scene.background, panes))
    return scene, f"{len(panes)} panes of glass were added to walls"


def _ledges(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    walls = [*scene.walls, *scene.far_walls]
    ledges = find_ledges(walls, inputs.beams.ends, inputs.ground)
    scene = replace(scene, background=with_ledges(scene.background, ledges))
    return scene, f"{len(ledges)} ledges were added to walls"


def _far_field(inputs: Inputs, scene: Scene) -> tuple[Scene, str]:
    far = build_far_field(
        scene.background,
        inputs.evidence,
        inputs.ground,
        inputs.path_m,
        make_caster=inputs.make_caster,
    )
    scene = replace(scene, background=concatenate_meshes([scene.background, far]))
    return scene, f"{len(far.faces)} faces are beyond the LiDAR's range: inferred, not measured"


STEPS = (
    Step(
        "flat_walls",
        "LiDAR returns",
        "moves vertices of walls",
        "the field's samples are far apart: noise casts ragged shadows under a grazing sun",
        on_level=_flat_walls,
    ),
    Step(
        "kerbs",
        "LiDAR returns, ground map",
        "upright faces",
        "a kerb is as low as the distance between samples and becomes a ramp",
        on_scene=_kerbs,
        on_level=_kerbs_of_level,
    ),
    Step(
        "crowns",
        "beams, colours",
        "crowns; removes the surface within them",
        "a signed distance field turns leaves into shreds",
        on_scene=_crowns,
    ),
    Step(
        "webs",
        "sky in views",
        "removes surface before sky",
        "the field spans webs between masts, wires and lights",
        on_scene=_false_surfaces,
    ),
    # Poles and cards are added after the steps that remove surface.
    Step(
        "poles",
        "LiDAR returns, views",
        "tapering cylinders",
        "rods are thinner than the distance between samples",
        on_scene=_poles,
    ),
    Step(
        "leaves",
        "crowns",
        "leaf cards",
        "crowns without surface cast no shadow",
        on_scene=_leaves,
    ),
    Step(
        "crown_tops",
        "crowns, beams, sky and colours in views",
        "leaf cards",
        "tops of trees are above the highest beam",
        on_scene=_crown_tops,
    ),
    Step(
        "far_walls",
        "walls, beams, sky in views",
        "walls on new planes",
        "distant returns are too sparse for a mesh, and high beams are metres apart",
        on_scene=_far_walls,
    ),
    Step(
        "pitched_roofs",
        "measured slopes",
        "their mirror images, and houses below them",
        "the slope that faces away from the road is never seen",
        on_scene=_pitched_roofs,
    ),
    Step(
        "roofs",
        "walls, views, beams",
        "upper parts and closed holes of walls, and rooflines",
        "beams pass glass and end at the highest channel",
        on_scene=_roofs,
    ),
    # Panes and ledges lie on completed walls, and the far field fills what remains.
    Step(
        "panes",
        "views of walls",
        "recessed panes of glass",
        "glass returns few beams and reflects",
        on_scene=_panes,
    ),
    Step(
        "ledges",
        "LiDAR returns on walls",
        "level boxes",
        "the field rounds off structure of a decimetre",
        on_scene=_ledges,
    ),
    Step(
        "far_field",
        "views",
        "ground and a skyline around the scene",
        "nothing is measured beyond the LiDAR's range",
        on_scene=_far_field,
    ),
)
"""The steps, in order."""
