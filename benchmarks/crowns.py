"""What stands in the way of light through the crowns of a synthetic street, twin against truth.

    python benchmarks/crowns.py WORK --truth DIR --seed SEED

Parallel rays towards 16 suns through each crown within 60 m of the path, over the square that it
fills: the fraction that is stopped within the crown's reach, IoU of stopped rays, and the same of
blurred shadows (root mean square difference of the stopped fraction within a tenth of the square),
which do not ask for the place of a single leaf.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from target_shadows import suns

from lightsim.build.workspace import Workspace
from lightsim.core.casting import RayCaster
from lightsim.render.casters.embree import make_embree_caster
from lightsim_lab.synthetic.plan import plan_street
from lightsim_lab.synthetic.reader import read_true_meshes
from lightsim_lab.synthetic.street import build_background

_RAYS, _BLUR = 40, 4
_REACH_M, _LEAF_M = 60.0, 0.6


def true_crowns(seed: int) -> Iterator[np.ndarray]:
    """Middles of the leaves of each crown, frame world."""
    plan = plan_street(seed)
    parts = [p.transformed(plan.world_from_street) for p in build_background(plan)]
    leaves = [p.vertices[p.faces].mean(axis=1) for p in parts if p.material == "leaf"]
    if not leaves:
        return
    middle = np.concatenate(leaves)
    near = KDTree(middle).sparse_distance_matrix(KDTree(middle), _LEAF_M)
    count, number = connected_components(near)
    yield from (middle[number == k] for k in range(count))


def stopped(caster: RayCaster, leaves: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Which of a grid of rays towards a sun meet something within a crown's reach."""
    middle, radius = leaves.mean(axis=0), 0.5 * float(np.ptp(leaves, axis=0).max())
    across = np.cross(sun, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    grid = np.stack(np.meshgrid(*[np.linspace(-radius, radius, _RAYS)] * 2), axis=-1)
    start = middle - 1.5 * radius * sun
    start = start + (grid @ np.stack([across, np.cross(sun, across)])).reshape(-1, 3)
    hits = caster.intersect(start, np.broadcast_to(sun, start.shape).copy())
    return (hits.is_hit & (hits.distance_m < 3 * radius)).reshape(_RAYS, _RAYS)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--seed", type=int, required=True)
    options = parser.parse_args()
    workspace = Workspace(options.work)
    path_m = workspace.fields.path_m[:, :2]
    casters = [
        make_embree_caster([mesh])
        for mesh in (
            read_true_meshes(options.truth / "scene.npz")["background"],
            workspace.twin.assets.background,
        )
    ]
    rows = []
    for leaves in true_crowns(options.seed):
        distance = float(np.linalg.norm(path_m - leaves.mean(axis=0)[:2], axis=1).min())
        if distance > _REACH_M:
            continue
        pairs = [[stopped(c, leaves, sun) for c in casters] for _, sun in suns()]
        true, made = (np.array([pair[k] for pair in pairs]) for k in (0, 1))
        blurred = [gaussian_filter(a.astype(float), (0, _BLUR, _BLUR)) for a in (true, made)]
        iou = (true & made).sum() / max((true | made).sum(), 1)
        rms = float(np.sqrt(((blurred[0] - blurred[1]) ** 2).mean()))
        rows.append((distance, true.mean(), made.mean(), iou, rms))
    sys.stdout.write("| crown, m from the path | stopped: true | twin | IoU | blurred rms |\n")
    sys.stdout.write("|---:|---:|---:|---:|---:|\n")
    for row in (*sorted(rows), tuple(np.mean(rows, axis=0))):
        sys.stdout.write("| {:.0f} | {:.3f} | {:.3f} | {:.3f} | {:.3f} |\n".format(*row))


if __name__ == "__main__":
    main()
