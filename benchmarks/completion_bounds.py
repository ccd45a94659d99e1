"""How far any completion of what sensors did not see can bring the shadows of other suns.

    python benchmarks/completion_bounds.py WORK --truth DIR

Shadows as in `target_shadows.py`, of the twin's measured surfaces with one completion or another:
today's; none; today's with roofs that no view shows at their true height; one occupancy of 0.5 m
voxels (`decisions/0009-completion.md`) solved from what views and walls tell, and the true one in
its place; and all true surface that lies further than some way from what was measured.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import no_type_check

import numpy as np
from numba import njit
from scipy.ndimage import binary_dilation
from scipy.spatial import KDTree
from target_shadows import score

from lightsim.build.assemble import roofs_over
from lightsim.build.static_returns import static_returns
from lightsim.build.workspace import Workspace
from lightsim.core.buildings import Roofline
from lightsim.core.mesh import Provenance, TriMesh, concatenate_meshes
from lightsim.geometry.completion.crowns import Beams, Crowns
from lightsim.geometry.completion.far_walls import find_far_walls
from lightsim.geometry.completion.free_space import FreeSpace, find_free_space
from lightsim.geometry.completion.view_evidence import ViewEvidence
from lightsim.geometry.completion.walls import find_walls
from lightsim.geometry.surface import keep_faces, make_mesh
from lightsim.render.casters.embree import make_embree_caster
from lightsim_lab.synthetic.reader import read_true_meshes

_BEYOND_M = (0.25, 1.0)
"""True surface counts as not measured from here on."""
_EDGE_M, _NEAR_M, _SAMPLE_M = 0.5, 60.0, 0.15
"""True faces are split to this edge up to so far, and measured surface is sampled this densely."""
_HOUSE_M2, _HOUSE_HEIGHT_M = 0.5, 2.0
"""Faces this large that stand this high over the ground are true houses', not trees'."""
_REACH_M, _HEIGHT_M = 75.0, 32.0
"""Of the occupancy around the path."""
# Per voxel: of a prism behind a measured wall, of what a view looked through, of all others, and
# the most that the heights of houses say (log-normal; 0.3 as the spread within a street).
_BEHIND, _SEEN_THROUGH, _ELSEWHERE, _TALL = -0.3, 1.0, 0.1, 0.2
_LOG_STD, _DEPTH_M, _FENCE_M = 0.3, 12.35, 3.0
# Per face between voxels: upright, roof, and overhang, which prisms do not have.
_SIDE, _ROOF, _OVERHANG, _ROUNDS = np.float32(0.15), np.float32(0.1), np.float32(2.0), 180


@njit(cache=True, fastmath=True)
@no_type_check
def solve_occupancy(cost, side, roof, overhang, rounds):
    """Least cost @ u + total variation over u in [0, 1]: the graph cut's exact convex relaxation
    (Chambolle and Pock 2011, doi:10.1007/s10851-010-0251-1)."""
    u = (cost < 0).astype(np.float32)
    ahead = u.copy()
    dual = np.zeros((3, *cost.shape), np.float32)
    low, high = (-side, -side, -roof), (side, side, overhang)
    nx, ny, nz = cost.shape
    for _ in range(rounds):
        for i in range(nx):
            for j in range(ny):
                for k in range(nz):
                    v = ahead[i, j, k]
                    dx = ahead[min(i + 1, nx - 1), j, k] - v
                    dy = ahead[i, min(j + 1, ny - 1), k] - v
                    dz = ahead[i, j, min(k + 1, nz - 1)] - v
                    dual[0, i, j, k] = min(max(dual[0, i, j, k] + 0.5 * dx, low[0]), high[0])
                    dual[1, i, j, k] = min(max(dual[1, i, j, k] + 0.5 * dy, low[1]), high[1])
                    dual[2, i, j, k] = min(max(dual[2, i, j, k] + 0.5 * dz, low[2]), high[2])
        for i in range(nx):
            for j in range(ny):
                for k in range(nz):
                    slope = cost[i, j, k]
                    slope -= dual[0, i, j, k] + dual[1, i, j, k] + dual[2, i, j, k]
                    slope += dual[0, i - 1, j, k] if i > 0 else 0.0
                    slope += dual[1, i, j - 1, k] if j > 0 else 0.0
                    slope += dual[2, i, j, k - 1] if k > 0 else 0.0
                    new = min(max(u[i, j, k] - slope / 6, 0.0), 1.0)
                    ahead[i, j, k], u[i, j, k] = 2 * new - u[i, j, k], new
    return u


@dataclass(eq=False)
class _Scene:
    """The twin without guesses, the truth, and voxels that some view looked through."""

    work: Workspace
    measured: TriMesh
    true: TriMesh
    space: FreeSpace

    @classmethod
    def of(cls, work: Workspace, truth: Path) -> _Scene:
        twin = replace(work.twin.assets.background, texture=None)
        is_guess = twin.has_provenance(Provenance.INFERRED)
        measured = keep_faces(twin, ~is_guess & ~twin.has_provenance(Provenance.BACKGROUND_PROXY))
        true = replace(read_true_meshes(truth / "scene.npz")["background"], face_provenance=None)
        log, caster = work.log_at(1.0), make_embree_caster([measured])
        views = ((f, log.cameras[f.camera_name], work.sky_matte(f)) for f in log.frames)
        space = find_free_space(measured, ViewEvidence(views), caster, _HEIGHT_M)
        path = work.fields.path_m
        low = np.append(path[:, :2].min(axis=0) - _REACH_M, -np.inf)
        high = np.append(path[:, :2].max(axis=0) + _REACH_M, np.inf)
        counts = np.array(space.is_free.shape)
        first, end = (
            np.clip((edge - space.low_m) / space.voxel_m, 0, counts).astype(np.int64)
            for edge in (low, high)
        )
        inner = tuple(slice(a, b) for a, b in zip(first, end, strict=True))
        space = replace(
            space, low_m=space.low_m + first * space.voxel_m, is_free=space.is_free[inner]
        )
        return cls(work, measured, true, space)

    @property
    def columns_m(self) -> np.ndarray:
        """x and y of the voxels."""
        axes = [
            low + self.space.voxel_m * (np.arange(count) + 0.5)
            for low, count in zip(self.space.low_m, self.space.is_free.shape, strict=True)
        ]
        return np.stack(np.meshgrid(*axes[:2], indexing="ij"), axis=-1)

    @property
    def levels_m(self) -> np.ndarray:
        """z of the voxels."""
        return self.space.low_m[2] + self.space.voxel_m * (
            np.arange(self.space.is_free.shape[2]) + 0.5
        )

    def ground_m(self) -> np.ndarray:
        """Under each column."""
        xy = self.columns_m
        return self.work.fields.ground.look_up(xy.reshape(-1, 2)).reshape(xy.shape[:2])

    def solved(self) -> np.ndarray:
        """The occupancy from what sensors tell."""
        returns = static_returns(self.work.log_at(1.0), 3_000_000, np.random.default_rng(0))
        walls = find_walls(self.measured)
        walls += find_far_walls(
            walls,
            Beams(returns.origins, returns.points),
            ViewEvidence([]),
            Crowns.none(self.work.fields.path_m),
            self.work.fields.ground,
            make_embree_caster([self.measured]),
        )
        xy, ground = self.columns_m, self.ground_m()
        top = np.full(ground.shape, -np.inf)
        for wall in walls:
            if wall.height_m[1] - wall.height_m[0] > _FENCE_M:
                s, out = wall.place(np.dstack([xy, np.zeros(ground.shape)]))
                is_behind = (s > wall.span_m[0]) & (s < wall.span_m[1])
                is_behind &= (out < 0) & (out > -_DEPTH_M)
                top[is_behind] = np.maximum(top[is_behind], wall.height_m[1])
        height = self.levels_m - ground[..., None]
        seen = [r.height_m[r.is_seen] for r in self.work.initial_rooflines]
        usual = np.median(np.concatenate([s[s > _FENCE_M] for s in seen]))
        tall = 0.5 * _TALL * np.log(np.maximum(height, 0.5) / usual) / _LOG_STD
        is_behind = np.isfinite(top)[..., None] & (height > 0)
        cost = np.where(is_behind, np.clip(tall, -_TALL, _TALL), _ELSEWHERE)
        cost[is_behind & (self.levels_m < top[..., None])] = _BEHIND
        cost += _SEEN_THROUGH * self.space.is_free
        return solve_occupancy(cost.astype(np.float32), _SIDE, _ROOF, _OVERHANG, _ROUNDS)

    def true_occupancy(self) -> np.ndarray:
        """Under the roofs of the true houses, finer than a voxel in height."""
        xy, ground = self.columns_m.reshape(-1, 2), self.ground_m()
        houses = make_embree_caster([keep_faces(self.true, self.true.face_areas_m2() > _HOUSE_M2)])
        start = np.c_[xy, np.full(len(xy), 90.0)]
        down = np.broadcast_to([0.0, 0.0, -1.0], start.shape).copy()
        top = (90.0 - houses.intersect(start, down).distance_m).reshape(ground.shape)
        top = np.where(top - ground > _HOUSE_HEIGHT_M, top, -np.inf)
        return np.clip((top[..., None] - self.levels_m) / self.space.voxel_m + 0.5, 0.0, 1.0)

    def surface_of(self, occupancy: np.ndarray) -> TriMesh:
        """Where it passes one half, but for the voxels in and beside measured surface."""
        from skimage.measure import marching_cubes

        near = np.zeros(occupancy.shape, dtype=bool)
        cell = np.floor((_samples(self.measured) - self.space.low_m) / self.space.voxel_m)
        is_inside = ((cell >= 0) & (cell < near.shape)).all(axis=1)
        near[tuple(cell[is_inside].astype(np.int64).T)] = True
        kept = np.where(binary_dilation(near), 0.0, occupancy)
        points, faces, _, _ = marching_cubes(np.pad(kept.astype(np.float32), 1), 0.5)
        points = (points - 0.5) * self.space.voxel_m + self.space.low_m
        return make_mesh("world", points, faces.astype(np.int64))

    def unmeasured_truth(self) -> tuple[TriMesh, np.ndarray]:
        """True surface in small faces, and how far each is from measured surface (inf: further
        than asked for)."""
        points = self.true.vertices[self.true.faces].astype(np.float64)
        fields, done = self.work.fields, []
        while len(points):
            edges = np.linalg.norm(points - np.roll(points, -1, axis=1), axis=2)
            middle = points.mean(axis=1)
            away = np.linalg.norm(middle[:, :2] - fields.path_m[:, :2].mean(axis=0), axis=1)
            is_high = points[..., 2].max(axis=1) > fields.ground.look_up(middle[:, :2]) + _EDGE_M
            is_large = is_high & (
                edges.max(axis=1) > _EDGE_M * np.maximum(1.0, away / _NEAR_M) ** 2
            )
            done.append(points[is_high & ~is_large])
            turn = (edges[is_large].argmax(axis=1)[:, None] + np.arange(3)) % 3
            a, b, c = np.moveaxis(np.take_along_axis(points[is_large], turn[..., None], 1), 1, 0)
            middle = 0.5 * (a + b)
            points = np.concatenate([np.stack(t, axis=1) for t in ((a, middle, c), (middle, b, c))])
        corners = np.concatenate(done)
        distance, _ = KDTree(_samples(self.measured)).query(
            corners.mean(axis=1), distance_upper_bound=max(_BEYOND_M)
        )
        flat = corners.reshape(-1, 3)
        return make_mesh("world", flat, np.arange(len(flat)).reshape(-1, 3)), np.asarray(distance)


def _samples(mesh: TriMesh) -> np.ndarray:
    """Points of its surface, evenly."""
    rng, area = np.random.default_rng(0), mesh.face_areas_m2()
    face = rng.choice(len(area), int(area.sum() / _SAMPLE_M**2), p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), len(face))
    return (mesh.vertices[mesh.faces[face]] * weights[..., None]).sum(axis=1)


def _true_roofs(scene: _Scene) -> list[Roofline]:
    """Today's, but for those that no view shows: these as high as the true house behind them."""
    caster, found = make_embree_caster([scene.true]), []
    for roofline in scene.work.rooflines:
        start = roofline.wall.at(roofline.s_m, np.full_like(roofline.s_m, 90.0), -1.0)
        down = np.broadcast_to([0.0, 0.0, -1.0], start.shape).copy()
        high = 90.0 - caster.intersect(start, down).distance_m - roofline.wall.height_m[0]
        top = np.maximum(np.round(high / roofline.cell_m), 0).astype(np.int64)
        found.append(replace(roofline, top=np.where(roofline.is_seen, roofline.top, top)))
    return found


def completions(scene: _Scene) -> Iterator[tuple[str, TriMesh, TriMesh]]:
    """Their names, what cameras see with them, and what casts shadows besides."""
    twin = replace(scene.work.twin.assets.background, texture=None)
    plain = replace(scene.measured, face_provenance=None, face_material=None)
    proxy = keep_faces(twin, twin.has_provenance(Provenance.BACKGROUND_PROXY))
    street = concatenate_meshes([scene.measured, proxy])
    yield "today's", twin, scene.work.unobserved_occluders
    yield "none", street, keep_faces(plain, np.zeros(len(plain.faces), dtype=bool))
    yield "today's, hidden roofs true", twin, roofs_over(twin, _true_roofs(scene))
    yield "one occupancy", street, scene.surface_of(scene.solved())
    yield "one occupancy, true", street, scene.surface_of(scene.true_occupancy())
    truth, distance_m = scene.unmeasured_truth()
    for beyond_m in _BEYOND_M:
        extra = keep_faces(truth, distance_m > beyond_m)
        yield f"all that is true beyond {beyond_m:g} m", street, extra


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, required=True)
    options = parser.parse_args()
    work = Workspace(options.work)
    sys.stdout.write("| completion, sun | IoU | missing % | false % |\n|---|---:|---:|---:|\n")
    for name, visible, casters in completions(_Scene.of(work, options.truth)):
        for elevation, shadows in score(work, options.truth, visible, casters).items():
            sys.stdout.write(shadows.row(f"{name}, {elevation:.0f} degrees"))
            sys.stdout.flush()


if __name__ == "__main__":
    main()
