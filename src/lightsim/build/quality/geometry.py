"""How well meshes agree with LiDAR, and with true meshes where there are any."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from lightsim.core.casting import MakeCaster, RayCaster
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import LazySweep, LidarSweep
from lightsim.errors import InputError
from lightsim.progress import Progress, SilentProgress

_MOST_ROUNDS = 30
_IN_SIGHT_M = 0.02
ActorsAt = Callable[[int], Sequence[TriMesh]]
"""Actor meshes in frame `world` at a time, ns."""


# What the measure is defined by.

# LiDAR returns drawn from each sweep.
_RETURNS_PER_SWEEP = 20_000
# Nearer returns are the ego vehicle itself.
_LEAST_DISTANCE_M = 3.0
# Farther returns do not count.
_LARGEST_DISTANCE_M = 80.0
# True surface farther than this from every LiDAR return was not seen and is not asked for.
_SEEN_WITHIN_M = 0.3
# Distances below which a point counts as right.
THRESHOLDS_M = (0.05, 0.10)


@dataclass(frozen=True)
class GeometryConfig:
    """How much is measured."""

    samples: int = 100_000
    """Points drawn from each surface for the F-score."""
    support_samples: int = 1_000_000
    """Points by which the nearest triangle of the other surface is found."""


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """What sensors can have seen of a scene.

    Args:
        points_world: LiDAR returns; surface near one counts.
        viewpoints_world: sensor positions; true surface counts only where a straight line leads
            to one of them, so that the far side of a thin wall is not asked for.
        make_caster: of rays against the true mesh.
    """

    points_world: Float[np.ndarray, "n 3"]
    viewpoints_world: Float[np.ndarray, "k 3"]
    make_caster: MakeCaster

    def is_visible(
        self, points_world: Float[np.ndarray, "n 3"], truth: TriMesh
    ) -> Bool[np.ndarray, " n"]:
        """Which points on the true mesh are in sight of a sensor position."""
        caster = self.make_caster([truth])
        visible = np.zeros(len(points_world), dtype=bool)
        for viewpoint in self.viewpoints_world:
            rows = np.flatnonzero(~visible)
            offset = points_world[rows] - viewpoint
            distance = np.linalg.norm(offset, axis=1)
            directions = offset / np.maximum(distance, 1e-9)[:, None]
            hits = caster.intersect(np.broadcast_to(viewpoint, offset.shape).copy(), directions)
            visible[rows] = hits.distance_m > distance - _IN_SIGHT_M
        return visible


@dataclass(frozen=True)
class LidarScores:
    """Distance along the beam, mesh against return. Errors are those of beams that hit.

    Args:
        count: returns compared.
        hit_rate: fraction of the beams that meet a mesh at all.
        median_abs_m: median of the absolute error.
        percentile_90_m: 90th percentile of it.
        median_signed_m: positive where meshes lie behind the returns.
        within_10_cm: fraction of all beams whose error is below 10 cm.
        median_across_m: median of the error across the surface (times the cosine of incidence):
            a road met at two degrees turns 1 cm of height into 30 cm along the beam.
    """

    count: int
    hit_rate: float
    median_abs_m: float
    percentile_90_m: float
    median_signed_m: float
    within_10_cm: float
    median_across_m: float


@dataclass(frozen=True)
class SurfaceScores:
    """Precision, recall and their harmonic mean at one distance (Knapitsch et al. 2017,
    doi:10.1145/3072959.3073599)."""

    threshold_m: float
    precision: float
    recall: float

    @property
    def f_score(self) -> float:
        """Harmonic mean of precision and recall; 0 where both are 0."""
        total = self.precision + self.recall
        return 2 * self.precision * self.recall / total if total > 0 else 0.0


@dataclass(frozen=True)
class GeometryReport:
    """What was measured; `surface` is empty without a true mesh."""

    lidar: LidarScores
    surface: tuple[SurfaceScores, ...] = ()

    def to_table(self) -> str:
        """Markdown."""
        s = self.lidar
        lines = [
            "| LiDAR returns | hit rate | median abs m | 90 % m | median signed m | < 10 cm "
            "| median across m |",
            "|---:|---:|---:|---:|---:|---:|---:|",
            f"| {s.count} | {s.hit_rate:.3f} | {s.median_abs_m:.3f} | {s.percentile_90_m:.3f} "
            f"| {s.median_signed_m:+.3f} | {s.within_10_cm:.3f} "
            f"| {s.median_across_m:.3f} |",
        ]
        if self.surface:
            lines += ["", "| within m | precision | recall | F-score |", "|---:|---:|---:|---:|"]
        for row in self.surface:
            lines.append(
                f"| {row.threshold_m:.2f} | {row.precision:.3f} | {row.recall:.3f} "
                f"| {row.f_score:.3f} |"
            )
        return "\n".join(lines)

    def to_json(self) -> str:
        """LiDAR and surface scores, the F-score of each threshold included."""
        surface = [asdict(row) | {"f_score": row.f_score} for row in self.surface]
        return json.dumps({"lidar": asdict(self.lidar), "surface": surface}, indent=2)


def evaluate_lidar(
    sweeps: Sequence[LazySweep],
    background: Sequence[TriMesh],
    actors_at: ActorsAt,
    *,
    make_caster: MakeCaster,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> LidarScores:
    """Beams of the sweeps cast again on the meshes. The nearer of background and actors counts.

    Raises:
        InputError: there is no sweep, or none has a return in range.
    """
    progress = progress or SilentProgress()
    caster = make_caster(background)
    beams: list[np.ndarray] = []
    for lazy in progress.track(sweeps, "cast LiDAR beams"):
        origins, directions, distances = _draw_beams(lazy.load(), rng)
        if not len(distances):
            continue
        found, cosine = _cast(caster, origins, directions)
        actors = actors_at(lazy.time_ns)
        if actors:
            nearer, other = _cast(make_caster(actors), origins, directions)
            cosine = np.where(nearer < found, other, cosine)
            found = np.minimum(found, nearer)
        beams.append(np.stack([distances, found, cosine], axis=1))
    if not beams:
        raise InputError(
            "no LiDAR return to compare with",
            got=f"{len(sweeps)} sweeps",
            expected=f"returns {_LEAST_DISTANCE_M:g} to {_LARGEST_DISTANCE_M:g} m away",
        )
    return _lidar_scores(np.concatenate(beams))


def _cast(
    caster: RayCaster, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Distance, and cosine between beam and face normal, of each beam."""
    hits = caster.intersect(origins, directions)
    cosine = np.zeros(len(origins))
    for index, mesh in enumerate(caster.meshes):
        rows = np.flatnonzero(hits.is_hit & (hits.mesh_index == index))
        corners = mesh.vertices[mesh.faces[hits.face_index[rows]]].astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        cosine[rows] = np.abs((normal * directions[rows]).sum(axis=1))
    return hits.distance_m.astype(np.float64), cosine


def _draw_beams(
    sweep: LidarSweep, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Origins, unit directions and distances of some returns in range."""
    along = sweep.points_world.astype(np.float64) - sweep.origins_world
    distances = np.linalg.norm(along, axis=1)
    in_range = (distances > _LEAST_DISTANCE_M) & (distances < _LARGEST_DISTANCE_M)
    chosen = np.flatnonzero(in_range)
    if len(chosen) > _RETURNS_PER_SWEEP:
        chosen = rng.choice(chosen, _RETURNS_PER_SWEEP, replace=False)
    distances = distances[chosen]
    return (
        sweep.origins_world[chosen].astype(np.float64),
        along[chosen] / distances[:, None],
        distances,
    )


def _lidar_scores(beams: Float[np.ndarray, "n 3"]) -> LidarScores:
    """Of measured distances, cast distances and cosines."""
    measured, cast, cosine = beams.T
    is_hit = np.isfinite(cast)
    if not is_hit.any():
        nan = float("nan")
        return LidarScores(len(measured), 0.0, nan, nan, nan, 0.0, nan)
    signed = cast[is_hit] - measured[is_hit]
    absolute = np.abs(signed)
    return LidarScores(
        count=len(measured),
        hit_rate=float(is_hit.mean()),
        median_abs_m=float(np.median(absolute)),
        percentile_90_m=float(np.percentile(absolute, 90)),
        median_signed_m=float(np.median(signed)),
        within_10_cm=float((absolute < 0.10).sum() / len(measured)),
        median_across_m=float(np.median(absolute * cosine[is_hit])),
    )


def evaluate_surface(
    predicted: TriMesh,
    truth: TriMesh,
    config: GeometryConfig,
    *,
    seen: SeenSurface | None = None,
    rng: np.random.Generator,
) -> tuple[SurfaceScores, ...]:
    """Precision and recall of a mesh against the true one, both in frame `world`.

    Args:
        seen: what sensors saw; both surfaces count only there, so that neither backs of houses are
            asked for, nor plausible guesses punished.

    Raises:
        InputError: a mesh is empty or nothing of it was seen.
    """
    made = sample_distances(predicted, truth, config, seen, False, rng).distance_m
    true = sample_distances(truth, predicted, config, seen, True, rng).distance_m
    return tuple(
        SurfaceScores(t, float((made < t).mean()), float((true < t).mean())) for t in THRESHOLDS_M
    )


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points on a surface.

    Args:
        points_world: evenly by area.
        faces: of the surface, that they lie on.
        distance_m: to the nearest point of another surface.
    """

    points_world: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, " n"]
    distance_m: Float[np.ndarray, " n"]


def sample_distances(
    mesh: TriMesh,
    other: TriMesh,
    config: GeometryConfig,
    seen: SeenSurface | None,
    is_truth: bool,
    rng: np.random.Generator,
) -> SurfaceSamples:
    """Points on the seen part of `mesh`, and how far the surface of `other` is.

    Args:
        is_truth: `mesh` is the true one, of which only what is in sight of a sensor counts.

    Raises:
        InputError: nothing of the mesh was seen.
    """
    from trimesh.triangles import closest_point

    radius = _SEEN_WITHIN_M
    points, on = _sample_near(mesh, config.samples, seen, radius, rng)
    if seen is not None and is_truth and len(points):
        is_visible = seen.is_visible(points, mesh)
        points, on = points[is_visible], on[is_visible]
    if not len(points):
        raise InputError(
            "no seen surface to compare",
            where="true mesh" if is_truth else "mesh of the twin",
            expected=f"surface within {radius:g} m of a LiDAR return and in sight of the sensors",
            remedy="Give the truth of the log that the twin was built from.",
        )
    # The nearest triangle of the other surface may lie a little further out.
    support, faces = _sample_near(other, config.support_samples, seen, 3 * radius, rng)
    corners = other.vertices[other.faces].astype(np.float64)
    nearest = KDTree(support).query(points, k=8, workers=1)[1]
    best = np.full(len(points), np.inf)
    for column in np.asarray(nearest).T:
        on_face = closest_point(corners[faces[column]], points)
        best = np.minimum(best, np.linalg.norm(on_face - points, axis=1))
    return SurfaceSamples(points, on, best)


def _sample_near(
    mesh: TriMesh,
    count: int,
    seen: SeenSurface | None,
    radius_m: float,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """About `count` points on the seen part of a mesh, evenly by area, and their faces.

    The density must not depend on how much of the mesh lies elsewhere (a far background proxy, the
    outer ground): samples are drawn until enough lie near what was seen.
    """
    if seen is None:
        return sample_surface(mesh, count, rng)
    tree = KDTree(seen.points_world)
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    found = 0
    for _ in range(_MOST_ROUNDS):
        points, faces = sample_surface(mesh, count, rng)
        distance = tree.query(points, distance_upper_bound=radius_m, workers=1)[0]
        is_near = np.isfinite(np.asarray(distance))
        parts.append((points[is_near], faces[is_near]))
        found += int(is_near.sum())
        if found >= count:
            break
    points, faces = (np.concatenate([part[k] for part in parts]) for k in range(2))
    return points[:count], faces[:count]


def sample_surface(
    mesh: TriMesh, count: int, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Points spread evenly by area over a mesh, metres, and the faces they lie on.

    Raises:
        InputError: the mesh has no area.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    area = mesh.face_areas_m2()
    if not area.sum() > 0:
        raise InputError(
            "a mesh without area cannot be sampled",
            where=f"mesh in '{mesh.frame}'",
            got=f"{area.sum():g} m2 in {len(mesh.faces)} faces",
            expected="an area above 0 m2",
        )
    faces = rng.choice(len(area), count, p=area / area.sum())
    u, v = rng.random((2, count))
    is_outside = u + v > 1
    u, v = np.where(is_outside, 1 - u, u), np.where(is_outside, 1 - v, v)
    points = corners[faces, 0] + u[:, None] * edges[faces, 0] + v[:, None] * edges[faces, 1]
    return points, faces
