"""Files of a relit scenario: pictures, linear radiance, expected error and videos."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.progress import Progress
from lightsim.simulation.labels import write_labels
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relighter import RelitFrame
from lightsim.store.images import read_srgb8, write_exr, write_png
from lightsim.store.mp4 import Codec, Mp4Writer


def picture_path(folder: Path, frame: CameraFrame) -> Path:
    """Return the path of a frame's picture; the file exists once the frame is complete."""
    return folder / "frames" / frame.camera_name / f"{frame.stem}.png"


def write_frame(
    folder: Path, scenario: Scenario, result: RelitFrame, options: RelightOptions
) -> None:
    """Write the files of one frame that the options select."""
    if options.labels:
        write_labels(folder, scenario, result)
    if options.expected_error:
        _write_expected_error(folder, result)
    frame = result.frame
    if options.linear:
        linear = folder / "linear" / frame.camera_name / f"{frame.stem}.exr"
        linear.parent.mkdir(parents=True, exist_ok=True)
        write_exr(linear, result.radiance)
    path = picture_path(folder, frame)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The PNG comes last: it marks the frame as complete.
    write_png(path, result.image_srgb8)


def _write_expected_error(folder: Path, result: RelitFrame) -> None:
    """Write the expected error in 8-bit codes; it is 0 for pixels that retain their light."""
    error = result.expected_error
    if error is None:
        error = np.zeros(result.image_srgb8.shape[:2], np.float32)
    path = folder / "error" / result.frame.camera_name / f"{result.frame.stem}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, np.rint(255 * np.clip(error, 0, 1)).astype(np.uint8))


def write_videos(folder: Path, scenario: Scenario, codec: Codec, progress: Progress) -> None:
    """Write video/<camera>.mp4 from the pictures of every camera."""
    (folder / "video").mkdir(exist_ok=True)
    cameras = list(dict.fromkeys(f.camera_name for f in scenario.frames))
    for name in progress.track(cameras, "video", len(cameras)):
        frames = [f for f in scenario.frames if f.camera_name == name]
        # Pictures are decoded one at a time: those of a whole log do not fit into memory.
        images = (read_srgb8(picture_path(folder, frame)) for frame in frames)
        height, width = read_srgb8(picture_path(folder, frames[0])).shape[:2]
        path = folder / "video" / f"{name}.mp4"
        with Mp4Writer(path, width, height, frame_rate(frames), codec) as video:
            for image in images:
                video.write(image)


def frame_rate(frames: Sequence[CameraFrame]) -> float:
    """Return the frames per second of one camera from the median interval; 10 for one frame."""
    if len(frames) < 2:
        return 10.0  # The rate of most driving logs.
    # The median ignores gaps in the selection of frames.
    intervals_s = np.diff([f.time_ns for f in frames]) / 1e9
    return float(round(1.0 / float(np.median(intervals_s)), 3))
