"""Image-based rendering of views that no camera recorded: pictures of the log are projected through
the twin."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Int64

from lightsim.build.workspace import Workspace
from lightsim.core.buffers import BACKGROUND, GBuffers
from lightsim.core.casting import RayCaster
from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome, Sun
from lightsim.core.foliage import crown_beside, leaves_before, shows_foliage
from lightsim.core.log import DrivingLog
from lightsim.core.outline import continued_surface, grown_outline, nearest_of, surface_beside
from lightsim.core.resample import resize_area
from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.image_based import (
    BlendedView,
    RecordedView,
    ViewRays,
    blended,
    disagreement,
    observed_rims,
    recorded_view,
)
from lightsim.render.scene import placed_meshes
from lightsim.simulation.unobserved import completed_by_twin

# Largest time between the view and a picture that contributes, in seconds. In this time a vehicle
# drives about as far as the largest lateral offset of a moved camera.
_WITHIN_S = 0.6
# Largest number of pictures that contribute to a view. Chosen between eight and sixteen, which
# differ little on log 002 (no script repeats this).
_PICTURES = 12
# Number of decoded pictures and ray casters that are cached: those of two neighbouring views.
_CACHED = 2 * _PICTURES
# Approximate number of the view's pixels from which the contributing pictures are selected.
_PROBES = 400
# Rays that are blended at once, which bounds the memory.
_BAND_RAYS = 1 << 17
# A depth hypothesis wins if its photometric error is below this fraction of the other's; otherwise
# the nearer surface is used. Sensitivity not measured.
_AMBIGUITY = 0.8
# Pixels with a smaller sky fraction show surfaces.
_SKY = 0.5
# Offset of shadow rays towards the sun, in metres, so that the faces of a moving surface do not
# shadow the surface itself.
_OFF_SURFACE_M = 0.05
# Coordinate of points with unknown positions, in metres: outside every street, hence not shadowed.
_OUTSIDE_M = 1e6


@dataclass(frozen=True, eq=False)
class NovelView:
    """A frame of a view that no camera recorded.

    Args:
        radiance: linear, scene units, under the source sky.
        sky_matte: fraction of each pixel that is sky.
        is_observed: pixels whose content a recorded picture shows.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    sky_matte: Float32[np.ndarray, "h w"]
    is_observed: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class _ViewGeometry:
    """Surfaces of the twin at the pixels of a frame, and objects that may extend beyond their
    meshes there.

    Args:
        distance_m: distance along the pixel's ray, inf without a surface.
        is_leaf: pixels whose ray meets a crown.
        crown_m: distance of the crown beside the pixel (`core.foliage.crown_beside`), inf
            elsewhere.
        outline_m: distance of the actor whose true outline may include the pixel, inf elsewhere.
        outline_of: number of that actor in the scenario, or -1.
        is_still: pixels whose ray meets a static surface that is not a crown.
        edge_m: distance of the static surface beside a pixel without one, inf elsewhere.
    """

    distance_m: Float32[np.ndarray, "h w"]
    is_leaf: Bool[np.ndarray, "h w"]
    crown_m: Float32[np.ndarray, "h w"]
    outline_m: Float32[np.ndarray, "h w"]
    outline_of: Int32[np.ndarray, "h w"]
    is_still: Bool[np.ndarray, "h w"]
    edge_m: Float32[np.ndarray, "h w"]


class NovelViews:
    """Renders views of one log from positions without a camera.

    Args:
        workspace: with the twin.
        log: at the scale of the views.
        recorded: the log without edits.
        renderer: of the twin.
        held_out: stems of frames whose pictures are not used.
    """

    def __init__(
        self,
        workspace: Workspace,
        log: DrivingLog,
        recorded: Scenario,
        renderer: FrameRenderer,
        held_out: frozenset[str] = frozenset(),
    ) -> None:
        self._workspace = workspace
        self._log = log
        self._recorded = recorded
        self._renderer = renderer
        self._frames = [f for f in log.frames if f.stem not in held_out]
        self._placements = {
            recorded.number_by_actor[p.track.actor_id]: p for p in recorded.placements
        }
        self._views: OrderedDict[tuple[str, str], RecordedView] = OrderedDict()
        self._sun = _strong_sun(workspace.sky.dome)
        self._before_sun: dict[int, RayCaster] = {}

    def of(
        self, frame: CameraFrame, buffers: GBuffers, rendered: Float32[np.ndarray, "h w 3"]
    ) -> NovelView:
        """Return the view blended from pictures; pixels without a picture show the twin, with
        colours matched to the surrounding pictures.

        Args:
            buffers: geometry of the recorded street in the view.
            rendered: radiance of the twin under the source sky in the view.
        """
        shape = buffers.depth_z_m.shape
        rays = self._rays(frame, buffers)
        actors = buffers.actor_index.reshape(-1)
        pictures = self._chosen(rays)
        # Bands of rays bound the memory: every picture contributes arrays of the band's size.
        bands = [slice(start, start + _BAND_RAYS) for start in range(0, len(actors), _BAND_RAYS)]
        parts: list[BlendedView] = []
        for band in bands:
            part = rays.part(band)
            found = self._with_points(pictures, part, actors[band])
            parts.append(blended(part, found))
        seen = np.concatenate([np.column_stack([p.radiance, p.sky_matte]) for p in parts])
        is_observed = np.concatenate([p.is_observed for p in parts])
        rows, rims = self._rims(frame, rays, actors, pictures, is_observed)
        seen[rows], is_observed[rows] = rims, True
        seen, is_observed = seen.reshape(*shape, 4), is_observed.reshape(shape)
        whole = completed_by_twin(seen, rendered, is_observed, buffers.has_surface)
        return NovelView(whole[..., :3], whole[..., 3], is_observed)

    def _rims(
        self,
        frame: CameraFrame,
        rays: ViewRays,
        actors: Int32[np.ndarray, " n"],
        pictures: list[CameraFrame],
        is_observed: Bool[np.ndarray, " n"],
    ) -> tuple[Int64[np.ndarray, " k"], Float32[np.ndarray, "k 4"]]:
        """Return the rays that meet parts of crowns, actors or walls that are missing in the twin's
        meshes, and the radiance and sky matte of these parts.

        Args:
            actors: number of the actor that each ray meets.
            is_observed: rays whose surface a picture shows.
        """
        look = self._view_geometry(frame)
        rim_m = np.minimum(look.crown_m, np.minimum(look.outline_m, look.edge_m)).reshape(-1)
        beside = np.flatnonzero(np.isfinite(rim_m))
        # Two depth hypotheses per ray: the object that may extend here, and the twin's own surface.
        past, behind = replace(rays, distance_m=rim_m).part(beside), rays.part(beside)
        own = list(self._with_points(pictures, past, look.outline_of.reshape(-1)[beside]))
        others = self._with_points(pictures, behind, actors[beside])
        rims = observed_rims(past, own)
        # Meshes of actors are only partly too small; elsewhere the surface behind is visible.
        is_behind = disagreement(behind, others) < _AMBIGUITY * disagreement(
            past, own, of_rims=True
        )
        is_behind &= is_observed[beside] & np.isfinite(look.outline_m).reshape(-1)[beside]
        chosen = rims.is_observed & ~is_behind
        return beside[chosen], np.column_stack([rims.radiance, rims.sky_matte])[chosen]

    def _rays(self, frame: CameraFrame, buffers: GBuffers) -> ViewRays:
        camera = self._log.cameras[frame.camera_name]
        centres = camera.pixel_centres().reshape(-1, 2)
        origins, directions = frame.pixel_rays(camera, centres)
        points = buffers.position_world.reshape(-1, 3)
        distance = np.linalg.norm(points - origins, axis=1)
        distance[~buffers.has_surface.reshape(-1)] = np.inf
        return ViewRays(camera.name, frame.time_ns, camera.fx, origins, directions, distance)

    def _chosen(self, rays: ViewRays) -> list[CameraFrame]:
        """Return the pictures that are most often among the best three for probe rays, by the
        angle and distance of their own rays."""
        # Some hundred probes suffice to rank pictures; all rays are used only for the chosen ones.
        probes = rays.part(slice(None, None, max(1, len(rays.distance_m) // _PROBES)))
        near = [f for f in self._frames if abs(f.time_ns - rays.time_ns) <= round(_WITHIN_S * 1e9)]
        if not near:
            return []
        points = probes.points_world
        penalties = np.stack(
            [probes.penalties(f, self._log.cameras[f.camera_name], points)[0] for f in near]
        )
        # Blending uses the best pictures per ray; the third best bounds what can contribute.
        best = np.sort(penalties, axis=0)[min(2, len(near) - 1)]
        wins = (np.isfinite(penalties) & (penalties <= best)).sum(axis=1)
        order = np.argsort(-wins, kind="stable")[:_PICTURES]
        return [near[k] for k in order.tolist() if wins[k] > 0]

    def _with_points(
        self, pictures: list[CameraFrame], rays: ViewRays, actors: Int32[np.ndarray, " n"]
    ) -> Iterator[tuple[RecordedView, Float[np.ndarray, "n 3"]]]:
        """Yield pictures with the positions, at their time, of the points that the rays meet.

        Actors move between the times. Points whose shadow by a moving actor differs are NaN.
        """
        points = rays.points_world
        is_shaded = self._is_shaded(points, rays.time_ns)
        rows_by_actor = {
            int(n): np.flatnonzero(actors == n) for n in np.unique(actors[actors >= 0])
        }
        for frame in pictures:
            then = points.copy()
            for number, rows in rows_by_actor.items():
                then[rows] = _moved(self._placements.get(number), points[rows], rays, frame)
            # The shadow of a moving vehicle on a surface would otherwise be copied into the view.
            then[self._is_shaded(then, frame.time_ns) != is_shaded] = np.nan
            yield self._view(frame), then

    def _is_shaded(
        self, points_world: Float[np.ndarray, "n 3"], time_ns: int
    ) -> Bool[np.ndarray, " n"]:
        """Return the points that a moving actor shadows from the recorded sun."""
        if self._sun is None:
            return np.zeros(len(points_world), dtype=bool)
        if time_ns not in self._before_sun:
            there = self._recorded.placements_at(time_ns)
            moving = [p for p in there if p.track.is_moving]
            self._before_sun[time_ns] = make_embree_caster(placed_meshes(moving, time_ns))
            # The first entry of a dictionary is the oldest.
            if len(self._before_sun) > _CACHED:
                self._before_sun.pop(next(iter(self._before_sun)))
        direction = self._sun.direction_world
        starts = np.nan_to_num(points_world, nan=_OUTSIDE_M) + _OFF_SURFACE_M * direction
        directions = np.broadcast_to(direction, starts.shape)
        return self._before_sun[time_ns].is_occluded(starts, directions)

    def _view_geometry(self, frame: CameraFrame) -> _ViewGeometry:
        camera = self._log.cameras[frame.camera_name]
        scene = self._renderer.scene(self._recorded, frame.time_ns)
        caster, pixels = scene.camera_caster, camera.pixel_centres()
        origins, directions = frame.pixel_rays(camera, pixels.reshape(-1, 2))
        hits, shape = caster.intersect(origins, directions), pixels.shape[:2]
        distance = np.where(hits.is_hit, hits.distance_m, np.inf).astype(np.float32).reshape(shape)
        is_leaf = shows_foliage(caster.meshes, hits).reshape(shape)
        numbers = np.array([BACKGROUND] * len(scene.static.camera_meshes) + [*scene.actor_numbers])
        actor = np.where(hits.is_hit, numbers[hits.mesh_index], BACKGROUND).reshape(shape)
        outline_m = np.full(shape, np.inf, dtype=np.float32)
        outline_of = np.full(shape, BACKGROUND, dtype=np.int32)
        is_actor = actor != BACKGROUND
        if is_actor.any():
            along = (directions @ frame.world_from_camera.rotation[:, 2]).reshape(shape)
            nearest = nearest_of(is_actor)[1]
            is_beside = (grown_outline(is_actor, distance * along, camera.fx) > 0) & ~is_actor
            # The true outline of an actor can hide only surfaces behind the actor.
            is_beside &= distance > distance[nearest]
            outline_m[is_beside] = distance[nearest][is_beside]
            outline_of[is_beside] = actor[nearest][is_beside]
        crown_m = crown_beside(is_leaf, distance, camera.fx)
        # At most one hypothesis per pixel: an actor's outline, then a crown, then a wall.
        crown_m[outline_m < np.inf] = np.inf
        # Leaves and actors have their own hypotheses; walls are extended beyond their edges.
        is_still = np.isfinite(distance) & ~is_actor & ~is_leaf
        edge_m = surface_beside(is_still, distance, camera.fx)
        edge_m[np.isfinite(np.minimum(crown_m, outline_m))] = np.inf
        return _ViewGeometry(distance, is_leaf, crown_m, outline_m, outline_of, is_still, edge_m)

    def _view(self, frame: CameraFrame) -> RecordedView:
        key = frame.camera_name, frame.stem
        if key in self._views:
            # Neighbouring views use the same pictures: the least recently used one is dropped.
            self._views.move_to_end(key)
            return self._views[key]
        camera = self._log.cameras[frame.camera_name]
        shape = camera.height_px, camera.width_px
        seen = self._view_geometry(frame)
        ego_vehicle = self._log.ego_vehicle_masks.get(camera.name, np.zeros(shape, dtype=bool))
        matte = resize_area(self._workspace.likeliest_sky(frame)[..., None], *shape)[..., 0]
        gain = self._workspace.twin.assets.camera_gains[camera.name]
        srgb8 = frame.load_srgb8()
        # Three kinds of content extend beyond the twin's meshes: leaves, actors and wall edges.
        leaves_m = leaves_before(srgb8, seen.is_leaf, seen.crown_m, camera.fx, has_twigs=True)
        wall_m = np.where(
            continued_surface(seen.is_still, matte < _SKY), seen.edge_m, np.float32(np.inf)
        )
        view = recorded_view(
            frame,
            srgb8,
            camera,
            gain,
            matte,
            seen.distance_m,
            ~ego_vehicle,
            np.minimum(np.minimum(leaves_m, seen.outline_m), wall_m),
        )
        self._views[key] = view
        if len(self._views) > _CACHED:
            self._views.popitem(last=False)
        return view


def _strong_sun(dome: SkyDome) -> Sun | None:
    """Return the sun if it gives most of the light on level ground: shadows are then visible, and a
    displaced shadow of a picture is worse than the shadow that the twin renders."""
    sun = dome.sun
    if sun is None or sun.direction_world[2] <= 0:
        return None
    level = luminance(sun.irradiance * sun.direction_world[2])
    return sun if level > 0.5 * luminance(dome.horizontal_irradiance()) else None


def _moved(
    placement: ActorPlacement | None,
    points_world: Float[np.ndarray, "n 3"],
    rays: ViewRays,
    frame: CameraFrame,
) -> Float[np.ndarray, "n 3"]:
    """Return the positions at the picture's time of points on an actor at the view's time; NaN if
    the actor has no position then."""
    if placement is None or not placement.track.is_present(frame.time_ns):
        return np.full_like(points_world, np.nan)
    own = placement.world_from_actor(rays.time_ns).inverse().apply(points_world)
    return placement.world_from_actor(frame.time_ns).apply(own)
