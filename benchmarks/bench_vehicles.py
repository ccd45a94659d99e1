"""Shapes of a twin's vehicles beside the synthetic street's true ones.

    python benchmarks/bench_vehicles.py WORK --truth DIR

F-score of the outer surface within 5 and 10 cm, and intersection over union of silhouettes from
eight sides; means over all vehicles, and over those that many returns saw.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from lightsim.build.workspace import Workspace
from lightsim.core.mesh import TriMesh
from lightsim.geometry.actors.returns import returns_of_actors
from lightsim.geometry.surface import make_mesh
from lightsim.render.casters.embree import make_embree_caster

_RAYS = 40_000
_FAR_M = 15.0
_WELL_SEEN = 200


def outer_points(mesh: TriMesh, size_lwh_m: np.ndarray) -> np.ndarray:
    """Where rays from outside, above the ground, meet it."""
    rng = np.random.default_rng(0)
    towards = rng.normal(size=(_RAYS, 3))
    towards[:, 2] = -0.7 * np.abs(towards[:, 2])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    origins = rng.uniform(-0.5, 0.5, (_RAYS, 3)) * size_lwh_m - _FAR_M * towards
    hits = make_embree_caster([replace(mesh, frame="world")]).intersect(origins, towards)
    return (origins + hits.distance_m[:, None] * towards)[hits.is_hit]


def silhouettes(mesh: TriMesh, size_lwh_m: np.ndarray) -> np.ndarray:
    """Parallel views from eight sides, slightly from above, as one mask."""
    caster = make_embree_caster([replace(mesh, frame="world")])
    masks = []
    for azimuth in np.arange(8) * np.pi / 4:
        towards = np.array([np.cos(azimuth), np.sin(azimuth), -0.15])
        towards /= np.linalg.norm(towards)
        right = np.cross(towards, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        across, up = np.meshgrid(
            np.linspace(-0.6, 0.6, 120) * size_lwh_m[0], np.linspace(-0.8, 0.8, 80) * size_lwh_m[2]
        )
        origins = across[..., None] * right + up[..., None] * np.cross(right, towards)
        origins = (origins - _FAR_M * towards).reshape(-1, 3)
        masks.append(caster.intersect(origins, np.tile(towards, (len(origins), 1))).is_hit)
    return np.concatenate(masks)


def scores(found: TriMesh, true: TriMesh, size_lwh_m: np.ndarray) -> list[float]:
    """F-scores within 5 and 10 cm, and the silhouettes' intersection over union."""
    points = [outer_points(mesh, size_lwh_m) for mesh in (found, true)]
    precision, recall = (KDTree(points[b]).query(points[a])[0] for a, b in ((0, 1), (1, 0)))
    result = []
    for limit_m in (0.05, 0.1):
        p, r = (precision < limit_m).mean(), (recall < limit_m).mean()
        result.append(float(2 * p * r / max(p + r, 1e-9)))
    a, b = (silhouettes(mesh, size_lwh_m) for mesh in (found, true))
    return [*result, float((a & b).sum() / max((a | b).sum(), 1))]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    options = parser.parse_args()
    work = Workspace(options.work)
    returns = returns_of_actors(work.log)
    truth = np.load(options.truth / "scene.npz")
    rows, counts = [], []
    for track in work.log.actors:
        if track.kind.is_vehicle:
            true = make_mesh(
                "actor",
                truth[f"{track.actor_id}/vertices"],
                truth[f"{track.actor_id}/faces"].astype(np.int64),
            )
            found = work.meshes.actors[track.actor_id].mesh
            rows.append(scores(found, true, track.size_lwh_m))
            counts.append(len(returns.get(track.actor_id, ())))
    table, is_seen = np.array(rows), np.array(counts) >= _WELL_SEEN
    sys.stdout.write("| vehicles | count | F@5 cm | F@10 cm | silhouettes IoU |\n")
    sys.stdout.write("|---|---:|---:|---:|---:|\n")
    for name, members in (
        ("all", np.ones(len(table), dtype=bool)),
        (f"{_WELL_SEEN} returns and more", is_seen),
        ("fewer", ~is_seen),
    ):
        mean = " | ".join(f"{value:.2f}" for value in table[members].mean(axis=0))
        sys.stdout.write(f"| {name} | {members.sum()} | {mean} |\n")


if __name__ == "__main__":
    main()
