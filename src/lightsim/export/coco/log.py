"""Exports in the layout of COCO: pictures, boxes and masks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from lightsim.core.actors import ActorKind
from lightsim.core.sensors import CameraFrame
from lightsim.core.version import __version__
from lightsim.export.coco.rle import encode_mask
from lightsim.export.provenance import Written
from lightsim.export.scenario_log import ScenarioLog
from lightsim.progress import Progress
from lightsim.store.artefact import write_json
from lightsim.store.images import write_jpeg

ANNOTATIONS_NAME = "annotations/instances.json"
# Quality of pictures, with full chroma. Chosen; sensitivity not measured.
_JPEG_QUALITY = 95
CATEGORY_BY_KIND: Mapping[ActorKind, tuple[int, str, str]] = MappingProxyType({
    ActorKind.PEDESTRIAN: (1, "person", "person"),
    ActorKind.BICYCLE: (2, "bicycle", "vehicle"),
    ActorKind.CAR: (3, "car", "vehicle"),
    ActorKind.MOTORCYCLE: (4, "motorcycle", "vehicle"),
    ActorKind.SCOOTER: (4, "motorcycle", "vehicle"),
    ActorKind.BUS: (6, "bus", "vehicle"),
    ActorKind.RAIL_VEHICLE: (7, "train", "vehicle"),
    ActorKind.TRUCK: (8, "truck", "vehicle"),
    # COCO counts pickups as trucks.
    ActorKind.PICKUP: (8, "truck", "vehicle"),
    ActorKind.TRAILER: (101, "trailer", "vehicle"),
    ActorKind.CONSTRUCTION_VEHICLE: (102, "construction vehicle", "vehicle"),
    ActorKind.OTHER_VEHICLE: (103, "other vehicle", "vehicle"),
    ActorKind.PERSONAL_MOBILITY: (104, "personal mobility", "person"),
    ActorKind.ANIMAL: (105, "animal", "animal"),
    ActorKind.CONE: (106, "cone", "outdoor"),
    ActorKind.SIGN: (107, "sign", "outdoor"),
    ActorKind.BARRIER: (108, "barrier", "outdoor"),
    ActorKind.ROLLING_CONTAINER: (109, "rolling container", "outdoor"),
    ActorKind.OTHER: (110, "other", "outdoor"),
})  # fmt: skip
"""Id, name and supercategory: those of COCO where it has the class, others from 101 on."""


def write_coco(log: ScenarioLog, folder: Path, progress: Progress) -> Written:
    """Write images/<camera>/<frame>.jpg and annotations/instances.json.

    Args:
        folder: empty, or with the pictures of an interrupted export of the same log.
    """
    kinds = {track.actor_id: track.kind for track in log.log.actors}
    pictures: list[tuple[str, CameraFrame]] = []
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    frames = log.log.frames
    for frame in progress.track(frames, "write COCO", len(frames)):
        name = f"{frame.camera_name}/{frame.stem}.jpg"
        path = folder / "images" / name
        # A complete file of an interrupted export is not written again.
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_jpeg(path, frame.load_srgb8(), quality=_JPEG_QUALITY)
        pictures.append((f"images/{name}", frame))
        images.append(_image(log, frame, name, len(images) + 1))
        for row in _annotations(log, frame, kinds):
            number = len(annotations) + 1
            annotations.append({"id": number, "image_id": len(images), **row})
    (folder / "annotations").mkdir(exist_ok=True)
    content = {**_header(log), "images": images, "annotations": annotations}
    write_json(folder / ANNOTATIONS_NAME, content)
    usage = (
        f"`COCO('{ANNOTATIONS_NAME}')` loads it; `file_name` is relative to images/.",
        "Boxes and masks are those of the visible pixels; `visibility` is the visible fraction,"
        " `amodal_bbox` the box without occluders. Actors without a mesh are not annotated.",
        "Categories 1 to 8 are COCO's; others start at 101.",
    )
    return Written(pictures, {}, usage)


def _header(log: ScenarioLog) -> dict[str, Any]:
    return {
        "info": {
            "description": f"LightSim {log.log.name}, sky {log.sky.get('sky')}",
            "version": __version__,
        },
        "licenses": [{"id": 1, "name": log.log.licence or "unknown", "url": ""}],
        "categories": [
            {"id": number, "name": name, "supercategory": group}
            for number, name, group in sorted(set(CATEGORY_BY_KIND.values()))
        ],
    }


def _image(log: ScenarioLog, frame: CameraFrame, name: str, number: int) -> dict[str, Any]:
    camera = log.log.cameras[frame.camera_name]
    return {
        "id": number,
        "file_name": name,
        "width": camera.width_px,
        "height": camera.height_px,
        "license": 1,
        "camera": frame.camera_name,
        "frame": frame.stem,
        "time_ns": frame.time_ns,
    }


def _annotations(
    log: ScenarioLog, frame: CameraFrame, kinds: Mapping[str, ActorKind]
) -> list[dict[str, Any]]:
    """Return the entries of the actors that a picture shows."""
    labels = log.labels(frame)
    found: list[dict[str, Any]] = []
    for label in labels.actors:
        if label.visible_box is None:
            continue
        number, _, _ = CATEGORY_BY_KIND[kinds[label.actor_id]]
        found.append(
            {
                "category_id": number,
                "bbox": _bbox(label.visible_box),
                "area": label.visible_px,
                "segmentation": encode_mask(labels.mask(label)),
                "iscrowd": 0,
                "actor_id": label.actor_id,
                "visibility": label.visibility,
                "amodal_bbox": _bbox(label.amodal_box),
            }
        )
    return found


def _bbox(box: tuple[int, int, int, int]) -> list[int]:
    """Return left, top, width and height of a box."""
    left, top, right, bottom = box
    return [left, top, right - left, bottom - top]
