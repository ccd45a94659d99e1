"""Lens models of recorded cameras: projection of directions to pixels.

Only the direction from rays to pixels is needed, which is closed-form in every model: pictures are
resampled into pinhole cameras by looking up the source pixel of each target ray (rectify.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from lightsim.errors import InputError

# Number of coefficients that each model accepts, at most.
_MOST_COEFFICIENTS = {"pinhole": 0, "brown": 8, "kannala_brandt": 4, "mei": 5, "ftheta": 8}
MODELS = tuple(_MOST_COEFFICIENTS)
"""Names of the lens models."""
# Radii at which a distortion is tested for being monotonic.
_SAMPLES = 2000
# Largest tangent of the angle to the axis in the test of a Brown lens: 79 degrees.
_MAX_TANGENT = 5.0


@dataclass(frozen=True)
class Lens:
    """A camera with distortion. Frame `camera`: x right, y down, z forward.

    Args:
        model: "pinhole"; "brown" (Brown 1966: k1 k2 p1 p2 k3 k4 k5 k6 in OpenCV's order);
            "kannala_brandt" (doi:10.1109/TPAMI.2006.153, OpenCV's fisheye: k1 k2 k3 k4); "mei"
            (Mei & Rives 2007, doi:10.1109/ROBOT.2007.364084: xi k1 k2 p1 p2); "ftheta" (radius in
            pixels as a polynomial of the angle to the axis: c0 c1 ...; fx and fy are factors).
        cx, cy: principal point, where the corner of the first pixel is (0, 0).
        coefficients: of the model; missing ones are 0.
    """

    model: str
    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        most = _MOST_COEFFICIENTS.get(self.model)
        values = (self.fx, self.fy, self.cx, self.cy, *self.coefficients)
        is_ok = most is not None and len(self.coefficients) <= most
        is_ok &= bool(np.isfinite(values).all()) and self.fx > 0 and self.fy > 0
        if not is_ok or self.width_px < 1 or self.height_px < 1:
            raise InputError(
                "the intrinsics are not valid",
                got=f"{self.model}, {self.width_px}x{self.height_px} px, {list(values)}",
                expected=f"a model of {', '.join(MODELS)}, finite numbers, fx and fy above 0",
            )

    @property
    def is_pinhole(self) -> bool:
        """True if the lens has no distortion."""
        return self.model == "pinhole" or (self.model == "brown" and not any(self.coefficients))

    def project(
        self, directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """Return (u, v) of directions in frame `camera`, and whether they fall inside the image.

        Directions beyond the range of the model, where its radius no longer grows, are outside.
        """
        x, y, is_valid = self._planes[self.model](directions)
        uv = np.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=1)
        size = np.array([self.width_px, self.height_px])
        with np.errstate(invalid="ignore"):
            is_inside = is_valid & (uv >= 0).all(axis=1) & (uv < size).all(axis=1)
        return uv, is_inside

    @cached_property
    def _planes(self) -> dict[str, Callable[[Float[np.ndarray, "n 3"]], _Plane]]:
        return {
            "pinhole": self._brown,
            "brown": self._brown,
            "kannala_brandt": self._kannala_brandt,
            "mei": self._mei,
            "ftheta": self._ftheta,
        }

    def _padded(self, count: int) -> Float[np.ndarray, " count"]:
        return np.array([*self.coefficients, *[0.0] * count][:count])

    def _brown(self, d: Float[np.ndarray, "n 3"]) -> _Plane:
        is_front = d[:, 2] > 1e-6
        z = np.where(is_front, d[:, 2], 1.0)
        x, y, is_valid = self._brown_plane(d[:, 0] / z, d[:, 1] / z, self._padded(8))
        return x, y, is_valid & is_front

    def _brown_plane(
        self,
        x: Float[np.ndarray, " n"],
        y: Float[np.ndarray, " n"],
        k: Float[np.ndarray, "8"],
    ) -> _Plane:
        """Distort positions on the plane z = 1."""
        k1, k2, p1, p2, k3, k4, k5, k6 = k

        def factor(r2: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
            above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            return above / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))

        limit = _monotonic_limit(lambda r: r * factor(r * r), _MAX_TANGENT)
        r2 = x * x + y * y
        is_valid = r2 < limit**2
        # Beyond the limit the polynomial may overflow, and its value is not used.
        r2 = np.minimum(r2, limit**2)
        f = factor(r2)
        u = x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * f + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return u, v, is_valid

    def _kannala_brandt(self, d: Float[np.ndarray, "n 3"]) -> _Plane:
        k = self._padded(4)

        def bent(theta: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
            t2 = theta * theta
            return theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))

        return _by_angle(d, bent)

    def _ftheta(self, d: Float[np.ndarray, "n 3"]) -> _Plane:
        c = self._padded(8)
        return _by_angle(d, lambda theta: np.polynomial.polynomial.polyval(theta, c))

    def _mei(self, d: Float[np.ndarray, "n 3"]) -> _Plane:
        xi, k1, k2, p1, p2 = self._padded(5)
        unit = d / np.linalg.norm(d, axis=1, keepdims=True)
        # Points of the unit sphere are projected from (0, 0, -xi); beyond the tangent of the
        # sphere two directions have one image.
        is_front = unit[:, 2] > (-1.0 / xi if xi > 1 else -xi) + 1e-6
        z = np.where(is_front, unit[:, 2] + xi, 1.0)
        k = np.array([k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0])
        x, y, is_valid = self._brown_plane(unit[:, 0] / z, unit[:, 1] / z, k)
        return x, y, is_valid & is_front


_Plane = tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]
"""x and y on the distorted image plane, and whether the model is valid there."""


def _by_angle(
    d: Float[np.ndarray, "n 3"],
    radius: Callable[[Float[np.ndarray, " m"]], Float[np.ndarray, " m"]],
) -> _Plane:
    """Return the image of directions whose radius depends on the angle to the axis."""
    across = np.hypot(d[:, 0], d[:, 1])
    theta = np.arctan2(across, d[:, 2])
    limit = _monotonic_limit(radius, np.pi)
    is_valid = theta < limit
    r = radius(np.minimum(theta, limit)) / np.where(across > 0, across, 1.0)
    return d[:, 0] * r, d[:, 1] * r, is_valid


def _monotonic_limit(
    radius: Callable[[Float[np.ndarray, " m"]], Float[np.ndarray, " m"]], most: float
) -> float:
    """Return the argument up to which a radius increases, at most `most`."""
    arguments = np.linspace(0.0, most, _SAMPLES)
    falls = np.flatnonzero(~(np.diff(radius(arguments)) > 0))
    return float(arguments[falls[0]] if len(falls) else most)
