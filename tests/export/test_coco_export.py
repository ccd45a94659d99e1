"""Exports in COCO's layout: masks come back bit by bit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.export.devkit import probed
from tests.export.tiny_export import STEMS, Labels, box_mask, box_track, edges, tiny_log

from lightsim.core.actors import ActorKind
from lightsim.export.coco.log import ANNOTATIONS_NAME, CATEGORY_BY_KIND, write_coco
from lightsim.export.coco.rle import encode_mask
from lightsim.progress import SilentProgress
from lightsim.store.images import read_srgb8


def decoded(code: dict[str, Any]) -> np.ndarray:
    """rleFrString and rleDecode of cocoapi's maskApi.c."""
    runs: list[int] = []
    number = shift = 0
    for character in code["counts"]:
        bits = ord(character) - 48
        number |= (bits & 0x1F) << shift
        shift += 5
        if bits & 0x20:
            continue
        if bits & 0x10:
            number -= 1 << shift
        runs.append(number + (runs[-2] if len(runs) > 2 else 0))
        number = shift = 0
    values = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return values.reshape(code["size"][1], code["size"][0]).T


@pytest.mark.parametrize("density", [0.0, 0.003, 0.5, 0.97, 1.0])
def test_masks_come_back(rng: np.random.Generator, density: float) -> None:
    for shape in ((1, 1), (3, 200), (270, 480)):
        mask = rng.random(shape) < density
        assert (decoded(encode_mask(mask)) == mask).all()
    # A rectangle has long runs, which take several characters.
    box = np.zeros((400, 300), dtype=bool)
    box[10:350, 5:290] = True
    assert (decoded(encode_mask(box)) == box).all()


def test_annotations_are_those_of_the_visible_pixels(tmp_path: Path) -> None:
    track = box_track()
    log = tiny_log(tmp_path / "made", labels=Labels(track, 0.5))
    (tmp_path / "out").mkdir()
    written = write_coco(log, tmp_path / "out", SilentProgress())
    value = json.loads((tmp_path / "out" / ANNOTATIONS_NAME).read_text())
    assert [name for name, _ in written.pictures] == [
        f"images/{image['file_name']}" for image in value["images"]
    ]
    assert value["licenses"] == [{"id": 1, "name": "CC BY-NC-SA 4.0", "url": ""}]
    images = {image["id"]: image for image in value["images"]}
    assert [images[row["image_id"]]["frame"] for row in value["annotations"]] == list(STEMS)
    for row in value["annotations"]:
        image = images[row["image_id"]]
        frame = next(f for f in log.log.frames_of("front") if f.stem == image["frame"])
        whole = edges(box_mask(frame, track))
        mask = decoded(row["segmentation"])
        shown = read_srgb8(log.picture_path(frame))[..., 0] > 0
        assert (mask <= shown).all()
        assert row["area"] == mask.sum() == round(row["visibility"] * shown.sum())
        left, top, right, bottom = edges(mask)
        assert row["bbox"] == [left, top, right - left, bottom - top]
        assert row["amodal_bbox"][:2] == list(whole[:2])
        assert (row["category_id"], row["iscrowd"]) == (3, 0)
    assert set(CATEGORY_BY_KIND) == set(ActorKind)


def test_truth_as_detections_has_average_precision_one(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write_coco(tiny_log(tmp_path / "made"), tmp_path / "out", SilentProgress())
    path = tmp_path / "out" / ANNOTATIONS_NAME
    found = probed("coco_probe.py", tmp_path / "out.json", str(path))
    assert found["ap"] == {"bbox": 1.0, "segm": 1.0}
    rows = json.loads(path.read_text())["annotations"]
    assert found["masks"] == {str(row["id"]): row["area"] for row in rows}
