"""Components of the source light on a surface: sun, sky, other surfaces and reflections."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError

# The values below were chosen by inspection; their sensitivity was not measured.

# Minimum sky light as a fraction of an open sky's: represents bounces that are not traced.
_MIN_SKY = 0.04
# Least ratio of the sun's light to all other light at which a shadow label is observable.
_MIN_LIT = 0.05
# Least fraction of an observed radiance that is diffuse, for any estimated reflection.
_MIN_DIFFUSE = 0.3


@dataclass(frozen=True, eq=False)
class ObservedPoints:
    """Points of a surface in the frame of its mesh, with their mean view direction.

    Args:
        position: metres.
        normal: unit normals.
        towards_camera: mean direction to the cameras, unit; 0 where unobserved.
        roughness: of the material.
    """

    position: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    towards_camera: Float[np.ndarray, "n 3"]
    roughness: Float[np.ndarray, " n"]

    @staticmethod
    def vertices_of(mesh: TriMesh) -> ObservedPoints:
        """Return all vertices of a mesh as points."""
        towards = mesh.towards_camera
        return ObservedPoints(
            mesh.vertices,
            mesh.vertex_normals(),
            np.zeros_like(mesh.vertices) if towards is None else towards,
            mesh.vertex_roughness(),
        )

    def at(self, rows: Int64[np.ndarray, " m"]) -> ObservedPoints:
        """Return the chosen points."""
        return ObservedPoints(
            self.position[rows], self.normal[rows], self.towards_camera[rows], self.roughness[rows]
        )


@dataclass(frozen=True, eq=False)
class Reflections:
    """Radiance that n points reflect specularly towards their cameras.

    Args:
        rest: reflection of the open sky and of other surfaces.
        unseen_sky: part of `rest` from sky directions that no camera observes.
        sun: reflection of the unoccluded sun.
    """

    rest: Float32[np.ndarray, "n 3"]
    unseen_sky: Float32[np.ndarray, "n 3"]
    sun: Float32[np.ndarray, "n 3"]

    def total(self, visibility: Float[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """Return the reflected radiance, given the sun visibility."""
        return self.rest.astype(np.float64) + visibility[:, None] * self.sun

    def balanced(self, balance: LightBalance) -> Reflections:
        """Scale the reflections of the sun and of the unseen sky."""
        unseen = (self.unseen_sky * balance.unseen_sky).astype(np.float32)
        rest = np.maximum(self.rest - self.unseen_sky, 0.0) + unseen
        return Reflections(rest, unseen, (self.sun * balance.sun).astype(np.float32))

    def at(self, rows: Int64[np.ndarray, " m"]) -> Reflections:
        """Return the chosen points."""
        return Reflections(self.rest[rows], self.unseen_sky[rows], self.sun[rows])


def diffuse_part(
    radiance: Float[np.ndarray, "n 3"], reflected: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Subtract specular reflections from a radiance; the result is limited from below."""
    return np.maximum(radiance - reflected, _MIN_DIFFUSE * radiance)


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """Light on n points as irradiance / pi, which is the radiance of a white Lambert surface.

    Args:
        sun: light of the unoccluded sun, by the cosine law.
        visibility: visible fraction of the sun's disc, with measured surfaces alone (column 0) and
            with measured and inferred surfaces (column 1).
        sky: light of the open sky.
        unseen_sky: part of `sky` from directions that no camera observes.
        bounce: light of other surfaces, from their observed radiance.
        reflected: specular reflections of the points; None: no reflections.

    Raises:
        InputError: a part is negative or not finite.
    """

    sun: Float32[np.ndarray, "n 3"]
    visibility: Float32[np.ndarray, "n 2"]
    sky: Float32[np.ndarray, "n 3"]
    unseen_sky: Float32[np.ndarray, "n 3"]
    bounce: Float32[np.ndarray, "n 3"]
    reflected: Reflections | None = None

    def __post_init__(self) -> None:
        parts = (self.sun, self.visibility, self.sky, self.unseen_sky, self.bounce)
        parts += () if self.reflected is None else tuple(vars(self.reflected).values())
        if any(not np.isfinite(part).all() or (part < 0).any() for part in parts):
            raise InputError(
                "the light of a mesh is negative or not finite",
                expected="finite values of 0 or more from sun, sky and other surfaces",
            )

    @property
    def reflections(self) -> Reflections:
        """Return `reflected`, or zeros."""
        if self.reflected is not None:
            return self.reflected
        none = np.zeros_like(self.sun)
        return Reflections(none, none, none)

    @property
    def diffuse(self) -> Float64[np.ndarray, "n 3"]:
        """Return all light but the direct sun."""
        return (self.sky + self.bounce).astype(np.float64)

    def total(self, visibility: Float[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """Return the light, given the sun visibility."""
        return self.diffuse + visibility[:, None] * self.sun

    @property
    def is_lit_enough(self) -> Bool[np.ndarray, " n"]:
        """Return the mask of points whose light depends noticeably on the sun visibility."""
        # Green channel.
        return self.sun[:, 1] > _MIN_LIT * self.diffuse[:, 1]

    def balanced(self, balance: LightBalance) -> SurfaceLight:
        """Scale the light of the sun and of the unseen sky."""
        unseen = (self.unseen_sky * balance.unseen_sky).astype(np.float32)
        return replace(
            self,
            sun=(self.sun * balance.sun).astype(np.float32),
            sky=np.maximum(self.sky - self.unseen_sky, 0.0) + unseen,
            unseen_sky=unseen,
            reflected=None if self.reflected is None else self.reflected.balanced(balance),
        )

    def base_colour(
        self, radiance: Float[np.ndarray, "n 3"], visibility: Float[np.ndarray, " n"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Return the diffuse part of an observed radiance divided by the light, not limited."""
        diffuse = radiance.astype(np.float64)
        if self.reflected is not None:
            diffuse = diffuse_part(diffuse, self.reflected.total(visibility))
        return diffuse / np.maximum(self.total(visibility), 1e-6)

    def reflections_as_diffuse(self, base_colour: Float[np.ndarray, "n 3"]) -> SurfaceLight:
        """Convert reflections to additional light, for Lambert surfaces of equal radiance."""
        if self.reflected is None:
            return self
        return replace(
            self,
            sun=(self.sun + self.reflected.sun / base_colour).astype(np.float32),
            sky=(self.sky + self.reflected.rest / base_colour).astype(np.float32),
            unseen_sky=(self.unseen_sky + self.reflected.unseen_sky / base_colour).astype(
                np.float32
            ),
            reflected=None,
        )

    def with_min_sky(self) -> SurfaceLight:
        """Limit the sky light from below: corners without an unoccluded ray are not black."""
        least = _MIN_SKY * np.percentile(self.sky, 95, axis=0).astype(np.float32)
        return replace(self, sky=np.maximum(self.sky, least))

    def at(self, rows: Int64[np.ndarray, " m"]) -> SurfaceLight:
        """Return the chosen points."""
        return SurfaceLight(
            self.sun[rows],
            self.visibility[rows],
            self.sky[rows],
            self.unseen_sky[rows],
            self.bounce[rows],
            None if self.reflected is None else self.reflected.at(rows),
        )


LightAt = Callable[[ObservedPoints], SurfaceLight]
"""Light at points in the frame of their mesh."""


@dataclass(frozen=True, eq=False)
class LightBalance:
    """Factors on an estimated light, fitted to shadows and to known materials.

    Args:
        sun: RGB factor on the sun's irradiance.
        unseen_sky: RGB factor on the radiance of the sky that no camera observes.
        sun_log_std, unseen_sky_log_std: standard deviations of their logs.
        pair_count: number of lit/shadowed pairs in the fit.
    """

    sun: Float64[np.ndarray, "3"]
    unseen_sky: Float64[np.ndarray, "3"]
    sun_log_std: float
    unseen_sky_log_std: float
    pair_count: int

    @staticmethod
    def unchanged() -> LightBalance:
        """Return factors 1 of unknown accuracy."""
        return LightBalance(np.ones(3), np.ones(3), np.inf, np.inf, 0)
