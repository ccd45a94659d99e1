"""The lighting-aware digital twin: geometry, base colour and sky of one log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from lightsim.core.actors import ActorKind
from lightsim.core.dome import SkyDome
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh


@dataclass(frozen=True, eq=False)
class Wheel:
    """Wheel of a vehicle; its axle is parallel to the vehicle's y axis.

    Args:
        vertices: indices of the mesh's vertices that belong to it.
        centre: centre of the axle, frame `actor`.
        radius_m: of the tyre.
    """

    vertices: Int64[np.ndarray, " k"]
    centre: Float64[np.ndarray, "3"]
    radius_m: float

    def turned(
        self, vertices: Float32[np.ndarray, "n 3"], distance_m: float
    ) -> Float32[np.ndarray, "n 3"]:
        """Return the mesh's vertices after the vehicle has rolled forward by a distance."""
        # Rolling without slip. The rotation about +y moves the top of the wheel forward (+x).
        angle = distance_m / self.radius_m
        x, y, z = (vertices[self.vertices] - self.centre).T
        c, s = np.cos(angle), np.sin(angle)
        turned = vertices.copy()
        turned[self.vertices] = np.stack([c * x + s * z, y, c * z - s * x], axis=1) + self.centre
        return turned


@dataclass(frozen=True, eq=False)
class ActorAsset:
    """A reconstructed actor; `mesh` lies in frame `actor` (origin at the box centre).

    `label` is the name in the recording; by default that of `kind`. `wheels` are those that rotate.
    """

    actor_id: str
    kind: ActorKind
    mesh: TriMesh
    label: str = ""
    wheels: tuple[Wheel, ...] = ()

    def __post_init__(self) -> None:
        if not self.label:
            object.__setattr__(self, "label", str(self.kind))


@dataclass(frozen=True, eq=False)
class SceneAssets:
    """Meshes of a log, and the gain of each camera.

    Args:
        background: static scene, frame `world`.
        actors: by actor id.
        camera_gains: RGB g with linear pixel value = g x scene radiance; geometric mean over
            the cameras 1 per channel, which fixes the scene unit.
        notes: substitutions, such as default shapes of actors with too few returns.
    """

    background: TriMesh
    actors: Mapping[str, ActorAsset]
    camera_gains: Mapping[str, Float32[np.ndarray, "3"]]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Panorama:
    """Radiance around one point from all cameras, equirectangular in frame `world`.

    Args:
        radiance: linear RGB in scene units (gains divided out), 0 where not observed.
        is_seen: whether any camera observed the direction.
        is_sky: observed as sky by the mattes of the cameras.
        is_clipped: at least one channel of every contributing pixel was saturated.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    is_seen: Bool[np.ndarray, "h w"]
    is_sky: Bool[np.ndarray, "h w"]
    is_clipped: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class SkyEstimate:
    """The estimated source sky.

    Args:
        dome: HDR radiance in scene units, the sun included.
        sun_azimuth_deg: clockwise from true north, or None where the heading is unknown.
        sun_elevation_deg: above the horizon.
        origin: source of the sun direction: "gps+time", "time+image", "image" or "network".
        uncertainty_deg: one standard deviation of the sun direction.
        sun_irradiance_log_std: one standard deviation of the log of the sun's irradiance.
        sky_irradiance: RGB on level ground, sun excluded.
        sky_irradiance_log_std: one standard deviation of the log of its luminance.
        notes: which evidence was used and what was assumed.
    """

    dome: SkyDome
    sun_azimuth_deg: float | None
    sun_elevation_deg: float
    origin: str
    uncertainty_deg: float
    sun_irradiance_log_std: float
    sky_irradiance: Float32[np.ndarray, "3"]
    sky_irradiance_log_std: float
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class LightPrior:
    """Uncertainty of an estimated light.

    Args:
        unseen: for each pixel of the dome, 1 where no camera observed the sky, 0 where the dome
            shows an observation.
        unseen_log_std: one standard deviation of the log of the radiance of the unseen sky.
        log_clear_sun: log of a clear sun's irradiance at the estimated sky over the estimate's.
        sun_log_std: one standard deviation of the log of a clear sun over the sky.
        cloud_probability: that cloud dims the sun.
    """

    unseen: Float32[np.ndarray, "h w"]
    unseen_log_std: float
    log_clear_sun: float
    sun_log_std: float
    cloud_probability: float

    @property
    def is_veiled(self) -> bool:
        """True if cloud in front of the sun is more probable than a clear sun. Shadows are then
        soft or absent, and dark materials are easily mistaken for them."""
        return self.cloud_probability >= 0.5


@dataclass(frozen=True, eq=False)
class DigitalTwin:
    """Input of relighting: the log, its meshes and its sky."""

    log: DrivingLog
    assets: SceneAssets
    sky: SkyEstimate


def parked_actor_meshes(log: DrivingLog, assets: SceneAssets) -> list[TriMesh]:
    """Return the meshes of the actors that never move, in frame `world`."""
    return [
        assets.actors[track.actor_id].mesh.transformed(
            track.trajectory.at(track.trajectory.start_ns)
        )
        for track in log.actors
        if not track.is_moving and track.actor_id in assets.actors
    ]
