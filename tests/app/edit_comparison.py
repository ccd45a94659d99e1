"""Comparison of the viewer's boxes with those of scenario.json."""

from __future__ import annotations

from typing import Any

import numpy as np

from lightsim.app.editing import Edits
from lightsim.app.editor import Editor


def largest_difference(editor: Editor, edits: Edits, written: Any) -> tuple[float, float]:
    """Largest distance between corners (in metres) and largest angle (in degrees) between the
    boxes of an editor and those of scenario.json; actors, kinds and sizes must be equal."""
    metres, degrees = 0.0, 0.0
    assert written["frames"]
    for frame in written["frames"]:
        boxes = editor.boxes(edits, frame["time_ns"])
        assert list(boxes) == [actor["actor_id"] for actor in frame["actors"]]
        for actor, box in zip(frame["actors"], boxes.values(), strict=True):
            assert box.kind == actor["kind"]
            assert box.size_lwh_m.tolist() == actor["size_lwh_m"]
            other = np.array(actor["world_from_actor"])
            signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
            corners = signs * box.size_lwh_m
            moved = corners @ other[:3, :3].T + other[:3, 3]
            away = np.linalg.norm(moved - box.world_from_actor.apply(corners), axis=1)
            turn = box.world_from_actor.rotation.T @ other[:3, :3]
            sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0],
                                   turn[1, 0] - turn[0, 1]]) / 2  # fmt: skip
            metres = max(metres, float(away.max()))
            degrees = max(degrees, float(np.degrees(np.arctan2(sine, (np.trace(turn) - 1) / 2))))
    return metres, degrees
