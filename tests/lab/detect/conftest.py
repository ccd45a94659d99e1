"""Made pictures of boxes on a plane, as a camera 1.6 m above it sees them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightsim.store.images import write_png
from lightsim_lab.detect.labels import View
from lightsim_lab.detect.pictures import Picture

# Camera of 160 x 96 pixels that looks along x of the level frame.
SIZE_PX = (160, 96)
PROJECTION = np.array([[80.0, -120, 0, 0], [40, 0, -120, 0], [1, 0, 0, 0]])


def pixels(points: np.ndarray) -> np.ndarray:
    uvw = np.column_stack([points, np.ones(len(points))]) @ PROJECTION.T
    return uvw[:, :2] / uvw[:, 2:]


def made_picture(folder: Path, name: str, boxes: np.ndarray) -> Picture:
    """Write a picture with the front of each box as a bright rectangle."""
    image = np.full((SIZE_PX[1], SIZE_PX[0], 3), 90, np.uint8)
    for x, y, z, length, width, height, _ in boxes:
        front = x - length / 2
        ends = [[front, y + side * width / 2, z - side * height / 2] for side in (1, -1)]
        (u0, v1), (u1, v0) = np.round(pixels(np.array(ends))).astype(int)
        image[max(v0, 0) : v1, max(u0, 0) : u1] = [240, 200, 60]
    path = folder / "camera" / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, image)
    view = View(f"camera/{name}", SIZE_PX, PROJECTION, boxes, np.zeros((0, 7)))
    return Picture(view, "recorded", path)


@pytest.fixture
def pictures(tmp_path: Path) -> list[Picture]:
    """Two pictures with a vehicle each."""
    near = np.array([[9.3, 1.2, -0.9, 4.4, 1.9, 1.4, 0.2]])
    far = np.array([[15.6, -3.4, -0.9, 4.0, 1.8, 1.4, -1.1]])
    return [made_picture(tmp_path, "00", near), made_picture(tmp_path, "01", far)]
