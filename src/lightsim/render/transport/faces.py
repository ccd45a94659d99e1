"""Faces that pixel rays meet: the sky visible from each face, traced once and cached."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt16

from lightsim.core.casting import RayCaster
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError
from lightsim.render.casters.embree import offset_origins
from lightsim.render.transport.sides import OPEN, SideFinder

# Rays in memory at once. Not measured alone; peaks are in docs/benchmarks/throughput.md.
TILE_RAYS = 1 << 19
# Texture samples whose mean is the base colour of a face. Chosen; sensitivity not measured.
_TEXELS = 16
# Rows of the equirectangular grid of environment cells, 2 degrees each. At most 180, since cells
# are numbered in 16 bits and 65535 is reserved.
SKY_CELL_ROWS = 90


@dataclass(frozen=True)
class TransportConfig:
    """Settings of the light transport matrix and of sun rays."""

    sky_rays: int = 32
    """Rays per traced pixel over the hemisphere."""
    face_rays: int = 16
    """Rays per face that a pixel ray met, for the bounce; 0: no bounce."""
    sun_rays: int = 4
    """Rays per pixel over the solar disc."""
    face_sun_rays: int = 2
    """Sun rays per met face."""
    shading_step_px: int = 2
    """One pixel in this many, along rows and columns, is traced; sun rays start from all pixels."""
    filter_radius: int = 1
    """Radius, in traced pixels, over which sky and bounce light are smoothed along surfaces."""
    bounces: int = 1
    """Bounces between surfaces. 2 requires a second level of faces and rays; more, only sums."""
    pixel_samples: int = 1
    """Samples of every pixel, a square number; 1: the centre."""
    glossy_rays: int = 8
    """Rays over the specular lobe of each traced pixel; with pixel samples, of each pixel smoother
    than MATTE_ROUGHNESS too. 0: no reflections."""
    device: str = "cpu"
    """Device of the sums over pixel rays: "cpu" (numba), or a device of torch."""

    def __post_init__(self) -> None:
        if self.bounces < 1:
            raise InputError(
                "the number of bounces is too small", got=self.bounces, expected="1 or more"
            )
        side = round(max(self.pixel_samples, 0) ** 0.5)
        if side < 1 or side * side != self.pixel_samples or self.pixel_samples > 225:
            raise InputError(
                "the number of samples of a pixel is not a square number",
                got=self.pixel_samples,
                expected="1, 4, 9, 16 ... up to 225",
            )


@dataclass(frozen=True, eq=False)
class FaceSamples:
    """Sides of faces that rays met, and the sky visible from each.

    Args:
        sun_points_world: start points of the sun rays.
        normals_world: unit vectors, on the side that was met.
        base_colour: mean over the face.
        sky_cells: environment cell of each face ray, `kernels.BLOCKED` if it meets geometry.
        confidence: of the colour on the side that was met; 0 if no camera observed it.
        next_rows: rows of these samples that the face rays meet, -1 for none, for further bounces.
        bounces: number of bounces, including the one from these faces to the surfaces they light.
    """

    sun_points_world: Float32[np.ndarray, "f s 3"]
    normals_world: Float32[np.ndarray, "f 3"]
    base_colour: Float32[np.ndarray, "f 3"]
    sky_cells: UInt16[np.ndarray, "f m"]
    confidence: Float32[np.ndarray, " f"]
    next_rows: Int32[np.ndarray, "f m"] | None = None
    bounces: int = 1


class FaceTable:
    """Sky visible from the faces of a fixed list of meshes, traced on first use and cached.

    Use one table over the static meshes for all frames of a log, because the sky visible from a
    static face does not change. In this table actors do not occlude the sky of static faces, but
    they cast sun shadows on them. The table is thread-safe.
    """

    def __init__(
        self, meshes: Sequence[TriMesh], caster: RayCaster, config: TransportConfig, seed: int = 0
    ) -> None:
        self._meshes = tuple(meshes)
        self._first_face = np.cumsum([0] + [len(mesh.faces) for mesh in meshes])
        self._caster = caster
        self._config = config
        self._seed = seed
        self._growing = Lock()
        # Needed for several bounces, made at the first trace.
        self._finder: SideFinder | None = None
        # Row of each side's samples, -1 before it is traced.
        self._row_by_side = np.full(2 * self._first_face[-1], -1, dtype=np.int32)
        self._cells = np.zeros((0, config.face_rays), dtype=np.uint16)
        self._next = np.zeros((0, config.face_rays), dtype=np.int32)
        self._colour = np.zeros((0, 3), dtype=np.float32)

    @property
    def face_count(self) -> int:
        """Number of faces of all meshes; each has two sides."""
        return int(self._first_face[-1])

    def samples(self, sides: Int64[np.ndarray, " f"]) -> FaceSamples:
        """Return the samples of sides, each 2 x (running face number) + (1 for the back)."""
        rows = self._rows(sides)
        corners, normals = self._geometry(sides)
        count = max(1, self._config.face_sun_rays)
        points = self._points(sides, corners, count).reshape(-1, 3)
        # Sun rays start from several points of a face, since a shadow's edge may cross it.
        starts = offset_origins(points, np.repeat(normals, count, axis=0))
        return FaceSamples(
            starts.reshape(-1, count, 3),
            normals,
            self._colour[rows],
            self._cells[rows],
            self._confidence(sides),
        )

    def next_sides(self, sides: Int64[np.ndarray, " f"]) -> Int32[np.ndarray, "f m"]:
        """Return the sides that the face rays meet, numbered over the caster's meshes, or OPEN.

        Available only if the config has several bounces.
        """
        rows = self._rows(sides)
        return self._next[rows]

    def _rows(self, sides: Int64[np.ndarray, " f"]) -> Int32[np.ndarray, " f"]:
        """Return the rows of the sides; new sides are traced."""
        with self._growing:
            new = sides[self._row_by_side[sides] < 0]
            if len(new):
                cells, met = self._trace(new)
                self._row_by_side[new] = len(self._cells) + np.arange(len(new), dtype=np.int32)
                self._cells = np.concatenate([self._cells, cells])
                self._next = np.concatenate([self._next, met])
                self._colour = np.concatenate([self._colour, self._mean_colour(new)])
            return self._row_by_side[sides]

    def _geometry(
        self, sides: Int64[np.ndarray, " f"]
    ) -> tuple[Float32[np.ndarray, "f 3 3"], Float32[np.ndarray, "f 3"]]:
        """Return corners and normals of the sides."""
        faces = sides >> 1
        corners = np.zeros((len(sides), 3, 3), dtype=np.float32)
        for mesh, rows, own in self._by_mesh(faces):
            corners[rows] = mesh.vertices[mesh.faces[own]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        sign = np.where(sides & 1, -1.0, 1.0)[:, None]
        # Degenerate faces have no normal; any unit vector keeps their rays finite.
        unit = np.where(length > 0, normals / np.maximum(length, 1e-30), [0.0, 0.0, 1.0])
        return corners, (sign * unit).astype(np.float32)

    def _by_mesh(
        self, faces: Int64[np.ndarray, " f"]
    ) -> Iterator[tuple[TriMesh, Int64[np.ndarray, " k"], Int64[np.ndarray, " k"]]]:
        """Yield each mesh with the rows of the given faces that belong to it, and their numbers in
        it."""
        for k, mesh in enumerate(self._meshes):
            low, high = self._first_face[k], self._first_face[k + 1]
            rows = np.flatnonzero((faces >= low) & (faces < high))
            if len(rows):
                yield mesh, rows, faces[rows] - low

    def _mean_colour(self, sides: Int64[np.ndarray, " f"]) -> Float32[np.ndarray, "f 3"]:
        """Return the mean base colour of the sides' faces, from the texture if there is one.

        A texture contains variation that is absent in the vertex colours.
        """
        from lightsim.render.transport.kernels import mean_texels

        colour = np.zeros((len(sides), 3), dtype=np.float32)
        for mesh, rows, own in self._by_mesh(sides >> 1):
            if mesh.texture is None:
                colour[rows] = mesh.base_colour[mesh.faces[own]].mean(axis=1)
                continue
            found = np.empty((len(own), 3), dtype=np.float32)
            shifts = hashed_shifts(sides[rows], self._seed + 2)
            corner_uv = mesh.texture.corner_uv[own]
            mean_texels(mesh.texture.image, corner_uv, shifts, _TEXELS, found)
            colour[rows] = found
        return colour

    def _confidence(self, sides: Int64[np.ndarray, " f"]) -> Float32[np.ndarray, " f"]:
        """Return the mean confidence over the corners; 0 for back sides, whose colour was not
        observed."""
        confidence = np.ones(len(sides), dtype=np.float32)
        for mesh, rows, own in self._by_mesh(sides >> 1):
            if mesh.confidence is not None:
                confidence[rows] = mesh.confidence[mesh.faces[own]].mean(axis=1)
        # Cameras observe the front of a reconstructed face.
        return np.where(sides & 1, np.float32(0.0), confidence)

    def _points(
        self, sides: Int64[np.ndarray, " f"], corners: Float32[np.ndarray, "f 3 3"], count: int
    ) -> Float32[np.ndarray, "f c 3"]:
        from lightsim.render.transport.kernels import face_points

        points = np.empty((len(sides), count, 3), dtype=np.float32)
        face_points(corners, hashed_shifts(sides, self._seed + 1), count, points)
        return points

    def _trace(
        self, sides: Int64[np.ndarray, " f"]
    ) -> tuple[UInt16[np.ndarray, "f m"], Int32[np.ndarray, "_ m"]]:
        """Return the environment cells of the rays, BLOCKED if geometry is met.

        With several bounces, the second array has the side that each ray meets.
        """
        from lightsim.render.transport.kernels import BLOCKED

        rays = self._config.face_rays
        cells = np.empty((len(sides), rays), dtype=np.uint16)
        met = np.full((len(sides) if self._config.bounces > 1 else 0, rays), OPEN, dtype=np.int32)
        if self._finder is None and self._config.bounces > 1:
            self._finder = SideFinder(self._caster)
        finder = self._finder
        tile = max(1, TILE_RAYS // max(1, rays))
        # Each ray starts from its own point of the face, so that large faces are sampled over their
        # area.
        for start in range(0, len(sides) if rays else 0, tile):
            part = slice(start, start + tile)
            corners, normals = self._geometry(sides[part])
            shifts = hashed_shifts(sides[part], self._seed)
            directions, found = hemisphere_directions(normals, shifts, rays)
            points = self._points(sides[part], corners, rays).reshape(-1, 3)
            origins = offset_origins(points, np.repeat(normals, rays, axis=0))
            flat = directions.reshape(-1, 3)
            # Further bounces need the side that is met; one bounce needs only whether the sky is
            # hidden.
            if finder is not None:
                met[part] = finder.met(origins, flat).reshape(-1, rays)
                is_blocked = met[part] != OPEN
            else:
                is_blocked = self._caster.is_occluded(origins, flat).reshape(-1, rays)
            cells[part] = np.where(is_blocked, BLOCKED, found)
        return cells, met


def hemisphere_directions(
    normals: Float32[np.ndarray, "n 3"], shifts: Float32[np.ndarray, "n 2"], rays: int
) -> tuple[Float32[np.ndarray, "n k 3"], UInt16[np.ndarray, "n k"]]:
    """Return cosine-stratified unit directions about each normal, and the environment cell of each.

    Args:
        shifts: offsets of each point's pattern, in [0, 1).
        rays: directions for each normal.

    Returns:
        Directions, and cells as row * 2 * SKY_CELL_ROWS + column.
    """
    from lightsim.render.transport.kernels import hemisphere_rays

    directions = np.empty((len(normals), rays, 3), dtype=np.float32)
    cells = np.empty((len(normals), rays), dtype=np.uint16)
    hemisphere_rays(normals, shifts, rays, SKY_CELL_ROWS, directions, cells)
    return directions, cells


def hashed_shifts(numbers: Int64[np.ndarray, " n"], seed: int) -> Float32[np.ndarray, "n 2"]:
    """Return two uniform numbers in [0, 1) for each integer.

    SplitMix64 (Steele et al. 2014, doi:10.1145/2660193.2660195).
    """
    shifts = np.empty((len(numbers), 2), dtype=np.float32)
    # Unsigned overflow is part of the hash.
    for axis in range(2):
        with np.errstate(over="ignore"):
            z = numbers.astype(np.uint64) * np.uint64(2) + np.uint64(2 * seed * 1000003 + axis)
            z = (z + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
            z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        shifts[:, axis] = ((z ^ (z >> np.uint64(31))) >> np.uint64(40)).astype(np.float64) / 2**24
    return shifts


def pixel_shifts(
    rows: Int64[np.ndarray, " n"], columns: Int64[np.ndarray, " n"], step: int, seed: int
) -> Float32[np.ndarray, "n 2"]:
    """Return two numbers in [0, 1) for each pixel.

    The first is interleaved gradient noise (Jimenez 2014), which covers [0, 1) evenly in every 3 x
    3 neighbourhood, as the later smoothing requires. The second is hashed, since two such patterns
    together would be visible as stripes.
    """
    # A random offset gives each seed another pattern.
    offset = np.random.default_rng(seed).random(2) * 64.0
    i, j = rows // step + offset[0], columns // step + offset[1]
    u = (52.9829189 * ((0.06711056 * j + 0.00583715 * i) % 1.0)) % 1.0
    numbers = (rows // step) * (1 << 20) + columns // step
    return np.stack([u, hashed_shifts(numbers, seed)[:, 0]], axis=1).astype(np.float32)
