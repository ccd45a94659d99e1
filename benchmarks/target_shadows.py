"""Shadows of the twin under suns it was not recorded under, against those of the true street.

    python benchmarks/target_shadows.py WORK --truth DIR [--with-true-parts]

Suns at eight azimuths and two elevations. A pixel is shadowed where its surface faces away from the
sun or something stands before it; each geometry is asked at its own surface, as relighting does.
IoU of the shadows cast onto surfaces that truly face the sun, and what is wrong with the rest. Then
how far roofs are off: those that views show, and those that no view shows before and after the
recorded sun's shadows were asked. --with-true-parts: instead, the twin with the true surfaces of a
material beside its own, material after material: what shadows lack (what the twin has too much of
stays).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from true_materials import material_names

from lightsim.build.workspace import Workspace
from lightsim.core.buildings import Roofline
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import RayCaster
from lightsim.core.mesh import TriMesh, concatenate_meshes
from lightsim.core.sensors import CameraFrame
from lightsim.geometry.surface import keep_faces
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.scene import FrameScene, make_static_scene, place
from lightsim.scenario.replay import replay
from lightsim_lab.studies.true_surfaces import TrueSurfaces
from lightsim_lab.synthetic.reader import read_true_meshes

ELEVATIONS_DEG = (20.0, 45.0)
AZIMUTHS_DEG = tuple(np.arange(0.0, 360.0, 45.0) + 10.0)
_EVERY_NTH_PIXEL = 3
_OFF_SURFACE_M = 0.03
_GRAZING = 0.05
"""Cosine between normal and sun below which a surface counts as facing away."""
_HIGHEST_M, _STEP_M, _FENCE_M = 60.0, 0.05, 3.0
"""Rays onto true fronts: up to where, how far apart; and what is no house."""
_BEFORE_M, _BEHIND_M = 0.6, 1.0
"""Where these rays start before a wall's plane, and how far behind it they may meet the front."""


@dataclass
class Shadows:
    """Pixels that truly face the sun, by what is true and what the twin says."""

    both: int = 0
    missing: int = 0
    false: int = 0
    seen: int = 0

    def add(self, is_true: np.ndarray, is_made: np.ndarray) -> None:
        self.both += int((is_true & is_made).sum())
        self.missing += int((is_true & ~is_made).sum())
        self.false += int((~is_true & is_made).sum())
        self.seen += len(is_true)

    @property
    def iou(self) -> float:
        return self.both / max(self.both + self.missing + self.false, 1)

    def row(self, name: str) -> str:
        missing, false = self._wrong()
        return f"| {name} | {self.iou:.3f} | {missing:.1f} | {false:.1f} |\n"

    def cell(self) -> str:
        missing, false = self._wrong()
        return f"{self.iou:.3f} ({missing:.1f}, {false:.1f})"

    def _wrong(self) -> tuple[float, float]:
        """Missing and false, percent."""
        return 100 * self.missing / max(self.seen, 1), 100 * self.false / max(self.seen, 1)


def suns() -> Iterator[tuple[float, np.ndarray]]:
    """Elevation and direction towards each sun, frame world."""
    for elevation in ELEVATIONS_DEG:
        for azimuth in AZIMUTHS_DEG:
            e, a = np.radians([elevation, azimuth])
            yield (
                elevation,
                np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]),
            )


def score(
    workspace: Workspace, truth: Path, background: TriMesh, casters: TriMesh
) -> dict[float, Shadows]:
    """Shadows by the sun's elevation, over the frames that have relit truth."""
    surfaces = TrueSurfaces(truth / "scene.npz", workspace)
    log = workspace.log_at(1.0)
    static = make_static_scene([background], [casters] if len(casters.faces) else [])
    true_static = make_static_scene([surfaces.meshes["background"]])
    stems = {path.stem for path in (truth / "relit").glob("*/*/*")}
    result = {elevation: Shadows() for elevation in ELEVATIONS_DEG}
    for frame in (f for f in log.frames if f.stem in stems):
        recorded = replay(workspace.twin, "as recorded", (frame,), "recorded", 0)
        scenes = (
            place(static, recorded, frame.time_ns),
            place(true_static, surfaces.scenario, frame.time_ns),
        )
        _add_frame(result, log.cameras[frame.camera_name], frame, scenes)
    return result


def _add_frame(
    result: dict[float, Shadows],
    camera: PinholeCamera,
    frame: CameraFrame,
    scenes: tuple[FrameScene, FrameScene],
) -> None:
    uv = camera.pixel_centres()[::_EVERY_NTH_PIXEL, ::_EVERY_NTH_PIXEL].reshape(-1, 2)
    origins, rays = frame.pixel_rays(camera, uv)
    places = [_surface(scene, origins, rays) for scene in scenes]
    is_used = places[0][2] & places[1][2]
    for elevation, sun in suns():
        is_made, is_true = (
            _is_dark(scene, points[is_used], normals[is_used], sun)
            for scene, (points, normals, _) in zip(scenes, places, strict=True)
        )
        faces_sun = places[1][1][is_used] @ sun > _GRAZING
        result[elevation].add(is_true[faces_sun], is_made[faces_sun])


def _surface(
    scene: FrameScene, origins: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points just before the seen surfaces, their normals, and which rays meet one."""
    hits = scene.camera_caster.intersect(origins, rays)
    normals = np.zeros_like(rays)
    for index, mesh in enumerate(scene.camera_meshes):
        rows = np.flatnonzero(hits.is_hit & (hits.mesh_index == index))
        normals[rows] = mesh.face_normals()[hits.face_index[rows]]
    normals *= -np.sign((normals * rays).sum(axis=1, keepdims=True))
    distance = np.where(hits.is_hit, hits.distance_m, 0.0)[:, None]
    return origins + distance * rays + _OFF_SURFACE_M * normals, normals, hits.is_hit


def _is_dark(
    scene: FrameScene, points: np.ndarray, normals: np.ndarray, sun: np.ndarray
) -> np.ndarray:
    is_blocked = scene.caster.is_occluded(points, np.broadcast_to(sun, points.shape).copy())
    return (normals @ sun <= _GRAZING) | is_blocked


def true_parts(truth: Path) -> dict[str, TriMesh]:
    """The true background by what it is made of; materials that differ in colour alone are one."""
    mesh = read_true_meshes(truth / "scene.npz")["background"]
    kind = np.char.rstrip(material_names(mesh, truth), "0123456789")
    return {name: _bare(keep_faces(mesh, kind == name)) for name in dict.fromkeys(kind.tolist())}


def _bare(mesh: TriMesh) -> TriMesh:
    """The shape alone."""
    return TriMesh(mesh.frame, mesh.vertices, mesh.faces, np.zeros_like(mesh.vertices))


def roof_errors(workspace: Workspace, truth: Path) -> str:
    """Median, mean and 90 % of how far the upper edges of fronts are off, m, over columns of walls
    whose true house is higher than a fence."""
    parts = true_parts(truth)
    caster = make_embree_caster([parts[name] for name in ("wall", "trim")])
    # Walls and columns are the same before and after; only their heights move.
    edges_m = [_true_edge_m(roofline, caster) for roofline in workspace.rooflines]
    lines = ["\n| roofs | m of wall | median m | mean m | 90 % m |\n|---|---:|---:|---:|---:|\n"]
    for name, rooflines, is_seen in (
        ("shown by views", workspace.rooflines, True),
        ("not shown, before shadows", workspace.initial_rooflines, False),
        ("not shown, after", workspace.rooflines, False),
    ):
        errors = [np.zeros(0)]
        for roofline, true_m in zip(rooflines, edges_m, strict=True):
            chosen = (roofline.is_seen == is_seen) & (true_m > roofline.ground_m + _FENCE_M)
            errors.append(np.abs(roofline.top_m - true_m)[chosen])
        found = np.concatenate(errors)
        width = len(found) * rooflines[0].cell_m if rooflines else 0.0
        figures = (np.median(found), found.mean(), np.percentile(found, 90)) if len(found) else ()
        lines.append(f"| {name} | {width:.0f} | {' | '.join(f'{f:.2f}' for f in figures)} |\n")
    return "".join(lines)


def _true_edge_m(roofline: Roofline, caster: RayCaster) -> np.ndarray:
    """Where the true front ends, parapet and all, for each column; the ground's height where there
    is none. (A roof lies lower than its parapet: rays down onto it do not tell.)"""
    heights = np.arange(roofline.ground_m.min(), _HIGHEST_M, _STEP_M)
    s, z = (grid.ravel() for grid in np.meshgrid(roofline.s_m, heights, indexing="ij"))
    start = roofline.wall.at(s, z, _BEFORE_M)
    back = np.broadcast_to(-roofline.wall.normal, start.shape).copy()
    met = caster.intersect(start, back).distance_m < _BEFORE_M + _BEHIND_M
    met = met.reshape(len(roofline.s_m), -1)
    return np.where(met, heights, roofline.ground_m[:, None]).max(axis=1) + _STEP_M / 2


def _print_with_parts(workspace: Workspace, truth: Path) -> None:
    """A line for the twin, and for the twin with each part of the truth."""
    twin, casters = _bare(workspace.twin.assets.background), workspace.unobserved_occluders
    columns = " | ".join(f"{elevation:.0f} degrees" for elevation in ELEVATIONS_DEG)
    sys.stdout.write(f"| | {columns} |\n|---|{'---:|' * len(ELEVATIONS_DEG)}\n")
    for name, mesh in {"the twin": None, **true_parts(truth)}.items():
        with_it = twin if mesh is None else concatenate_meshes([twin, mesh])
        found = score(workspace, truth, with_it, casters).values()
        sys.stdout.write(f"| {name} | {' | '.join(shadows.cell() for shadows in found)} |\n")
        sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--with-true-parts", action="store_true")
    options = parser.parse_args()
    workspace = Workspace(options.work)
    meshes = workspace.twin.assets.background, workspace.unobserved_occluders
    if options.with_true_parts:
        _print_with_parts(workspace, options.truth)
        return
    sys.stdout.write("| sun's elevation | IoU | missing % | false % |\n|---|---:|---:|---:|\n")
    for elevation, shadows in score(workspace, options.truth, *meshes).items():
        sys.stdout.write(shadows.row(f"{elevation:.0f} degrees"))
    sys.stdout.write(roof_errors(workspace, options.truth))


if __name__ == "__main__":
    main()
