"""Sensors of a DGP scene: their mounting, lenses and the height of the road below the vehicle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import RigidTransform
from lightsim.datasets.dgp.scene import read_pose
from lightsim.datasets.files import (
    read_json,
    require_list,
    require_number,
    require_numbers,
    require_object,
)
from lightsim.datasets.lenses import Lens
from lightsim.datasets.plausible import LIMITS, check_intrinsics
from lightsim.errors import InputError

# Distortion of DGP's camera models that are not read, and skew, which a pinhole camera lacks.
_UNREAD = ("skew", "s1", "s2", "s3", "s4", "taux", "tauy", "alpha", "beta", "w", "xi",
           "equirectangular")  # fmt: skip
# Distances from the vehicle between which returns are road, in metres: beyond the bodywork.
_RING_M = (2.5, 12.0)
# Distance to the side within which returns are road, in metres: the lane and its neighbours.
_HALF_WIDTH_M = 3.5
# Percentile of the returns' heights where the fit starts: few returns are below the road.
_START_PERCENTILE = 20
# Scale of the Cauchy weights of the fit, in metres: about the noise of a LiDAR.
_NOISE_M = 0.03
# Rounds of reweighting; the fit has converged long before.
_ROUNDS = 30
# Fewest returns of a road whose height is used.
_FEWEST = 100
# Steepest slope of a road, relative to the vehicle.
_STEEPEST = 0.2


@dataclass(frozen=True, eq=False)
class Calibration:
    """Mounting and intrinsics of each sensor, by name. Frame `vehicle` is the recording's own:
    x forward, y left, z up, at an arbitrary height."""

    path: Path
    vehicle_from_sensor: Mapping[str, RigidTransform]
    intrinsics: Mapping[str, Any]

    def mounting(self, sensor: str) -> RigidTransform:
        """Return `vehicle_from_sensor`.

        Raises:
            InputError: the calibration lacks the sensor.
        """
        if sensor not in self.vehicle_from_sensor:
            raise InputError(
                f"the calibration has no sensor '{sensor}'",
                where=self.path,
                got=", ".join(self.vehicle_from_sensor),
                remedy="Scene and calibration must be of one download; copy both again.",
            )
        return self.vehicle_from_sensor[sensor]


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file.

    Raises:
        InputError: it is broken, or its lists differ in length.
    """
    document = require_object(read_json(path), path)
    names, poses, intrinsics = (
        require_list(document.get(key), f"{path}, {key}")
        for key in ("names", "extrinsics", "intrinsics")
    )
    if not len(names) == len(poses) == len(intrinsics) == len({str(name) for name in names}):
        raise InputError(
            "names, extrinsics and intrinsics differ in number",
            where=path,
            got=f"{len(names)}, {len(poses)} and {len(intrinsics)}",
            expected="one of each for every sensor",
        )
    mounting = {
        str(name): read_pose(pose, "vehicle", "sensor", f"{path}, extrinsics[{i}]")
        for i, (name, pose) in enumerate(zip(names, poses, strict=True))
    }
    for name, pose in mounting.items():
        distance_m = float(np.linalg.norm(pose.translation_m))
        LIMITS["mounting"].check(f"{path}, {name}", distance_m, f"{distance_m:.4g} m")
    return Calibration(path, mounting, dict(zip(map(str, names), intrinsics, strict=True)))


def read_lens(
    calibration: Calibration, sensor: str, size_px: tuple[int, int]
) -> tuple[Lens | None, tuple[str, ...]]:
    """Return the lens of a camera, None if its model is not supported, and notes.

    Raises:
        InputError: the intrinsics are broken or do not fit the pictures.
    """
    where = calibration.path / sensor / "intrinsics"
    values = require_object(calibration.intrinsics.get(sensor), where)
    fx, fy, cx, cy = require_numbers(values, ("fx", "fy", "cx", "cy"), where).tolist()

    def optional(key: str) -> float:
        return require_number(values.get(key, 0.0), f"{where}, {key}")

    fisheye = optional("fisheye")
    unread = [key for key in _UNREAD if optional(key)]
    # 1 is OpenCV's fisheye model; larger numbers are models of Parallel Domain.
    if unread or fisheye not in (0.0, 1.0):
        words = ", ".join(unread) or f"fisheye {fisheye:g}"
        return None, (f"{sensor}: its lens model ({words}) is not supported; it is not used",)
    notes = check_intrinsics(where, size_px, (fx, fy), (cx, cy))
    keys = ("k1", "k2", "k3", "k4") if fisheye else (
        "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # fmt: skip
    coefficients = tuple(optional(key) for key in keys)
    model = "kannala_brandt" if fisheye else "brown" if any(coefficients) else "pinhole"
    if model == "pinhole":
        coefficients = ()
    # DGP projects with OpenCV, which counts from the centre of the first pixel.
    return Lens(model, *size_px, fx, fy, cx + 0.5, cy + 0.5, coefficients), notes


def road_height_m(clouds: Sequence[Float64[np.ndarray, "_ 3"]]) -> float | None:
    """Return the height of the road below the vehicle, in frame `vehicle`; None if returns show
    no road.

    A plane is fitted to the returns near the vehicle with Cauchy weights, because kerbs, vehicles
    and verges lie above the road; the median of the clouds is returned.
    """
    heights = [h for h in map(_plane_height_m, clouds) if h is not None]
    return float(np.median(heights)) if heights else None


def _plane_height_m(points: Float64[np.ndarray, "n 3"]) -> float | None:
    distance = np.hypot(points[:, 0], points[:, 1])
    is_near = (distance > _RING_M[0]) & (distance < _RING_M[1])
    near = points[is_near & (np.abs(points[:, 1]) < _HALF_WIDTH_M)]
    if len(near) < _FEWEST:
        return None
    columns = np.column_stack([near[:, :2], np.ones(len(near))])
    plane = np.array([0.0, 0.0, np.percentile(near[:, 2], _START_PERCENTILE)])
    for _ in range(_ROUNDS):
        # Square roots of the weights, on both sides of the least-squares problem.
        root = 1.0 / np.hypot(1.0, (near[:, 2] - columns @ plane) / _NOISE_M)
        plane = np.linalg.lstsq(columns * root[:, None], near[:, 2] * root, rcond=None)[0]
    return float(plane[2]) if np.hypot(plane[0], plane[1]) < _STEEPEST else None
