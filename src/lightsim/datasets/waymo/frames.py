"""Version 1 of the data set: a TFRecord file with one message `Frame` a sweep.

Numbers of fields are those of dataset.proto and label.proto (github.com/waymo-research/
waymo-open-dataset).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from lightsim.datasets.lenses import Lens
from lightsim.datasets.waymo.range_image import unpack_matrix
from lightsim.datasets.waymo.segment import (
    Box,
    Camera,
    Frame,
    Laser,
    Picture,
    RangeImages,
    Segment,
    decode_picture,
    make_box,
    make_camera,
    make_picture,
    time_ns,
    transform,
)
from lightsim.datasets.waymo.wire import Message, Span, Wire, broken, open_tfrecord

# Largest compressed picture or range image, in bytes.
_MAX_BYTES = 32 << 20


def read_records(path: Path) -> Segment:
    """Read a segment; pictures and range images are read on demand.

    Raises:
        InputError: the file is damaged, or not of this data set.
    """
    with open_tfrecord(path) as handle:
        wire = Wire(handle, path)
        segment: Segment | None = None
        frames: list[Frame] = []
        for i, span in enumerate(wire.records()):
            message = wire.message(span, f"frame {i}")
            context = message.message(1, "context")
            if segment is None:
                segment = _segment(context)
            if context.text(1) != segment.name:
                got = f"frames of '{segment.name}' and '{context.text(1)}'"
                raise broken(message.where, got, "frames of one segment")
            frames.append(_frame(path, message, segment.cameras))
    if segment is None:
        raise broken(path, "no record", "frames of a drive")
    return replace(segment, frames=tuple(frames))


def _segment(context: Message) -> Segment:
    """Return the segment without its frames."""
    name = context.text(1)
    cameras = dict(_camera(message) for message in context.messages(2, "camera"))
    if not name or not cameras:
        got = "no name or no camera"
        raise broken(context.where, got, "frames of the perception data set, not of another one")
    lasers = dict(_laser(message) for message in context.messages(3, "laser"))
    return Segment(name, context.message(4, "stats").text(3), cameras, lasers, ())


def _camera(message: Message) -> tuple[int, Camera]:
    where = message.where
    pose = transform("ego", "waymo camera", message.message(3, "extrinsic").numbers(1), where)
    size = message.whole(4), message.whole(5)
    return message.whole(1), make_camera(message.numbers(2), pose, size, message.whole(6), where)


def _laser(message: Message) -> tuple[int, Laser]:
    pose = transform("ego", "laser", message.message(5, "extrinsic").numbers(1), message.where)
    edges = message.number(3), message.number(4)
    return message.whole(1), Laser(pose, tuple(message.numbers(2)), edges)


def _frame(path: Path, message: Message, cameras: Mapping[int, Camera]) -> Frame:
    where = message.where
    pose = transform("world", "ego", message.message(3, "pose").numbers(1), where)
    pictures = [_picture(path, picture, cameras) for picture in message.messages(4, "image")]
    sweeps = dict(_sweep(path, laser) for laser in message.messages(5, "laser"))
    return Frame(
        time_ns(message.whole(2) / 1e6, where),
        pose,
        tuple(pictures),
        {number: load for number, load in sweeps.items() if load is not None},
        tuple(_box(label) for label in message.messages(6, "label")),
    )


def _picture(path: Path, message: Message, cameras: Mapping[int, Camera]) -> Picture:
    where = message.where
    camera, span = cameras.get(message.whole(1)), message.spans(2)
    if camera is None or not span:
        got = f"camera {message.whole(1)} without calibration" if span else "no picture"
        raise broken(where, got, "a JPEG of a calibrated camera")
    pose = transform("world", "ego", message.message(3, "pose").numbers(1), where)
    # pose_timestamp, shutter, camera_trigger_time, camera_readout_done_time
    times_s = message.number(5), message.number(6), message.number(7), message.number(8)
    load = partial(_load_picture, path, span[-1], camera.lens, where)
    return make_picture(message.whole(1), times_s, pose, load, where)


def _load_picture(path: Path, span: Span, lens: Lens, where: str) -> UInt8[np.ndarray, "h w 3"]:
    return decode_picture(_read(path, span), lens, where)


def _read(path: Path, span: Span) -> bytes:
    with open_tfrecord(path) as handle:
        return Wire(handle, path).read(span, _MAX_BYTES)


def _sweep(path: Path, message: Message) -> tuple[int, Callable[[], RangeImages] | None]:
    """Return the number of a LiDAR, and what loads its range images; None without any."""
    first, second = (message.message(number, "return") for number in (2, 3))
    images = [span for part in (first, second) for span in part.spans(2)[-1:]]
    poses = first.spans(4)[-1:]
    load = partial(_load_sweep, path, images, poses, message.where)
    return message.whole(1), load if images else None


def _load_sweep(path: Path, images: list[Span], poses: list[Span], where: str) -> RangeImages:
    returns = tuple(unpack_matrix(_read(path, span), 2, where) for span in images)
    found = [unpack_matrix(_read(path, span), 6, where)[..., :6] for span in poses]
    return RangeImages(returns, found[0] if found else None)


def _box(message: Message) -> Box:
    box, metadata = message.message(1, "box"), message.message(2, "metadata")
    # In label.proto, width is field 4 and length field 5.
    numbers = [box.number(i) for i in (1, 2, 3, 5, 4, 6, 7)]
    speed = math.hypot(metadata.number(1), metadata.number(2))
    return make_box(message.text(4), message.whole(3), numbers, speed, message.where)
