"""Point clouds of DGP scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from lightsim.core.frames import RigidTransform
from lightsim.datasets.dgp.scene import Datum
from lightsim.datasets.files import MAX_NUMBER
from lightsim.datasets.recorded import PointFrame, RawSweep
from lightsim.datasets.sweep_points import without_missing
from lightsim.errors import InputError
from lightsim.store.arrays import load_arrays

# Name of the array in a file of points.
_ARRAY = "data"
_CHANNELS: tuple[str, ...] = ("X", "Y", "Z", "INTENSITY")
# Most returns of a cloud: 30 times the largest merged cloud of four LiDARs.
_MOST = 5_000_000
# Intensities above this are of 8 bits; those of DDAD are multiples of 1/255 up to 1.
_FRACTION = 1.5
# Largest intensity of 8 bits.
_FULL_SCALE = 255.0


@dataclass(frozen=True, eq=False)
class CloudSource:
    """File of a cloud, and the sensors' geometry that it lacks.

    Args:
        origin_ego: start of all beams.
        intensity_scale: largest intensity.
    """

    datum: Datum
    ego_from_sensor: RigidTransform
    origin_ego: Float64[np.ndarray, "3"]
    intensity_scale: float

    def load(self) -> RawSweep:
        """Load the returns; they are motion compensated to the datum's time, and their own times
        and sensors are not in the data set (DDAD issue 39).

        Raises:
            InputError: the file is damaged, or has no coordinates.
        """
        columns = read_columns(self.datum)
        points = self.ego_from_sensor.apply(without_missing(columns[:, :3]))
        ring = channel(self.datum, columns, "RING")
        return RawSweep(
            points,
            PointFrame.SWEEP_TIME,
            self.origin_ego,
            _intensity(self.datum, columns) / self.intensity_scale,
            ring=None if ring is None else np.clip(np.nan_to_num(ring), -1, 32767).astype(np.int64),
        )


def read_columns(datum: Datum) -> Float64[np.ndarray, "n c"]:
    """Return the columns of a cloud; x, y and z are the first three.

    Raises:
        InputError: the file is damaged, or its columns are not those of its entry.
    """
    names = _names(datum)
    arrays = load_arrays(datum.path)
    data = arrays.get(_ARRAY, np.zeros(0))
    is_table = data.ndim == 2 and data.dtype.kind in "fiu" and 0 < len(data) <= _MOST
    if not is_table or names[:3] != list(_CHANNELS[:3]) or data.shape[1] < len(names):
        raise InputError(
            "the file does not contain the points of its entry",
            where=datum.path,
            got=f"arrays {', '.join(arrays)[:60]}; '{_ARRAY}' is {data.dtype} {data.shape}",
            expected=f"'{_ARRAY}' with 1 to {_MOST} rows and columns {', '.join(names)[:60]}",
            remedy="Copy the file again from the original data set.",
        )
    # Non-finite and huge values would raise warnings in sums; rows with nan are dropped later.
    with np.errstate(invalid="ignore"):
        columns = data.astype(np.float64)
    columns[~(np.abs(columns) <= MAX_NUMBER)] = np.nan
    return columns


def channel(
    datum: Datum, columns: Float64[np.ndarray, "n c"], name: str
) -> Float64[np.ndarray, " n"] | None:
    """Return a named column; None if the cloud has none."""
    names = _names(datum)
    return columns[:, names.index(name)] if name in names else None


def intensity_scale(datum: Datum, columns: Float64[np.ndarray, "n c"]) -> float:
    """Return the largest possible intensity: 1, or 255 if the cloud exceeds 1."""
    most = float(np.nan_to_num(_intensity(datum, columns)).max(initial=0.0))
    return 1.0 if most <= _FRACTION else _FULL_SCALE


def _intensity(datum: Datum, columns: Float64[np.ndarray, "n c"]) -> Float64[np.ndarray, " n"]:
    values = channel(datum, columns, "INTENSITY")
    return np.zeros(len(columns)) if values is None else values


def _names(datum: Datum) -> list[str]:
    names = datum.body.get("point_format") or list(_CHANNELS)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(
            "the format of the points cannot be read",
            where=f"{datum.where}, point_format",
            got=repr(names)[:60],
            expected=f"names of columns, such as {', '.join(_CHANNELS)}",
        )
    return [str(name) for name in names]
