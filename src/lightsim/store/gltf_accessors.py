"""Arrays of a glTF file: accessors of all component types, normalised, strided and sparse.

Reference: Khronos glTF 2.0 specification, section 3.6.2; KHR_mesh_quantization.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from lightsim.store.gltf_document import GltfDocument, whole

# NumPy types of glTF's component types (section 3.6.2.2).
_DTYPE_BY_COMPONENT = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
# Number of components of glTF's element types; other matrices are not used in what is read.
WIDTH_BY_TYPE = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# Largest number of rows of an accessor without data, whose claim nothing else bounds.
_MAX_EMPTY_ROWS = 2_000_000
# Largest number of values read from one file, each use of an accessor counted. It bounds the time
# of small files that use one accessor very often; a street of ten million vertices has a fifth of
# it.
_MAX_VALUES = 1_000_000_000


@dataclass(eq=False)
class Accessors:
    """Reader of the accessors of one document."""

    document: GltfDocument
    _n_values: int = 0

    def rows(self, index: object) -> Shaped[np.ndarray, "n c"]:
        """Return the rows as stored; normalised integers become float32 in [0, 1] or [-1, 1].

        Raises:
            ValueError: the accessor exceeds its data, or its entries contradict each other.
        """
        accessor = self.document.item("accessors", index)
        rows = self._stored(accessor, index)
        if accessor.get("normalized", False) and rows.dtype.kind != "f":
            return _normalised(rows)
        return rows

    def floats(
        self, index: object, *widths: int, is_fraction: bool = False
    ) -> Float64[np.ndarray, "n c"]:
        """Return finite rows of one of the given widths.

        Args:
            is_fraction: normalise integers even if the accessor does not declare it; colours and
                weights have no other meaning.
        """
        rows = self.rows(index)
        if rows.shape[1] not in widths:
            raise ValueError(f"accessors[{index}] has {rows.shape[1]} columns, not {widths}")
        if is_fraction and rows.dtype.kind != "f":
            rows = _normalised(rows)
        if not np.isfinite(rows).all():
            raise ValueError(f"accessors[{index}] has numbers that are not finite")
        return rows.astype(np.float64)

    def indices(self, index: object) -> Int64[np.ndarray, " n"]:
        """Return a column of vertex indices."""
        rows = self.rows(index)
        if rows.shape[1] != 1 or rows.dtype.kind == "f":
            raise ValueError(f"accessors[{index}] does not hold indices")
        return rows[:, 0].astype(np.int64)

    def has_data(self, index: object) -> bool:
        """Return whether the accessor has values of its own instead of implicit zeros."""
        accessor = self.document.item("accessors", index)
        return "bufferView" in accessor or "sparse" in accessor

    def is_empty(self, index: object) -> bool:
        """Return whether the accessor has no rows, which the standard forbids."""
        return self.document.item("accessors", index).get("count") == 0

    def _stored(self, accessor: dict[str, Any], index: object) -> Shaped[np.ndarray, "n c"]:
        dtype = np.dtype(_DTYPE_BY_COMPONENT[accessor["componentType"]])
        width, count = WIDTH_BY_TYPE[accessor["type"]], whole(accessor["count"])
        if count < 1:
            raise ValueError(f"accessors[{index}] has no rows")
        if "bufferView" in accessor:
            rows = self._viewed(accessor, dtype, width, count)
        # Without a buffer view, all values are zero except sparse ones (section 3.6.2.3).
        elif count > _MAX_EMPTY_ROWS:
            raise ValueError(f"accessors[{index}] claims {count} rows without data")
        else:
            rows = np.zeros((count, width), dtype)
        self._n_values += count * width
        if self._n_values > _MAX_VALUES:
            raise ValueError(f"its meshes have more than {_MAX_VALUES} numbers")
        return self._overlaid(rows, accessor["sparse"]) if "sparse" in accessor else rows

    def _viewed(
        self, accessor: dict[str, Any], dtype: np.dtype[Any], width: int, count: int
    ) -> Shaped[np.ndarray, "n c"]:
        data, stride = self.document.view(accessor["bufferView"])
        offset = whole(accessor.get("byteOffset", 0))
        stride = stride or width * dtype.itemsize
        needed = offset + stride * (count - 1) + width * dtype.itemsize
        if stride < width * dtype.itemsize or needed > len(data):
            raise ValueError("an accessor runs past its buffer view")
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize))

    def _overlaid(
        self, rows: Shaped[np.ndarray, "n c"], sparse: dict[str, Any]
    ) -> Shaped[np.ndarray, "n c"]:
        """Replace the rows of a sparse accessor (section 3.6.2.3)."""
        count = whole(sparse["count"])
        if not count:
            return rows
        kind = np.dtype(_DTYPE_BY_COMPONENT[sparse["indices"]["componentType"]])
        places = self._viewed(sparse["indices"], kind, 1, count)[:, 0]
        if kind.kind == "f" or places.min() < 0 or places.max() >= len(rows):
            raise ValueError("a sparse accessor refers to a missing row")
        rows = rows.copy()
        rows[places] = self._viewed(sparse["values"], rows.dtype, rows.shape[1], count)
        return rows


def _normalised(rows: Shaped[np.ndarray, "n c"]) -> Shaped[np.ndarray, "n c"]:
    # The least signed integer would give less than -1 (section 3.6.2.2).
    return np.maximum(rows.astype(np.float32) / np.iinfo(rows.dtype).max, np.float32(-1.0))
