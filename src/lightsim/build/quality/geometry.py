"""Agreement of meshes with LiDAR and, if available, with true meshes."""

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

# Largest number of rounds of drawing samples: enough if at least a thirtieth of the mesh's area was
# observed; else there are fewer samples.
_MOST_ROUNDS = 30
# Tolerance of the visibility test, in metres: far above the rounding of float32, far below the
# thickness of a wall.
_IN_SIGHT_M = 0.02
ActorsAt = Callable[[int], Sequence[TriMesh]]
"""Actor meshes in frame `world` at a time, ns."""


# The following constants define the measure: scores with other values are not comparable.

# LiDAR returns drawn from each sweep.
_RETURNS_PER_SWEEP = 20_000
# Nearer returns may be from the ego vehicle.
_LEAST_DISTANCE_M = 3.0
# Farther returns are ignored.
_LARGEST_DISTANCE_M = 80.0
# Surfaces farther than this from every LiDAR return count as unobserved and are ignored.
_SEEN_WITHIN_M = 0.3
# Distances below which a point counts as correct.
THRESHOLDS_M = (0.05, 0.10)


@dataclass(frozen=True)
class GeometryConfig:
    """Numbers of samples of the surface scores."""

    samples: int = 100_000
    """Points drawn from each surface for the F-score."""
    support_samples: int = 1_000_000
    """Points that locate the nearest triangle of the other surface."""


@dataclass(frozen=True, eq=False)
class SeenSurface:
    """Observed part of a scene.

    Args:
        points_world: LiDAR returns; surface near one of them counts.
        viewpoints_world: sensor positions; true surface counts only if visible from one of them,
            which excludes the far side of a thin wall.
        make_caster: makes the ray caster of the true mesh.
    """

    points_world: Float[np.ndarray, "n 3"]
    viewpoints_world: Float[np.ndarray, "k 3"]
    make_caster: MakeCaster

    def is_visible(
        self, points_world: Float[np.ndarray, "n 3"], truth: TriMesh
    ) -> Bool[np.ndarray, " n"]:
        """Return whether each point on the true mesh is visible from a sensor position."""
        caster = self.make_caster([truth])
        visible = np.zeros(len(points_world), dtype=bool)
        # One viewpoint after the other: points found visible are not tested again.
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
    """Errors of the mesh along LiDAR beams; beams without a hit have no error.

    Args:
        count: returns compared.
        hit_rate: fraction of the beams that meet a mesh.
        median_abs_m: median of the absolute error.
        percentile_90_m: 90th percentile of it.
        median_signed_m: median of the signed error; positive if meshes lie behind the returns.
        within_10_cm: fraction of all beams whose error is below 10 cm.
        median_across_m: median of the error perpendicular to the surface (times the cosine of
            incidence): at two degrees, 1 cm of road height is 30 cm along the beam.
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
    """LiDAR and surface scores; `surface` is empty without a true mesh."""

    lidar: LidarScores
    surface: tuple[SurfaceScores, ...] = ()

    def to_table(self) -> str:
        """Return a Markdown table."""
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
        """Return the scores as JSON, with the F-score of each threshold."""
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
    """Cast the beams of sweeps on the meshes; the nearest of background and actors counts.

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
            # Actors move from sweep to sweep, so that the large background keeps a caster of its
            # own.
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
    """Return the distance of each beam's hit, and the cosine between beam and face normal."""
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
    """Draw returns within the range limits: origins, unit directions and distances."""
    # Each beam from its own origin: the sensor moves during a sweep.
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
    """Score beams, given as columns of measured distance, cast distance and cosine."""
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
        # Fraction of all beams: one without a hit counts as wrong here, and is in no median.
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
    """Compute precision and recall of a mesh against the true one, both in frame `world`.

    Args:
        seen: observed part of the scene. Both surfaces count only there: backs of houses are not
            required, and plausible guesses are not penalised.

    Raises:
        InputError: a mesh is empty or no part of it was observed.
    """
    made = sample_distances(predicted, truth, config, seen, False, rng).distance_m
    true = sample_distances(truth, predicted, config, seen, True, rng).distance_m
    return tuple(
        SurfaceScores(t, float((made < t).mean()), float((true < t).mean())) for t in THRESHOLDS_M
    )


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Random points on a surface.

    Args:
        points_world: positions, uniform by area, in metres.
        faces: index of the face of each point.
        distance_m: distance to the nearest point of another surface.
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
    """Draw points on the observed part of `mesh`, with their distances to the surface of `other`.

    Args:
        is_truth: `mesh` is the true one, of which only points visible from a sensor count.

    Raises:
        InputError: no part of the mesh was observed.
    """
    from trimesh.triangles import closest_point

    radius = _SEEN_WITHIN_M
    points, on = _sample_near(mesh, config.samples, seen, radius, rng)
    if seen is not None and is_truth and len(points):
        is_visible = seen.is_visible(points, mesh)
        points, on = points[is_visible], on[is_visible]
    if not len(points):
        raise InputError(
            "no observed surface to compare",
            where="true mesh" if is_truth else "mesh of the twin",
            expected=f"surface within {radius:g} m of a LiDAR return and in sight of the sensors",
            remedy="Give the truth of the log that the twin was built from.",
        )
    # The nearest triangle of the other surface may lie slightly outside of the observed part.
    support, faces = _sample_near(other, config.support_samples, seen, 3 * radius, rng)
    corners = other.vertices[other.faces].astype(np.float64)
    # Distances to triangles, not to samples, whose density would limit the accuracy. The nearest
    # triangle is taken from those of the 8 nearest samples. Chosen; sensitivity not measured.
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
    """Draw about `count` points on the observed part of a mesh, uniform by area, with their faces.

    The density must not depend on the area elsewhere (a far background, the outer ground): samples
    are drawn until enough of them lie in the observed part.
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
    """Draw points on a mesh, uniform by area, in metres, with their faces.

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
    # The outer half of the parallelogram is folded onto the triangle, which keeps the density.
    is_outside = u + v > 1
    u, v = np.where(is_outside, 1 - u, u), np.where(is_outside, 1 - v, v)
    points = corners[faces, 0] + u[:, None] * edges[faces, 0] + v[:, None] * edges[faces, 1]
    return points, faces
