"""Panes of glass in facades that a twin knows, against a synthetic street's truth.

    python benchmarks/panes.py WORK --truth DIR

Pixels of every third frame of all cameras on static upright surfaces: precision and recall of
glass, and how far the twin's surface lies from true panes, square to them; Markdown. Recall counts
all true panes, also those of far houses and above what beams reach.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from true_materials import material_names

from lightsim.build.workspace import Workspace
from lightsim.core.buffers import BACKGROUND, GBuffers
from lightsim.core.mesh import MIRROR_ROUGHNESS, Material, TriMesh
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.replay import replay
from lightsim_lab.studies.true_surfaces import TrueSurfaces

_UPRIGHT, _EVERY = 0.3, 3
_NEAR_M = 30.0


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    options = parser.parse_args()
    work = Workspace(options.work)
    log, surfaces = work.log_at(1.0), TrueSurfaces(options.truth / "scene.npz", work)
    background = _with_glass(surfaces.meshes["background"], options.truth)
    true, twin = _renderer(background), _renderer(work.twin.assets.background)
    counts = {"all": np.zeros(3), f"within {_NEAR_M:.0f} m": np.zeros(3)}
    off: dict[str, list[np.ndarray]] = {name: [] for name in counts}
    stems = sorted({frame.stem for frame in log.frames})[::_EVERY]
    for frame in log.frames:
        if frame.stem not in stems:
            continue
        camera = log.cameras[frame.camera_name]
        scenario = replay(work.twin, "as recorded", (frame,), "recorded", 0)
        wanted = true.geometry(surfaces.scenario, frame, camera)
        made = twin.geometry(scenario, frame, camera)
        is_static = (wanted.actor_index == BACKGROUND) & (made.actor_index == BACKGROUND)
        is_static &= np.abs(wanted.normal_world[..., 2]) < _UPRIGHT
        is_glass, is_found = _is_glass(wanted) & is_static, _is_glass(made) & is_static
        gap = made.position_world - wanted.position_world
        gap = np.abs((gap * wanted.normal_world).sum(axis=-1))
        near = wanted.depth_z_m < _NEAR_M
        for name, members in zip(counts, (np.ones_like(near), near), strict=True):
            for k, kind in enumerate((is_glass & is_found, ~is_glass & is_found, is_glass)):
                counts[name][k] += (kind & members).sum()
            off[name].append(gap[is_glass & members])
    sys.stdout.write(_table(counts, off))


def _with_glass(mesh: TriMesh, truth: Path) -> TriMesh:
    """The true background with its glass told from the rest."""
    is_glass = np.char.startswith(material_names(mesh, truth), "glass")
    materials = (Material(), Material(0.1, 0.0, "glass"))
    return replace(mesh, materials=materials, face_material=is_glass.astype(np.uint8))


def _renderer(background: TriMesh) -> FrameRenderer:
    nothing = replace(background, faces=background.faces[:0], texture=None)
    return FrameRenderer(background, nothing, TransportConfig(), 0)


def _is_glass(buffers: GBuffers) -> np.ndarray:
    assert buffers.material is not None
    return buffers.has_surface & (buffers.material[..., 0] < MIRROR_ROUGHNESS)


def _table(counts: dict[str, np.ndarray], off: dict[str, list[np.ndarray]]) -> str:
    lines = [
        "| panes | precision | recall | surface off by: median, 90 % cm | over 30 cm |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, (right, wrong, total) in counts.items():
        gap = np.concatenate(off[name])
        median, most = 100 * np.percentile(gap, [50, 90])
        lines.append(
            f"| {name} | {right / max(right + wrong, 1):.3f} | {right / max(total, 1):.3f} |"
            f" {median:.1f}, {most:.1f} | {(gap > 0.3).mean():.3f} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
