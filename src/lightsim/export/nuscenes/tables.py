"""Tables of nuScenes: rows with tokens that link them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lightsim.core.frames import RigidTransform, quaternion_from_matrix
from lightsim.store.artefact import json_ready, write_text

NAMES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample",
    "sample_annotation", "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip


class Tables:
    """The tables of one scene.

    Args:
        key: enters all tokens, so that tables of several exports can be joined.
    """

    def __init__(self, key: str) -> None:
        self._key = key
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in NAMES}

    def token(self, *names: object) -> str:
        """Return the token of a row: 32 hexadecimal digits, a hash of the row's names."""
        text = json.dumps([self._key, *map(str, names)])
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def add(self, table: str, token: str, row: Mapping[str, Any]) -> None:
        """Add a row."""
        self.rows[table].append({"token": token, **row})

    def write(self, folder: Path) -> None:
        """Write one JSON file a table."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, rows in self.rows.items():
            text = json.dumps(json_ready(rows), indent=0, allow_nan=False)
            write_text(folder / f"{name}.json", text + "\n")


def link(rows: list[dict[str, Any]]) -> None:
    """Set `prev` and `next` of rows in order of time."""
    for number, row in enumerate(rows):
        row["prev"] = rows[number - 1]["token"] if number else ""
        row["next"] = rows[number + 1]["token"] if number + 1 < len(rows) else ""


def pose_entries(pose: RigidTransform) -> dict[str, Any]:
    """Return translation (metres) and rotation (quaternion w, x, y, z) of a pose."""
    return {
        "translation": pose.translation_m.tolist(),
        "rotation": quaternion_from_matrix(pose.rotation).tolist(),
    }


def microseconds(time_ns: int) -> int:
    """Return a time in nuScenes' unit."""
    return (time_ns + 500) // 1000
