"""The source light on a surface by its parts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from lightsim.core.mesh import TriMesh
from lightsim.errors import InputError

# Fraction of open sky that the deepest corner gets (further bounces).
_LEAST_SKY = 0.04
# Of the sun's light to all other light, from which on a label changes the sum noticeably.
_LEAST_LIT = 0.05


# Of what cameras saw of a point, the least that is taken for diffuse, whatever it may reflect.
_LEAST_DIFFUSE = 0.3


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of a surface, in the frame of its mesh, and how they were looked at.

    Args:
        position: metres.
        normal: unit.
        towards_camera: mean direction to the cameras, unit; 0 where no camera saw the point.
        roughness: of the material.
    """

    position: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    towards_camera: Float[np.ndarray, "n 3"]
    roughness: Float[np.ndarray, " n"]

    @staticmethod
    def vertices_of(mesh: TriMesh) -> SeenPoints:
        """All vertices of a mesh."""
        towards = mesh.towards_camera
        return SeenPoints(
            mesh.vertices,
            mesh.vertex_normals(),
            np.zeros_like(mesh.vertices) if towards is None else towards,
            mesh.vertex_roughness(),
        )

    def at(self, rows: Int64[np.ndarray, " m"]) -> SeenPoints:
        """Some of the points."""
        return SeenPoints(
            self.position[rows], self.normal[rows], self.towards_camera[rows], self.roughness[rows]
        )


@dataclass(frozen=True, eq=False)
class Reflections:
    """Radiance that n points reflect specularly towards the cameras that saw them.

    Args:
        rest: of the open sky and of other surfaces.
        unseen_sky: what of `rest` comes from directions in which no camera saw the sky.
        sun: of the sun, without visibility.
    """

    rest: Float32[np.ndarray, "n 3"]
    unseen_sky: Float32[np.ndarray, "n 3"]
    sun: Float32[np.ndarray, "n 3"]

    def total(self, visibility: Float[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """At a visibility of the sun."""
        return self.rest.astype(np.float64) + visibility[:, None] * self.sun

    def balanced(self, balance: LightBalance) -> Reflections:
        """With another sun and another unseen sky."""
        unseen = (self.unseen_sky * balance.unseen_sky).astype(np.float32)
        rest = np.maximum(self.rest - self.unseen_sky, 0.0) + unseen
        return Reflections(rest, unseen, (self.sun * balance.sun).astype(np.float32))

    def at(self, rows: Int64[np.ndarray, " m"]) -> Reflections:
        """Of some of the points."""
        return Reflections(self.rest[rows], self.unseen_sky[rows], self.sun[rows])


def diffuse_part(
    radiance: Float[np.ndarray, "n 3"], reflected: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """What is left of a radiance without what is reflected; never less than a part of it."""
    return np.maximum(radiance - reflected, _LEAST_DIFFUSE * radiance)


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """Light on n points, irradiance / pi: what a white Lambert surface shows.

    Args:
        sun: of the sun by the cosine law, without visibility.
        visibility: fraction of the sun's disc seen, one column for each belief about what
            stands there: the measured surfaces alone, and the inferred ones, too.
        sky: of the open sky.
        unseen_sky: what of `sky` comes from directions in which no camera saw the sky.
        bounce: from other surfaces, as the cameras saw them shine.
        reflected: what the points send besides their diffuse light; None: nothing.
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
        """`reflected`, or zeros."""
        if self.reflected is not None:
            return self.reflected
        none = np.zeros_like(self.sun)
        return Reflections(none, none, none)

    @property
    def diffuse(self) -> Float64[np.ndarray, "n 3"]:
        """All light but the direct sun."""
        return (self.sky + self.bounce).astype(np.float64)

    def total(self, visibility: Float[np.ndarray, " n"]) -> Float64[np.ndarray, "n 3"]:
        """At a visibility of the sun."""
        return self.diffuse + visibility[:, None] * self.sun

    @property
    def is_lit_enough(self) -> Bool[np.ndarray, " n"]:
        """Where the sun's visibility changes the light by more than a few percent."""
        return self.sun[:, 1] > _LEAST_LIT * self.diffuse[:, 1]

    def balanced(self, balance: LightBalance) -> SurfaceLight:
        """With another sun and another unseen sky."""
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
        """Of the diffuse part of an observed radiance; not limited to what surfaces can have."""
        diffuse = radiance.astype(np.float64)
        if self.reflected is not None:
            diffuse = diffuse_part(diffuse, self.reflected.total(visibility))
        return diffuse / np.maximum(self.total(visibility), 1e-6)

    def on_lambert(self, base_colour: Float[np.ndarray, "n 3"]) -> SurfaceLight:
        """The light under which a Lambert surface would shine as these points do, reflections
        included: they count as light that comes in addition."""
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

    def floored(self) -> SurfaceLight:
        """With a little sky everywhere: corners that no traced ray left are not black."""
        least = _LEAST_SKY * np.percentile(self.sky, 95, axis=0).astype(np.float32)
        return replace(self, sky=np.maximum(self.sky, least))

    def at(self, rows: Int64[np.ndarray, " m"]) -> SurfaceLight:
        """Of some of the points."""
        return SurfaceLight(
            self.sun[rows],
            self.visibility[rows],
            self.sky[rows],
            self.unseen_sky[rows],
            self.bounce[rows],
            None if self.reflected is None else self.reflected.at(rows),
        )


LightAt = Callable[[SeenPoints], SurfaceLight]
"""Light at points of a mesh, in its frame."""


@dataclass(frozen=True, eq=False)
class LightBalance:
    """Factors on an estimated light that shadows and known materials ask for.

    Args:
        sun: RGB, on the sun's irradiance.
        unseen_sky: RGB, on the radiance of the sky where no camera saw it.
        sun_log_std, unseen_sky_log_std: one standard deviation of their logs.
        pair_count: lit/shadowed pairs behind it.
    """

    sun: Float64[np.ndarray, "3"]
    unseen_sky: Float64[np.ndarray, "3"]
    sun_log_std: float
    unseen_sky_log_std: float
    pair_count: int

    @staticmethod
    def unchanged() -> LightBalance:
        """The estimated light as it is."""
        return LightBalance(np.ones(3), np.ones(3), np.inf, np.inf, 0)
