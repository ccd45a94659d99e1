"""How this recording's LiDARs answer a surface: whether a beam comes back, how strong, how exact.

Nothing is modelled that the recording can tell. A simulated beam takes over what happened to a
recorded one in alike circumstances (hot-deck imputation, Andridge & Little 2010,
doi:10.1111/j.1751-5823.2010.00103.x): for the static scene and for actors of the log, one that met
the same place from about the same distance and angle; for others, one that met an actor of the same
sort. So weak returns of dark, far, grazing and specular surfaces are lost as often as in the log.
Surfels of recorded returns instead of the mesh follow LiDARsim (Manivasagam et al. 2020,
doi:10.1109/CVPR42600.2020.01118).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, Shaped
from scipy.spatial import KDTree

from lightsim.core.actors import ActorKind
from lightsim.lidar.beams import Beams
from lightsim.lidar.ray_scene import Surfaces

MOST_DONORS = 1_500_000
"""Recorded beams that are kept: 24 of them lie within 0.3 m of most places of sequence 002."""
_PLACE_M = 0.5
_LOG_DISTANCE = 0.5
_COSINE = 0.5
_ROUGHNESS = 0.2
"""Differences that count alike: half a metre, a distance two thirds farther, 60 degrees instead of
head-on, paint instead of glass."""
_ALIKE = 8
"""Donors among which chance decides."""
_SURFEL = 24
"""Returns that make a plane."""
_FAR = 2.0
"""In the units above: donors beyond are of another place."""
_LEAST_COSINE = 0.02
_MOST_STEP_M = 0.3
"""The surface of the returns lies that near to the mesh, or is another one."""
_FLAT_M = 0.05
"""RMS of returns about their plane; rougher places keep the mesh. Returns in one line, which is
less wide, have the mesh's tilt about it."""


@dataclass(frozen=True, eq=False)
class Answers:
    """What came back of beams.

    Args:
        is_returned: whether anything did.
        intensity: 0 to 255.
        semantic_class: of the log; -1 unknown.
    """

    is_returned: Bool[np.ndarray, " n"]
    intensity: Float32[np.ndarray, " n"]
    semantic_class: Int64[np.ndarray, " n"]

    @classmethod
    def nothing(cls, count: int) -> Answers:
        """Of beams that did not come back."""
        none = np.full(count, -1, dtype=np.int64)
        return cls(np.zeros(count, dtype=bool), np.zeros(count, np.float32), none)

    @classmethod
    def joined(cls, parts: Sequence[Answers]) -> Answers:
        """All answers of all parts, of one or more."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))

    def chosen(self, rows: Shaped[np.ndarray, "..."]) -> Answers:
        """Some of them."""
        return Answers(*(getattr(self, f.name)[rows] for f in fields(self)))

    def fill(self, rows: Int64[np.ndarray, " k"], other: Answers) -> None:
        """Put others in their places."""
        for field in fields(self):
            getattr(self, field.name)[rows] = getattr(other, field.name)


@dataclass(frozen=True, eq=False)
class Donors:
    """Recorded beams that met one body, by one LiDAR.

    Args:
        places: metres, in the body's own frame; where the beam was returned from, or would have
            been.
        looks: log of the distance, cosine of incidence, roughness: in the units that count alike.
        answers: what came back.
    """

    places: Float32[np.ndarray, "n 3"]
    looks: Float32[np.ndarray, "n 3"]
    answers: Answers

    @classmethod
    def joined(cls, parts: Sequence[Donors]) -> Donors:
        """All donors of all parts, of one or more."""
        places, looks = (
            np.concatenate([getattr(p, n) for p in parts]) for n in ("places", "looks")
        )
        return cls(places, looks, Answers.joined([p.answers for p in parts]))

    def __len__(self) -> int:
        return len(self.places)


Sort = str
"""Of bodies that answer alike: "static", "vehicle", "person" or "other"."""


def sort_of(kind: ActorKind | None) -> Sort:
    """Which bodies answer like this one; None is the static scene."""
    if kind is None:
        return "static"
    if kind.is_vehicle:
        return "vehicle"
    return "person" if kind.is_person else "other"


def looks_of(beams: Beams, met: Surfaces) -> Float32[np.ndarray, "n 3"]:
    """How beams meet surfaces, in units that count alike."""
    distance = np.log(np.clip(met.distance_m, 0.1, 1e4)) / _LOG_DISTANCE
    looks = np.stack([distance, met.cosine / _COSINE, met.roughness / _ROUGHNESS], axis=1)
    return looks.astype(np.float32)


class Response:
    """Answers of one recording.

    Args:
        donors: by (device, body), a body being an actor's id or "" for the static scene.
        kinds: of the actors among the bodies.
        noise_m: standard deviation of ranges, by device; not of those that had too few returns.
    """

    def __init__(
        self,
        donors: Mapping[tuple[int, str], Donors],
        kinds: Mapping[str, ActorKind],
        noise_m: Mapping[int, float],
    ) -> None:
        self._donors = {key: d for key, d in donors.items() if len(d) >= _ALIKE}
        self._kinds = kinds
        self.noise_m = noise_m
        self._by_place: dict[tuple[int, str], KDTree] = {}
        self._by_look: dict[tuple[int, Sort], tuple[KDTree, Answers]] = {}

    def answer(
        self,
        device: int,
        body: str,
        kind: ActorKind | None,
        met: tuple[Float[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]],
        rng: np.random.Generator,
    ) -> Answers:
        """What comes back of one body's surfaces.

        Args:
            body: an actor's id, "" for the static scene.
            met: places in the body's frame, and looks.
        """
        places, looks = met
        found = self._like_look(device, sort_of(kind), looks, rng)
        own = self._donors.get((device, body))
        if own is None:
            return found
        wanted = _features(places, looks)
        far, near = nearest(self._tree(device, body), wanted, _ALIKE, _FAR)
        rows = np.flatnonzero(np.isfinite(far).all(axis=1))
        pick = near[rows, rng.integers(0, _ALIKE, len(rows))]
        found.fill(rows, own.answers.chosen(pick))
        return found

    def refined_m(self, device: int, beams: Beams, met: Surfaces) -> Float64[np.ndarray, " n"]:
        """Distances to the static scene as its recorded returns have it: to the plane through those
        around the place where a beam meets the mesh, which is smoother and coarser."""
        own = self._donors.get((device, ""))
        distance = met.distance_m.copy()
        if own is None or len(own) < _SURFEL or not len(beams):
            return distance
        features = _features(beams.at(distance), looks_of(beams, met))
        far, near = nearest(self._tree(device, ""), features, _SURFEL, _FAR)
        rows = np.flatnonzero(np.isfinite(far).all(axis=1))
        points = own.places[near[rows]].astype(np.float64)
        weight = own.answers.is_returned[near[rows]].astype(np.float64)
        centre, normal, variance = fitted_planes(points, weight, met.normal[rows])
        along = (normal * beams.directions_world[rows]).sum(axis=1)
        offset = ((centre - beams.origins_world[rows]) * normal).sum(axis=1)
        is_crossed = np.abs(along) > _LEAST_COSINE
        plane = offset / np.where(is_crossed, along, 1.0)
        is_plane = is_crossed & (variance < _FLAT_M**2) & (weight.sum(axis=1) >= _SURFEL / 2)
        is_plane &= np.abs(plane - distance[rows]) < _MOST_STEP_M
        distance[rows[is_plane]] = plane[is_plane]
        return distance

    def _like_look(
        self, device: int, sort: Sort, looks: Float32[np.ndarray, "n 3"], rng: np.random.Generator
    ) -> Answers:
        for wanted in dict.fromkeys((sort, "vehicle", "static")):
            tree, answers = self._looks(device, wanted)
            if answers.is_returned.any():
                near = nearest(tree, looks, _ALIKE)[1]
                pick = near[np.arange(len(looks)), rng.integers(0, _ALIKE, len(looks))]
                return answers.chosen(pick)
        return Answers.nothing(len(looks))

    def _tree(self, device: int, body: str) -> KDTree:
        key = device, body
        if key not in self._by_place:
            own = self._donors[key]
            self._by_place[key] = KDTree(_features(own.places, own.looks), balanced_tree=False)
        return self._by_place[key]

    def _looks(self, device: int, sort: Sort) -> tuple[KDTree, Answers]:
        key = device, sort
        if key not in self._by_look:
            alike = [
                d for (other, body), d in self._donors.items()
                if other == device and sort_of(self._kinds.get(body)) == sort
            ]  # fmt: skip
            self._by_look[key] = _pool(alike)
        return self._by_look[key]


def _pool(donors: Sequence[Donors]) -> tuple[KDTree, Answers]:
    if not donors:
        return KDTree(np.zeros((1, 3))), Answers.nothing(1)
    every = Donors.joined(donors)
    return KDTree(every.looks, balanced_tree=False), every.answers


def fitted_planes(
    points: Float[np.ndarray, "n k 3"],
    weight: Float[np.ndarray, "n k"],
    tilt: Float[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """Centre, unit normal and variance across of the plane through each group of points.

    Args:
        tilt: unit normals that planes through points in one line should have; 0: any.
    """
    part = (weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9))[..., None]
    centre = (part * points).sum(axis=1)
    spread = points - centre[:, None]
    moments = np.einsum("nki,nkj->nij", part * spread, spread)
    # As if the points were a little wide along the plane of that tilt.
    wide = moments + _FLAT_M**2 * (np.eye(3) - tilt[:, :, None] * tilt[:, None, :])
    normal = np.linalg.eigh(wide).eigenvectors[:, :, 0]
    return centre, normal, np.einsum("ni,nij,nj->n", normal, moments, normal)


def nearest(
    tree: KDTree, wanted: Float[np.ndarray, "n d"], count: int, within: float = np.inf
) -> tuple[Float64[np.ndarray, "n k"], Int64[np.ndarray, "n k"]]:
    """Distances and numbers of the nearest few."""
    far, near = tree.query(wanted, k=count, workers=1, distance_upper_bound=within)
    return np.asarray(far), np.asarray(near, dtype=np.int64)


def _features(
    places: Float[np.ndarray, "n 3"], looks: Float[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 5"]:
    """Place, distance and angle; what a place is made of follows from the place."""
    return np.concatenate([places / _PLACE_M, looks[:, :2]], axis=1).astype(np.float32)
