"""Writer of tables and poses in PandaSet's layout."""

from __future__ import annotations

import gzip
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from lightsim.core.frames import RigidTransform, quaternion_from_matrix
from lightsim.store.atomic import whole_file
from lightsim.store.table_pickle import pickled_frame

# Columns of a file of cuboids, in PandaSet's order.
CUBOID_COLUMNS = (
    "uuid", "label", "yaw", "stationary", "camera_used",
    "position.x", "position.y", "position.z", "dimensions.x", "dimensions.y", "dimensions.z",
    "attributes.object_motion", "cuboids.sibling_id", "cuboids.sensor_id",
    "attributes.rider_status", "attributes.pedestrian_behavior", "attributes.pedestrian_age",
)  # fmt: skip
# Columns of a table, by name.
Columns = dict[str, Shaped[np.ndarray, " _"]]
# Types of the cuboid columns that are not text; a missing text is NaN, as in PandaSet.
_CUBOID_TYPES = {
    "yaw": np.float64, "stationary": np.bool_,
    "camera_used": np.int64, "cuboids.sensor_id": np.int64,
    **{f"{what}.{axis}": np.float64 for what in ("position", "dimensions") for axis in "xyz"},
}  # fmt: skip


def cuboid_table(
    rows: Sequence[Mapping[str, Any]], names: Sequence[str] = CUBOID_COLUMNS
) -> Columns:
    """Return the columns of a file of cuboids in PandaSet's types; a missing text may be None."""
    table: Columns = {}
    for name in names:
        values = [row.get(name) for row in rows]
        kind = _CUBOID_TYPES.get(name, object)
        column = np.empty(len(rows), dtype=object)
        column[:] = [np.nan if value is None else value for value in values]
        # A missing number is NaN, which integers and booleans cannot represent: promote to float.
        is_whole = not any(isinstance(value, float) and np.isnan(value) for value in column)
        table[name] = column.astype(kind if is_whole else np.promote_types(kind, float))
    return table


def write_table(
    path: Path, columns: Mapping[str, Shaped[np.ndarray, " n"]], index_name: str | None = None
) -> None:
    """Write a data frame as a gzipped pickle that pandas 1.0 to 3 load (`table_pickle`).

    Missing folders are created; equal tables give equal bytes.
    """
    write_packed(path, pickled_frame(columns, index_name))


def write_packed(path: Path, data: bytes) -> None:
    """Compress bytes with gzip; missing folders are created, and equal bytes give equal files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        temporary.write_bytes(gzip.compress(data, 9, mtime=0))


def pose_entry(world_from_sensor: RigidTransform) -> dict[str, dict[str, float]]:
    """Return an entry of poses.json: position in metres and quaternion w, x, y, z."""
    position = dict(zip("xyz", world_from_sensor.translation_m.tolist(), strict=True))
    quaternion = quaternion_from_matrix(world_from_sensor.rotation)
    heading = dict(zip("wxyz", quaternion.tolist(), strict=True))
    return {"position": position, "heading": heading}
