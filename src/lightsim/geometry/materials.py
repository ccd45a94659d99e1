"""Material classes of surfaces, from LiDAR labels where a log has them, else from shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, UInt8

from lightsim.core.actors import ActorKind
from lightsim.core.fields import GroundMap
from lightsim.core.lidar_returns import is_static
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import Material, TriMesh
from lightsim.geometry.denoise_kernels import neighbour_faces
from lightsim.geometry.simplify_kernels import faces_by_vertex

# Roughness and metallic of the Principled model (Burley 2012). Values are typical of each class and
# not measured. Asphalt has the specular factor of road class R III (CIE 144:2001) until
# `appearance.intrinsic.road_roughness` estimates it.
UNKNOWN = Material(0.8, 0.0, "matte")  # no class found
ASPHALT = Material(0.75, 0.0, "asphalt")  # roads and their markings
PAVEMENT = Material(0.8, 0.0, "pavement")  # sidewalks, kerbs, concrete
FACADE = Material(0.8, 0.0, "facade")  # walls of buildings
VEGETATION = Material(0.7, 0.0, "vegetation")  # leaves, bark and grass
CAR_PAINT = Material(0.35, 0.0, "car paint")  # all of a vehicle but panes and tyres
METAL = Material(0.5, 0.6, "metal")  # poles, signs, lamps, fences
GLASS = Material(0.05, 0.0, "glass")  # panes of vehicles
TYRE = Material(0.9, 0.0, "tyre")  # rubber
CLOTH = Material(0.95, 0.0, "cloth")  # persons
GROUND = Material(0.9, 0.0, "ground")  # soil
_CLASSES = (
    UNKNOWN, ASPHALT, PAVEMENT, FACADE, VEGETATION, CAR_PAINT, METAL, GLASS, TYRE, CLOTH, GROUND,
)  # fmt: skip
_WORDS = (
    (ASPHALT, ("road", "lane", "stop line", "asphalt", "driveable", "parking")),
    (PAVEMENT, ("sidewalk", "driveway", "pavement", "curb", "concrete")),
    (VEGETATION, ("vegetation", "tree", "bush", "plant")),
    (FACADE, ("building", "facade", "wall", "house")),
    (METAL, ("sign", "pole", "lamp", "fence", "rail")),
    (
        CAR_PAINT,
        ("car", "truck", "bus", "van", "vehicle", "pickup", "motorcycle", "towed", "tram"),
    ),
    (CLOTH, ("pedestrian", "person", "walker")),
    (GROUND, ("ground", "soil", "terrain")),
)
"""Parts of label names by class, tested in this order."""
_EXCLUDED_WORDS = ("barrier", "cart", "carton")
"""Parts of label names that exclude a class: "road barriers" are not a road."""

# Sensitivity of the classes to these constants is not measured.

# Edge of the cells in which labelled returns are counted.
_CELL_M = 0.25
# Largest distance from a face to a labelled cell.
_REACH_M = 0.6
# Sweeps whose labels are read, evenly distributed over the log; bounds the time.
_MAX_SWEEPS = 12
# Least upward component of a ground face's normal: slopes up to 37 degrees.
_MIN_GROUND_NORMAL_Z = 0.8
# Largest height of a ground face above or below the ground map.
_GROUND_BAND_M = 0.35
# Least height of a facade face above the ground map; above kerbs.
_WALL_HEIGHT_M = 0.6
# Least length of the mean unit normal of a face and its neighbours on a wall; foliage has less.
_MIN_COHERENCE = 0.85


def material_of(name: str) -> Material:
    """Return the material class of a LiDAR label; matte if none of the words is in its name."""
    low = name.lower()
    if any(word in low for word in _EXCLUDED_WORDS):
        return UNKNOWN
    for material, words in _WORDS:
        if any(word in low for word in words):
            return material
    return UNKNOWN


def material_of_actor(kind: ActorKind) -> Material:
    """Return the material class of most of an actor's surface; matte for kinds without a class."""
    if kind.is_vehicle or kind is ActorKind.MOTORCYCLE:
        return CAR_PAINT
    if kind.is_person:
        return CLOTH
    return METAL if kind is ActorKind.SIGN else UNKNOWN


def classify_background(mesh: TriMesh, log: DrivingLog, ground: GroundMap) -> TriMesh:
    """Assign a material to each face of a mesh in frame `world`.

    A face takes the class of the nearest cell of labelled returns within 0.6 m. Without one, level
    faces near the ground map are asphalt, since logs are recorded on roads and the roughness of
    soil would suppress a road's specular reflection of a low sun. Vertical faces with uniform
    normals are facade; all others are matte.
    """
    if len(mesh.faces) == 0:
        return mesh
    centres = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)
    index = _by_shape(mesh, centres, ground)
    cells, labels = _labelled_cells(log)
    if len(cells):
        from scipy.spatial import KDTree

        distance, nearest = KDTree(cells).query(centres, distance_upper_bound=_REACH_M)
        is_near = np.isfinite(distance)
        found = labels[np.where(is_near, nearest, 0)]
        is_known = is_near & (found != _CLASSES.index(UNKNOWN))
        index = np.where(is_known, found, index)
    index = _without_islands(mesh, index)
    used, face_material = np.unique(index, return_inverse=True)
    return replace(
        mesh,
        materials=tuple(_CLASSES[i] for i in used),
        face_material=face_material.astype(np.uint8),
    )


def _by_shape(
    mesh: TriMesh, centres: Float64[np.ndarray, "m 3"], ground: GroundMap
) -> Int64[np.ndarray, " m"]:
    normals = mesh.face_normals()
    height = centres[:, 2] - ground.look_up(centres[:, :2])
    is_ground = (normals[:, 2] > _MIN_GROUND_NORMAL_Z) & (np.abs(height) < _GROUND_BAND_M)
    is_wall = (np.abs(normals[:, 2]) < 0.3) & (height > _WALL_HEIGHT_M) & _is_coherent(mesh)
    return np.select([is_ground, is_wall], [_CLASSES.index(ASPHALT), _CLASSES.index(FACADE)], 0)


def _is_coherent(mesh: TriMesh) -> Bool[np.ndarray, " m"]:
    """Return True for faces whose neighbours have similar normals: walls, not foliage."""
    near, count = _near(mesh)
    normals = mesh.face_normals()
    total = normals.copy()
    for k in range(near.shape[1]):
        has = count > k
        total[has] += normals[near[has, k]]
    return np.linalg.norm(total, axis=1) > _MIN_COHERENCE * (count + 1)


def _near(mesh: TriMesh) -> tuple[np.ndarray, np.ndarray]:
    faces = mesh.faces.astype(np.int64)
    return neighbour_faces(faces, *faces_by_vertex(faces, len(mesh.vertices)))


def _without_islands(mesh: TriMesh, index: Int64[np.ndarray, " m"]) -> Int64[np.ndarray, " m"]:
    """Return the most frequent class among each face, which counts twice, and its neighbours."""
    near, count = _near(mesh)
    frequency = np.zeros((len(index), len(_CLASSES)), dtype=np.int16)
    rows = np.arange(len(index))
    frequency[rows, index] += 2
    for k in range(near.shape[1]):
        has = rows[count > k]
        frequency[has, index[near[has, k]]] += 1
    return frequency.argmax(axis=1)


def _labelled_cells(
    log: DrivingLog,
) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, " n"]]:
    """Return centres of 25 cm cells with labelled returns, and the most frequent class of each.

    Returns of moving actors are excluded.
    """
    empty = np.zeros((0, 3)), np.zeros(0, dtype=np.uint8)
    if not log.semantic_names:
        return empty
    table = np.zeros(max(log.semantic_names) + 2, dtype=np.int64)
    for number, name in log.semantic_names.items():
        table[number] = _CLASSES.index(material_of(name))
    step = max(1, len(log.sweeps) // _MAX_SWEEPS)
    keys, classes = [], []
    for lazy in log.sweeps[::step]:
        sweep = lazy.load()
        is_used = (sweep.semantic_class >= 0) & (sweep.semantic_class < len(table) - 1)
        is_used &= is_static(sweep, log.actors)
        points = sweep.points_world[is_used]
        keys.append(np.floor(points / _CELL_M).astype(np.int64))
        classes.append(table[sweep.semantic_class[is_used]])
    cells, row = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
    flat = row.reshape(-1) * len(_CLASSES) + np.concatenate(classes)
    frequency = np.bincount(flat, minlength=len(cells) * len(_CLASSES))
    best = frequency.reshape(len(cells), len(_CLASSES)).argmax(axis=1).astype(np.uint8)
    return (cells + 0.5) * _CELL_M, best
