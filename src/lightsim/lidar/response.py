"""Responses of a recording's LiDARs to surfaces: probability of a return, intensity, and accuracy.

Nothing is modelled that the recording contains. A simulated beam takes the response of a recorded
one in similar circumstances (hot-deck imputation, Andridge & Little 2010,
doi:10.1111/j.1751-5823.2010.00103.x). For the static scene and for actors of the log, this donor
met the same place from about the same distance and angle; for other actors, it met an actor of the
same kind. Thus weak returns of dark, far, grazing and specular surfaces are lost as often as in the
log. Surfels of recorded returns instead of the mesh follow LiDARsim (Manivasagam et al. 2020,
doi:10.1109/CVPR42600.2020.01118).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from scipy.spatial import KDTree

from lightsim.core.actors import ActorKind
from lightsim.core.rows import Rows
from lightsim.lidar.beams import Beams
from lightsim.lidar.ray_scene import Surfaces

# Recorded beams in memory: 24 of them lie within 0.3 m of most places of PandaSet's sequence 002.
MOST_DONORS = 1_500_000
# Units of the distance between donors: one unit of each counts alike. Chosen; sensitivity not
# measured. First the unit of the position, in metres.
_PLACE_M = 0.5
# Units of the logarithm of the range (two thirds farther), of the cosine of incidence (60 degrees
# instead of perpendicular), and of roughness (paint instead of glass).
_LOOK_UNITS = np.array([0.5, 0.5, 0.2])
# Nearest donors, one of which is drawn at random. Chosen; sensitivity not measured.
_NEAREST_DONORS = 8
# Nearest returns to which a plane is fitted. Chosen; sensitivity not measured.
_SURFEL = 24
# Greatest distance of a donor in these units: farther ones belong to another place.
_FAR = 2.0

# Greatest distance between plane and mesh along a beam, in metres: otherwise they are different
# surfaces. Chosen; sensitivity not measured.
_MOST_STEP_M = 0.3
# Greatest RMS distance of returns from their plane, in metres; on rougher surfaces the mesh is
# used. Also the assumed width of returns along the mesh's tangent plane: returns in one line, which
# are narrower than that, take the plane's tilt about the line from the mesh.
_FLAT_M = 0.05


@dataclass(frozen=True, eq=False)
class BeamResponses(Rows):
    """Responses to beams.

    Args:
        is_returned: beams with a return.
        intensity: 0 to 255.
        semantic_class: of the log; -1 unknown.
    """

    is_returned: Bool[np.ndarray, " n"]
    intensity: Float32[np.ndarray, " n"]
    semantic_class: Int64[np.ndarray, " n"]

    @classmethod
    def nothing(cls, count: int) -> BeamResponses:
        """Return responses without a return."""
        none = np.full(count, -1, dtype=np.int64)
        return cls(np.zeros(count, dtype=bool), np.zeros(count, np.float32), none)


@dataclass(frozen=True, eq=False)
class Donors:
    """Recorded beams that met one body, by one LiDAR.

    Args:
        places: positions on the body, in its own frame, metres; for beams without a return, where
            they would have met it.
        looks: log of the distance, cosine of incidence, roughness, in units that count alike.
        responses: responses to the beams.
    """

    places: Float32[np.ndarray, "n 3"]
    looks: Float32[np.ndarray, "n 3"]
    responses: BeamResponses

    @classmethod
    def joined(cls, parts: Sequence[Donors]) -> Donors:
        """Concatenate one or more groups of donors."""
        places, looks = (
            np.concatenate([getattr(p, n) for p in parts]) for n in ("places", "looks")
        )
        return cls(places, looks, BeamResponses.joined([p.responses for p in parts]))

    def __len__(self) -> int:
        return len(self.places)


Sort = str
"""Group of bodies with similar responses: "static", "vehicle", "person" or "other"."""


def sort_of(kind: ActorKind | None) -> Sort:
    """Return the group of bodies with similar responses; the kind None is the static scene."""
    if kind is None:
        return "static"
    if kind.is_vehicle:
        return "vehicle"
    return "person" if kind.is_person else "other"


def looks_of(beams: Beams, met: Surfaces) -> Float32[np.ndarray, "n 3"]:
    """Return distance, incidence and roughness of beams on surfaces, in units that count alike."""
    distance = np.log(np.clip(met.distance_m, 0.1, 1e4))
    looks = np.stack([distance, met.cosine, met.roughness], axis=1) / _LOOK_UNITS
    return looks.astype(np.float32)


class Response:
    """Responses of the LiDARs of one recording.

    Args:
        donors: by (device, body), a body being an actor's id or "" for the static scene.
        kinds: of the actors among the bodies.
        noise_m: standard deviation of ranges, by device; without devices that had too few returns.
    """

    def __init__(
        self,
        donors: Mapping[tuple[int, str], Donors],
        kinds: Mapping[str, ActorKind],
        noise_m: Mapping[int, float],
    ) -> None:
        self._donors = {key: d for key, d in donors.items() if len(d) >= _NEAREST_DONORS}
        self._kinds = kinds
        self.noise_m = noise_m
        self._by_place: dict[tuple[int, str], KDTree] = {}
        self._by_look: dict[tuple[int, Sort], tuple[KDTree, BeamResponses]] = {}

    def respond(
        self,
        device: int,
        body: str,
        kind: ActorKind | None,
        met: tuple[Float[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]],
        rng: np.random.Generator,
    ) -> BeamResponses:
        """Return the responses to beams on one body.

        Args:
            body: an actor's id, "" for the static scene.
            met: places in the body's frame, and looks.
        """
        places, looks = met
        # Donors by look are the fallback for places without donors nearby.
        found = self._similar_look(device, sort_of(kind), looks, rng)
        own = self._donors.get((device, body))
        if own is None:
            return found
        wanted = _features(places, looks)
        far, near = nearest(self._tree(device, body), wanted, _NEAREST_DONORS, _FAR)
        rows = np.flatnonzero(np.isfinite(far).all(axis=1))
        pick = near[rows, rng.integers(0, _NEAREST_DONORS, len(rows))]
        found.fill(rows, own.responses.chosen(pick))
        return found

    def refined_m(self, device: int, beams: Beams, met: Surfaces) -> Float64[np.ndarray, " n"]:
        """Return distances to the static scene, refined by its recorded returns.

        Where the returns around a hit on the mesh form a plane, the distance is that to the plane,
        since the mesh is smoother and coarser than the returns.
        """
        own = self._donors.get((device, ""))
        distance = met.distance_m.copy()
        if own is None or len(own) < _SURFEL or not len(beams):
            return distance
        features = _features(beams.at(distance), looks_of(beams, met))
        far, near = nearest(self._tree(device, ""), features, _SURFEL, _FAR)
        rows = np.flatnonzero(np.isfinite(far).all(axis=1))
        points = own.places[near[rows]].astype(np.float64)
        weight = own.responses.is_returned[near[rows]].astype(np.float64)
        centre, normal, variance = fitted_planes(points, weight, met.normal[rows])
        along = (normal * beams.directions_world[rows]).sum(axis=1)
        offset = ((centre - beams.origins_world[rows]) * normal).sum(axis=1)
        # Nearly parallel to the plane, the distance of the intersection is undefined.
        is_crossed = np.abs(along) > 0.02
        plane = offset / np.where(is_crossed, along, 1.0)
        is_plane = is_crossed & (variance < _FLAT_M**2) & (weight.sum(axis=1) >= _SURFEL / 2)
        is_plane &= np.abs(plane - distance[rows]) < _MOST_STEP_M
        distance[rows[is_plane]] = plane[is_plane]
        return distance

    def _similar_look(
        self, device: int, sort: Sort, looks: Float32[np.ndarray, "n 3"], rng: np.random.Generator
    ) -> BeamResponses:
        for wanted in dict.fromkeys((sort, "vehicle", "static")):
            tree, responses = self._looks(device, wanted)
            if responses.is_returned.any():
                near = nearest(tree, looks, _NEAREST_DONORS)[1]
                pick = near[np.arange(len(looks)), rng.integers(0, _NEAREST_DONORS, len(looks))]
                return responses.chosen(pick)
        return BeamResponses.nothing(len(looks))

    def _tree(self, device: int, body: str) -> KDTree:
        key = device, body
        if key not in self._by_place:
            own = self._donors[key]
            self._by_place[key] = KDTree(_features(own.places, own.looks), balanced_tree=False)
        return self._by_place[key]

    def _looks(self, device: int, sort: Sort) -> tuple[KDTree, BeamResponses]:
        key = device, sort
        if key not in self._by_look:
            alike = [
                d for (other, body), d in self._donors.items()
                if other == device and sort_of(self._kinds.get(body)) == sort
            ]  # fmt: skip
            self._by_look[key] = _pool(alike)
        return self._by_look[key]


def _pool(donors: Sequence[Donors]) -> tuple[KDTree, BeamResponses]:
    if not donors:
        return KDTree(np.zeros((1, 3))), BeamResponses.nothing(1)
    every = Donors.joined(donors)
    return KDTree(every.looks, balanced_tree=False), every.responses


def fitted_planes(
    points: Float[np.ndarray, "n k 3"],
    weight: Float[np.ndarray, "n k"],
    tilt: Float[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """Return centre, unit normal and variance along the normal of a plane for each point group.

    Args:
        tilt: unit normals for planes through points in one line; 0: any.
    """
    part = (weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9))[..., None]
    centre = (part * points).sum(axis=1)
    offset = points - centre[:, None]
    moments = np.einsum("nki,nkj->nij", part * offset, offset)
    # Added variance in the plane perpendicular to `tilt` decides the normal of points in one line.
    wide = moments + _FLAT_M**2 * (np.eye(3) - tilt[:, :, None] * tilt[:, None, :])
    normal = np.linalg.eigh(wide).eigenvectors[:, :, 0]
    return centre, normal, np.einsum("ni,nij,nj->n", normal, moments, normal)


def nearest(
    tree: KDTree, wanted: Float[np.ndarray, "n d"], count: int, within: float = np.inf
) -> tuple[Float64[np.ndarray, "n k"], Int64[np.ndarray, "n k"]]:
    """Return distances and numbers of the nearest few points."""
    far, near = tree.query(wanted, k=count, workers=1, distance_upper_bound=within)
    return np.asarray(far), np.asarray(near, dtype=np.int64)


def _features(
    places: Float[np.ndarray, "n 3"], looks: Float[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 5"]:
    """Return place, distance and angle; roughness is left out, since it follows from the place."""
    return np.concatenate([places / _PLACE_M, looks[:, :2]], axis=1).astype(np.float32)
