"""Panoramas of synthetic streets under any sky, from rays that are traced once and stored.

For the surface in every pixel of a panorama, a few cosine-distributed rays (with the pixel or part
of the sky that each one meets) and the elevation of the horizon by azimuth are stored. Lighting by
a new sky then requires table look-ups and no rays. Surfaces are diffuse. If a ray meets a surface
that is occluded in the panorama, a visible surface of the same orientation replaces it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int8, Int64, Shaped, UInt8

from lightsim.core.equirect import directions_from_uv, pixel_directions, uv_from_directions
from lightsim.core.frames import RigidTransform
from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError
from lightsim.progress import Progress, SilentProgress
from lightsim.render.casters.embree import make_embree_caster
from lightsim_lab.synthetic.finishes import make_finishes
from lightsim_lab.synthetic.geometry import Hits, Snapshot
from lightsim_lab.synthetic.plan import plan_street
from lightsim_lab.synthetic.street import Street, build_background, build_participants
from lightsim_lab.synthetic.styles.base import STREET_END_M, STREET_START_M
from lightsim_lab.synthetic.styles.city import LANE_M, ROAD_HALF_M
from lightsim_lab.synthetic.textures import Finish
from lightsim_lab.training.hdr_skies import Side
from lightsim_lab.training.procedural_skies import UpperSky

# Number of azimuths with a stored horizon, every 5.6 degrees. Sensitivity not measured.
HORIZON_AZIMUTHS = 64
# Elevations of the first search of a horizon, in degrees; bisection refines the interval found.
_SEARCH_ELEVATIONS_DEG = (5.0, 13.0, 23.0, 35.0, 50.0, 68.0)
# Bisections per horizon: intervals of 5 to 22 degrees become 0.6 to 2.8 degrees.
_BISECTIONS = 3
# Angular radius of the sun, in degrees.
_SUN_RADIUS_DEG = 0.27
# Offset of ray origins from the surface along its normal, in metres, against self-intersection.
_OFFSET_M = 3e-3
# Speed of the ego vehicle, in m/s; it determines the speed of the other traffic.
_SPEED_M_S = 13.0
# Increment of the second coordinate in the R2 low-discrepancy sequence (Roberts 2018).
_GOLDEN = 0.5698402909980532
# Minimum distance of a camera position from any surface, in metres; excludes vehicles' interiors.
_CLEARANCE_M = 0.9
# Maximum number of draws of a camera position. Most positions on the lanes are free, so if all are
# occupied the street is full.
_POSITION_DRAWS = 50
# Number of successive streets with the same textures, which take longer to make than the street.
_STREETS_PER_FINISH = 4
# Length and width of the road texture, in metres.
_ROAD_M = (STREET_END_M - STREET_START_M, 2 * ROAD_HALF_M)
# Offsets of the primary rays from the pixel centre, in pixels: a regular 2 x 2 pattern.
_SUB_PIXELS = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
# Seed of the first street; seeds below 100 are for evaluation.
_FIRST_SEED = 100


@dataclass(frozen=True)
class StreetConfig:
    """Number of streets and positions, and resolution of the rays."""

    street_count: int = 18
    """Number of streets: the last `held_out` are for tests, as many before these for validation."""
    held_out: int = 3
    """Streets of the test side, and of the validation side."""
    positions: int = 5
    """Camera positions in each street."""
    rays: int = 40
    """Rays per pixel over the hemisphere of its surface."""

    def side_of(self, street: int) -> Side:
        """Return the side of the split of a street, by its number."""
        from_last = self.street_count - 1 - street
        if from_last < self.held_out:
            return "test"
        return "validation" if from_last < 2 * self.held_out else "train"


@dataclass(frozen=True, eq=False)
class StreetView:
    """Stored rays of one panorama with n surface pixels. Frame: z up, the street along +x.

    Args:
        pixel: index (row-major) of each surface pixel in the panorama.
        albedo: linear base colour, in units of 1/255.
        normal: unit normal, in units of 1/127.
        met: index of the pixel that each ray meets; for sky, h x 2h plus its index in the upper
            half.
        horizon: elevation of the horizon by azimuth, in units of 90/255 degrees.
        surface_fraction: fraction of every pixel that shows a surface, in units of 1/255; the rest
            shows sky.
    """

    pixel: Shaped[np.ndarray, " n"]
    albedo: UInt8[np.ndarray, "n 3"]
    normal: Int8[np.ndarray, "n 3"]
    met: Shaped[np.ndarray, "k n"]
    horizon: UInt8[np.ndarray, "a n"]
    surface_fraction: UInt8[np.ndarray, "h w"]


def trace_streets(
    config: StreetConfig, height_px: int, seed: int, progress: Progress | None = None
) -> tuple[list[StreetView], list[Side]]:
    """Return the views of all streets, and the side of the split of each."""
    views: list[StreetView] = []
    sides: list[Side] = []
    finishes: dict[str, Finish] = {}
    jobs = range(config.street_count)
    for k in (progress or SilentProgress()).track(jobs, "streets"):
        rng = np.random.default_rng([seed, _FIRST_SEED + k])
        plan = plan_street(_FIRST_SEED + k)
        if k % _STREETS_PER_FINISH == 0:
            finishes = make_finishes(rng, *_ROAD_M, LANE_M)
        street = Street(
            plan, build_background(plan), build_participants(plan, _SPEED_M_S), finishes
        )
        time_s = float(rng.uniform(-3.0, 7.0))
        poses = [plan.world_from_street @ p.street_from_actor(time_s) for p in street.participants]
        tracer = ViewTracer(
            Snapshot(street, poses), plan.world_from_street, height_px, config.rays, rng
        )
        views += [tracer.trace() for _ in range(config.positions)]
        sides.extend(config.side_of(k) for _ in range(config.positions))
    return views, sides


class ViewTracer:
    """Ray tracer of panoramas in one street at one time."""

    def __init__(
        self,
        snapshot: Snapshot,
        world_from_street: RigidTransform,
        height_px: int,
        rays: int,
        rng: np.random.Generator,
    ) -> None:
        self._snapshot = snapshot
        self._world_from_street = world_from_street
        self._height = height_px
        self._rays = rays
        self._rng = rng
        grey = np.zeros_like(snapshot.vertices)
        self._caster = make_embree_caster(
            [TriMesh("world", snapshot.vertices, snapshot.faces, grey)]
        )

    def trace(self) -> StreetView:
        """Trace primary rays, hemisphere rays and horizons at a random free position."""
        height = self._height
        directions = self._world_from_street.rotate(pixel_directions(height).reshape(-1, 3))
        eye, hits = self._free_position(directions)
        fraction, colour = _primary(self._snapshot, self._world_from_street, eye, height)
        pixel = np.flatnonzero(hits.is_hit & (fraction > 0))
        normals_world = hits.normal_world[pixel]
        reach = hits.distance_m[pixel, None] * directions[pixel]
        points = eye + reach + _OFFSET_M * normals_world
        normals = self._world_from_street.inverse().rotate(normals_world)
        seen = _Seen(eye, np.where(hits.is_hit, hits.distance_m, np.inf), pixel, normals)
        met = np.stack(
            [self._met(points, normals_world, seen, k) for k in range(self._rays)], axis=0
        )
        # The largest index is below 3 h^2: h x 2h pixels, and h / 2 x 2h of the sky.
        kind = np.uint16 if 3 * height * height < 65536 else np.int32
        return StreetView(
            pixel.astype(kind),
            np.round(np.clip(colour[pixel], 0, 1) * 255).astype(np.uint8),
            np.round(normals * 127).astype(np.int8),
            met.astype(kind),
            self._horizons(points, normals_world),
            np.round(fraction * 255).astype(np.uint8).reshape(height, 2 * height),
        )

    def _free_position(
        self, directions: Float[np.ndarray, "p 3"]
    ) -> tuple[Float[np.ndarray, "3"], Hits]:
        """Draw a position on either lane, at the height of roof cameras, with some clearance."""
        rng = self._rng
        for _ in range(_POSITION_DRAWS):
            side = float(rng.choice([-1.0, 1.0]))
            place = [rng.uniform(-35.0, 105.0), side * rng.uniform(1.0, 2.3), rng.uniform(1.5, 2.3)]
            eye = self._world_from_street.apply(np.array(place)[None])[0]
            hits = self._snapshot.intersect(np.broadcast_to(eye, directions.shape), directions)
            if float(hits.distance_m.min()) > _CLEARANCE_M:
                return eye, hits
        raise InputError(
            "no free camera position was found in a street",
            got=f"{_POSITION_DRAWS} positions within or near a surface",
            expected=f"a position with {_CLEARANCE_M} m of clearance",
            remedy="Choose another --seed.",
        )

    def _met(
        self,
        points: Float[np.ndarray, "n 3"],
        normals_world: Float[np.ndarray, "n 3"],
        seen: _Seen,
        k: int,
    ) -> Int64[np.ndarray, " n"]:
        """Trace the k-th ray of each surface point; return the hits (see StreetView.met)."""
        height, rng = self._height, self._rng
        u = (rng.random(len(points)) + k) / self._rays
        v = seen.shift + k * _GOLDEN
        directions = _cosine_directions(normals_world, u, v % 1.0)
        hits = self._snapshot.intersect(points, directions)
        turn = self._world_from_street.inverse()
        sky = _pixel_of(turn.rotate(directions), height)
        is_low = (sky >= height * height) & ~hits.is_hit
        # A hit point is visible in the panorama if the depth of its pixel agrees with its distance.
        offset = points + np.where(hits.is_hit, hits.distance_m, 1.0)[:, None] * directions
        offset -= seen.eye
        length = np.linalg.norm(offset, axis=1)
        shown = _pixel_of(turn.rotate(offset / np.maximum(length, 1e-9)[:, None]), height)
        is_same = np.abs(seen.distance_m[shown] - length) < 0.3 + 0.05 * length
        # Rays below the horizon that leave the scene meet the ground.
        up = np.array([0.0, 0.0, 1.0])
        facing = np.where(is_low[:, None], up, turn.rotate(hits.normal_world))
        other = _like(facing, seen.normals, seen.pixel, rng)
        surface = np.where(hits.is_hit & is_same, shown, other)
        return np.where(hits.is_hit | is_low, surface, 2 * height * height + sky)

    def _horizons(
        self, points: Float[np.ndarray, "n 3"], normals_world: Float[np.ndarray, "n 3"]
    ) -> UInt8[np.ndarray, "a n"]:
        """Return the elevation above which the sky is visible, by azimuth.

        It is the highest blocked one of a few elevations, refined by bisection. Directions behind
        the surface count as blocked.
        """
        ladder = np.array([0.0, *_SEARCH_ELEVATIONS_DEG, 90.0])
        out = np.empty((HORIZON_AZIMUTHS, len(points)), np.uint8)
        for a in range(HORIZON_AZIMUTHS):
            azimuth = 2 * np.pi * a / HORIZON_AZIMUTHS
            step = np.zeros(len(points), dtype=np.int64)
            for k, elevation in enumerate(_SEARCH_ELEVATIONS_DEG, start=1):
                level = np.full(len(points), elevation)
                step[self._is_blocked(points, normals_world, azimuth, level)] = k
            low, high = ladder[step], ladder[step + 1]
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + high)
                blocked = self._is_blocked(points, normals_world, azimuth, middle)
                low, high = np.where(blocked, middle, low), np.where(blocked, high, middle)
            out[a] = np.round(np.where(high <= 0.6, 0.0, 0.5 * (low + high)) / 90.0 * 255)
        return out

    def _is_blocked(
        self,
        points: Float[np.ndarray, "n 3"],
        normals_world: Float[np.ndarray, "n 3"],
        azimuth_rad: float,
        elevation_deg: Float[np.ndarray, " n"],
    ) -> Bool[np.ndarray, " n"]:
        e = np.radians(elevation_deg)
        c, s = float(np.cos(azimuth_rad)), float(np.sin(azimuth_rad))
        towards = np.stack([c * np.cos(e), s * np.cos(e), np.sin(e)], axis=1)
        towards = self._world_from_street.rotate(towards)
        blocked = np.ones(len(points), dtype=bool)
        facing = np.flatnonzero((towards * normals_world).sum(axis=1) > 0)
        blocked[facing] = self._caster.is_occluded(points[facing], towards[facing])
        return blocked


@dataclass(frozen=True, eq=False)
class _Seen:
    """Primary hits: distance in every pixel (inf for sky), and the surface pixels with normals."""

    eye: Float[np.ndarray, "3"]
    distance_m: Float[np.ndarray, " p"]
    pixel: Int64[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 3"]

    @property
    def shift(self) -> Float[np.ndarray, " n"]:
        """Offset in [0, 1) of the ray pattern of each pixel (golden ratio sequence)."""
        return (self.pixel * 0.6180339887) % 1.0


def _primary(
    snapshot: Snapshot,
    world_from_street: RigidTransform,
    eye_world: Float[np.ndarray, "3"],
    height_px: int,
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p 3"]]:
    """Return the surface fraction of each pixel and its mean base colour, from 2 x 2 rays."""
    u, v = np.meshgrid(np.arange(2 * height_px) + 0.5, np.arange(height_px) + 0.5)
    fraction = np.zeros(u.size)
    colour = np.zeros((u.size, 3))
    for du, dv in _SUB_PIXELS:
        uv = np.stack([(u + du) / (2 * height_px), (v + dv) / height_px], axis=-1)
        directions = world_from_street.rotate(directions_from_uv(uv).reshape(-1, 3))
        hits = snapshot.intersect(np.broadcast_to(eye_world, directions.shape), directions)
        fraction += hits.is_hit / len(_SUB_PIXELS)
        colour += snapshot.base_colour(hits) / len(_SUB_PIXELS)
    return fraction, colour / np.maximum(fraction, 1e-9)[:, None]


def _like(
    wanted: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "m 3"],
    pixel: Int64[np.ndarray, " m"],
    rng: np.random.Generator,
) -> Int64[np.ndarray, " n"]:
    """Draw a pixel with a surface of about the same orientation (six classes) for each normal."""
    classes, own = _facing(wanted), _facing(normals)
    out = rng.choice(pixel, len(wanted))
    for side in range(6):
        candidates, chosen = pixel[own == side], classes == side
        if len(candidates):
            out[chosen] = rng.choice(candidates, int(chosen.sum()))
    return out


def _facing(normals: Float[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    axis = np.abs(normals).argmax(axis=1)
    return 2 * axis + (np.take_along_axis(normals, axis[:, None], axis=1)[:, 0] < 0)


def _pixel_of(directions: Float[np.ndarray, "n 3"], height: int) -> Int64[np.ndarray, " n"]:
    uv = uv_from_directions(directions)
    column = np.minimum((uv[:, 0] * 2 * height).astype(np.int64), 2 * height - 1)
    row = np.minimum((uv[:, 1] * height).astype(np.int64), height - 1)
    return row * 2 * height + column


def _cosine_directions(
    normals: Float[np.ndarray, "n 3"], u: Float[np.ndarray, " n"], v: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Map (u, v) in [0, 1)^2 to cosine-distributed unit directions about the normals."""
    # A uniform point on the unit sphere about the tip of the normal has a cosine-distributed
    # direction.
    z, angle = 1.0 - 2.0 * u, 2.0 * np.pi * v
    radius = np.sqrt(np.maximum(0.0, 1 - z * z))
    ball = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    # Slightly longer normals avoid the zero vector.
    raw = normals * (1 + 1e-6) + ball
    return raw / np.linalg.norm(raw, axis=1, keepdims=True)


def light_view(
    view: StreetView, upper: UpperSky
) -> tuple[Float32[np.ndarray, "h w 3"], Bool[np.ndarray, "h/2 w"]]:
    """Light a view by a sky, with one bounce.

    Returns:
        Linear panorama without the sun's disc, and mask of the sky pixels of the upper half, in
        the frame of the view.
    """
    height, width = view.surface_fraction.shape
    albedo = view.albedo.astype(np.float32) * np.float32(1 / 255)
    sun = _sunlight(view, upper)
    values = np.zeros((height * width + height // 2 * width, 4), np.float32)
    values[height * width :, :3] = upper.rest.reshape(-1, 3)
    # The first pass gives direct light, the second one adds one bounce.
    for _ in range(2):
        arriving = _means(values, view.met)
        values[view.pixel, :3] = albedo * (arriving + sun)
    picture = values[: height * width, :3].reshape(height, width, 3).copy()
    fraction = view.surface_fraction.astype(np.float32)[..., None] * np.float32(1 / 255)
    behind = np.empty_like(picture)
    behind[: height // 2] = upper.rest
    # Below the horizon, gaps between surfaces show the mean colour of near-level ground.
    ground = values[view.pixel[view.normal[:, 2] > 100], :3]
    behind[height // 2 :] = ground.mean(axis=0) if len(ground) else 0.0
    return picture * fraction + behind * (1 - fraction), view.surface_fraction[: height // 2] < 128


def _means(
    values: Float32[np.ndarray, "p 4"], met: Shaped[np.ndarray, "k n"]
) -> Float32[np.ndarray, "n 3"]:
    """Return the mean value over the rays of each pixel."""
    # Four channels, as `take` is ten times as fast with them as with three.
    gathered = values.take(met.ravel(), axis=0).reshape(*met.shape, 4)
    return gathered.sum(axis=0)[:, :3] / np.float32(len(met))


def _sunlight(view: StreetView, upper: UpperSky) -> Float32[np.ndarray, "n 3"]:
    """Return the sun's irradiance / pi, with a linear penumbra at the horizon."""
    direction = upper.sun_direction
    elevation = np.degrees(np.arcsin(np.clip(direction[2], -1, 1)))
    turn = np.arctan2(direction[1], direction[0]) / (2 * np.pi) * HORIZON_AZIMUTHS
    horizon = view.horizon[round(float(turn)) % HORIZON_AZIMUTHS].astype(np.float32) * (90 / 255)
    visible = np.clip((elevation - horizon) / (2 * _SUN_RADIUS_DEG) + 0.5, 0.0, 1.0)
    cosine = np.maximum(view.normal.astype(np.float32) @ (direction / 127).astype(np.float32), 0)
    light = (visible * cosine)[:, None] * (upper.sun_irradiance / np.pi)
    return light.astype(np.float32)
