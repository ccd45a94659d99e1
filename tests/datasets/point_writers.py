"""Plain writers of files of points, for tests: .ply, .pcd and .bin."""

from __future__ import annotations

from pathlib import Path

import numpy as np

BIN_COLUMNS = ("x", "y", "z", "intensity", "time_offset_s")


def write_ply(path: Path, columns: dict[str, np.ndarray], form: str) -> None:
    xyz, rest = columns["xyz"], {k: v for k, v in columns.items() if k != "xyz"}
    flat = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], **rest}
    names = {"f4": "float", "u1": "uchar", "i2": "short"}
    lines = ["ply", f"format {form} 1.0", "comment made", f"element vertex {len(xyz)}"]
    lines += [f"property {names[v.dtype.str[1:]]} {k}" for k, v in flat.items()]
    lines += ["element face 0", "property list uchar int vertex_indices", "end_header"]
    head = ("\n".join(lines) + "\n").encode()
    path.write_bytes(head + body_of(flat, form == "ascii"))


def write_pcd(path: Path, columns: dict[str, np.ndarray], form: str) -> None:
    xyz, rest = columns["xyz"], {k: v for k, v in columns.items() if k != "xyz"}
    flat = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], **rest}
    kinds = {"f": "F", "u": "U", "i": "I"}
    lines = ["# .PCD v0.7", "VERSION 0.7", f"FIELDS {' '.join(flat)}"]
    lines += ["SIZE " + " ".join(str(v.dtype.itemsize) for v in flat.values())]
    lines += ["TYPE " + " ".join(kinds[v.dtype.kind] for v in flat.values())]
    lines += ["COUNT " + " ".join("1" for _ in flat), f"WIDTH {len(xyz)}", "HEIGHT 1"]
    lines += ["VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(xyz)}", f"DATA {form}"]
    path.write_bytes(("\n".join(lines) + "\n").encode() + body_of(flat, form == "ascii"))


def body_of(flat: dict[str, np.ndarray], is_text: bool) -> bytes:
    table = np.empty(len(next(iter(flat.values()))), [(k, v.dtype) for k, v in flat.items()])
    for name, column in flat.items():
        table[name] = column
    if not is_text:
        return table.tobytes()
    return "\n".join(" ".join(str(v) for v in row) for row in table.tolist()).encode() + b"\n"


def write_bin(path: Path, columns: dict[str, np.ndarray], form: str) -> None:
    own = {"x": 0, "y": 1, "z": 2}
    flat = [columns["xyz"][:, own[n]] if n in own else columns[n] for n in BIN_COLUMNS]
    np.stack(flat, axis=1).astype("<f4").tofile(path)
