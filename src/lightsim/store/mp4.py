"""Videos: 8-bit sRGB frames to .mp4 (H.264 where the PyAV wheel has it)."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import UInt8

from lightsim.errors import InputError
from lightsim.store.atomic import partial_name, unwritable

_BT709 = 1
_LIMITED_RANGE = 1
_QUALITY = "20"
_MIN_SIDE_PX = 16
_MAX_FPS = 1000
"""Far above any camera: more is a fault of the time stamps."""


class Mp4Writer:
    """Writes frames one by one; the file appears when the `with` block ends without an error.

    yuv420p needs even sides: an odd last row or column is left out. BT.709, limited range, the
    index in front (faststart). One encoder thread, so that equal frames give equal bytes.

    Raises:
        InputError: the size is too small, the rate is not positive, the folder does not exist,
            or a frame has another size.
        ArtefactError: the file cannot be written.
    """

    def __init__(self, path: Path, width: int, height: int, fps: float) -> None:
        if min(width, height) < _MIN_SIDE_PX or not 0 < fps <= _MAX_FPS:
            raise InputError(
                "a video of this size or frame rate cannot be written",
                where=path,
                got=f"{width}x{height} px at {fps:g} frames a second",
                expected=f"sides of {_MIN_SIDE_PX} px or more, above 0 and up to {_MAX_FPS} "
                "frames a second",
            )
        if not path.parent.is_dir():
            raise InputError(
                "the folder to write to does not exist",
                where=path.parent,
                remedy="Create the folder first.",
            )
        self._path = path
        self._size = (height, width)
        self._temporary = partial_name(path)
        self._container, self._stream = _open(self._temporary, width, height, fps)

    def __enter__(self) -> Mp4Writer:
        return self

    def write(self, srgb8: UInt8[np.ndarray, "h w 3"]) -> None:
        """Append one frame."""
        import av

        if srgb8.shape[:2] != self._size:
            raise InputError(
                "a frame has another size than the video",
                where=self._path,
                got=list(srgb8.shape[:2]),
                expected=list(self._size),
            )
        height, width = self._stream.height, self._stream.width
        pixels = np.ascontiguousarray(srgb8[:height, :width])
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        frame.color_primaries, frame.color_trc = _BT709, _BT709
        self._mux(frame)

    def _mux(self, frame: Any) -> None:
        from av.error import FFmpegError

        try:
            self._container.mux(self._stream.encode(frame))
        except (FFmpegError, OSError) as error:
            raise unwritable(self._path, error) from error

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        from av.error import FFmpegError

        try:
            if kind is None:
                self._mux(None)
            self._container.close()
            if kind is None:
                os.replace(self._temporary, self._path)
        except (FFmpegError, OSError) as failure:
            raise unwritable(self._path, failure) from failure
        finally:
            self._temporary.unlink(missing_ok=True)


def _open(path: Path, width: int, height: int, fps: float) -> tuple[Any, Any]:
    """The container and its stream; libx264 by preference, mpeg4 where it is not built in."""
    import av

    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    container = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
    stream: Any = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
    stream.width, stream.height = width - width % 2, height - height % 2
    stream.pix_fmt = "yuv420p"
    stream.thread_count = 1
    context = stream.codec_context
    context.color_primaries = context.color_trc = context.colorspace = _BT709
    context.color_range = _LIMITED_RANGE
    if codec == "libx264":
        stream.options = {"crf": _QUALITY, "preset": "medium"}
    else:
        stream.bit_rate = int(0.25 * width * height * fps)
    return container, stream
