"""Files and computation of labels: actor and depth of every pixel, visibility and boxes of every
actor."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int32

from lightsim.core.camera import PinholeCamera
from lightsim.core.frame_labels import ActorLabel, Box, FrameLabels
from lightsim.core.scenario import ActorPlacement, Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.scene import placed_meshes
from lightsim.simulation.relighter import RelitFrame
from lightsim.store.artefact import json_ready, write_json
from lightsim.store.entries import Entries
from lightsim.store.exr import write_exr
from lightsim.store.images import read_png16, write_png, write_png16

_REMEDY = "Make the scenario again, with --labels --overwrite."


def write_labels(folder: Path, scenario: Scenario, result: RelitFrame) -> None:
    """Write the labels of a frame to labels/<camera>/<frame>.*.

    - .json: visibility and boxes of every actor.
    - .actor.png, 16 bits: number of the actor + 1, or 0.
    - .depth.exr: metres along the optical axis, inf without a surface.
    - .edited.png: white where the picture differs from the recorded picture under the same sky.
    - .observed.png, for a moved camera only: white where recorded pictures show the content.
    """
    assert result.traced is not None
    frame, buffers = result.frame, result.traced.geometry
    stem = folder / "labels" / frame.camera_name / frame.stem
    stem.parent.mkdir(parents=True, exist_ok=True)
    shown = np.maximum(buffers.actor_index, -1) + 1
    write_png16(stem.with_name(f"{frame.stem}.actor.png"), shown.astype(np.uint16))
    write_exr(stem.with_name(f"{frame.stem}.depth.exr"), buffers.depth_z_m)
    is_edited = result.source.is_edited
    write_png(stem.with_name(f"{frame.stem}.edited.png"), np.uint8(255) * is_edited)
    is_observed = result.source.is_observed
    if is_observed is not None:
        write_png(stem.with_name(f"{frame.stem}.observed.png"), np.uint8(255) * is_observed)
    camera = scenario.cameras[frame.camera_name]
    write_json(
        stem.with_name(f"{frame.stem}.json"),
        {
            "camera": frame.camera_name,
            "frame": frame.stem,
            "actors": json_ready(actor_labels(scenario, frame, camera, buffers.actor_index)),
        },
    )


def has_labels(folder: Path, frame: CameraFrame) -> bool:
    """Return whether the labels of a frame were written with its picture."""
    return _labels_path(folder, frame).is_file()


def read_labels(folder: Path, frame: CameraFrame) -> FrameLabels:
    """Return the labels of a frame that `write_labels` has written.

    Raises:
        ArtefactError, InputError: a file is missing or damaged.
    """
    path = _labels_path(folder, frame)
    actors = Entries.of_file(path, _REMEDY).objects("actors")
    numbers = read_png16(path.with_name(f"{frame.stem}.actor.png"))
    return FrameLabels(tuple(_read_label(a) for a in actors), numbers.astype(np.int32) - 1)


def _labels_path(folder: Path, frame: CameraFrame) -> Path:
    return folder / "labels" / frame.camera_name / f"{frame.stem}.json"


def _read_label(entry: Entries) -> ActorLabel:
    return ActorLabel(
        entry.text("actor_id"),
        int(entry.number("number")),
        int(entry.number("visible_px")),
        int(entry.number("amodal_px")),
        entry.number("visibility"),
        None if entry.is_null("visible_box") else _read_box(entry, "visible_box"),
        _read_box(entry, "amodal_box"),
    )


def _read_box(entry: Entries, name: str) -> Box:
    left, top, right, bottom = (int(value) for value in entry.numbers(name, (4,)))
    return left, top, right, bottom


def actor_labels(
    scenario: Scenario,
    frame: CameraFrame,
    camera: PinholeCamera,
    actor_index: Int32[np.ndarray, "h w"],
) -> list[ActorLabel]:
    """Return the label of every actor that has a mesh and whose amodal mask is not empty."""
    labels = (
        _label(scenario, placement, actor_index, frame, camera)
        for placement in scenario.placements_at(frame.time_ns)
    )
    return [label for label in labels if label is not None]


def _label(
    scenario: Scenario,
    placement: ActorPlacement,
    actor_index: Int32[np.ndarray, "h w"],
    frame: CameraFrame,
    camera: PinholeCamera,
) -> ActorLabel | None:
    """Return the label of one actor; None if the picture would not show it without occluders."""
    number = scenario.number_by_actor[placement.track.actor_id]
    visible = actor_index == number
    # The two masks may differ by rounding; a visible pixel is always part of the amodal mask.
    alone = amodal_mask(placement, frame, camera) | visible
    amodal_box = _box(alone)
    if amodal_box is None:
        return None
    visible_px, amodal_px = int(visible.sum()), int(alone.sum())
    return ActorLabel(
        placement.track.actor_id,
        number,
        visible_px,
        amodal_px,
        visible_px / amodal_px,
        _box(visible),
        amodal_box,
    )


def amodal_mask(
    placement: ActorPlacement, frame: CameraFrame, camera: PinholeCamera
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the picture that show an actor if occluders are ignored."""
    mask = np.zeros((camera.height_px, camera.width_px), dtype=bool)
    rows, columns = _window(placement, frame, camera)
    uv = camera.pixel_centres()[rows, columns]
    if not uv.size:
        return mask
    caster = make_embree_caster(placed_meshes((placement,), frame.time_ns))
    hits = caster.intersect(*frame.pixel_rays(camera, uv.reshape(-1, 2)))
    mask[rows, columns] = hits.is_hit.reshape(uv.shape[:2])
    return mask


def _window(
    placement: ActorPlacement, frame: CameraFrame, camera: PinholeCamera
) -> tuple[slice, slice]:
    """Return rows and columns around an actor's box: the whole picture if the box is partly behind
    the camera, none if it is entirely behind."""
    pose = placement.world_from_actor(frame.time_ns)
    mesh = placement.asset.mesh.vertices.astype(np.float64)
    ends = np.stack([mesh.min(axis=0), mesh.max(axis=0)])
    corners = np.stack(np.meshgrid(*ends.T), axis=-1).reshape(-1, 3)
    depth = frame.world_from_camera.inverse().apply(pose.apply(corners))[:, 2]
    if (depth <= 0).all():
        return slice(0, 0), slice(0, 0)
    # The projection of a box is unbounded if one of its corners is behind the camera.
    if (depth <= 0).any():
        return slice(None), slice(None)
    uv, _ = frame.project(camera, pose.apply(corners))
    low = np.floor(uv.min(axis=0)).astype(int) - 1
    high = np.ceil(uv.max(axis=0)).astype(int) + 1
    left, right = np.clip([low[0], high[0]], 0, camera.width_px)
    top, bottom = np.clip([low[1], high[1]], 0, camera.height_px)
    return slice(top, bottom), slice(left, right)


def _box(mask: Bool[np.ndarray, "h w"]) -> Box | None:
    if not mask.any():
        return None
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    # Right and bottom are exclusive.
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
