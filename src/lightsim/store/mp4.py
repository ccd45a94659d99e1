"""Writer of .mp4 videos from 8-bit sRGB frames, by default with VP9."""

from __future__ import annotations

import os
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import UInt8

from lightsim.core.checks import check_choice
from lightsim.errors import InputError
from lightsim.store.atomic import partial_name, unwritable

# Number of BT.709 in FFmpeg's enumerations of primaries, transfer functions and matrices
# (pixfmt.h).
_BT709 = 1
Codec = Literal["vp9", "h264"]
# Default codec: its encoder has the BSD licence; Chromium, Firefox, Safari from version 14, VLC and
# mpv play it.
DEFAULT_CODEC: Codec = "vp9"
# Encoder of FFmpeg and its options, by codec.
_ENCODERS: dict[Codec, tuple[str, dict[str, str]]] = {
    # 39.6 dB, 28 kB and 63 ms of processor time per frame, on 30 frames of the shipped street at
    # 960 x 540 px (no script repeats this): the quality of x264 below. A fixed speed makes the
    # bytes independent of timing.
    "vp9": ("libvpx-vp9", {"crf": "24", "b": "0", "deadline": "realtime", "cpu-used": "5"}),
    # 39.6 dB, 31 kB and 77 ms on the same frames. x264 has the GPL (NOTICE).
    "h264": ("libx264", {"crf": "20", "preset": "medium"}),
}
# Smallest width and height, in pixels: one macroblock of H.264.
_MIN_SIDE_PX = 16
# Largest frame rate, in frames per second. It is far above any camera's; a higher rate results from
# wrong time stamps.
_MAX_FPS = 1000


class Mp4Writer:
    """Context manager that writes a video frame by frame.

    The file appears if the block ends without an error. The video is yuv420p in BT.709 with limited
    range, and has its index in front (faststart). Since yuv420p needs even sides, an odd last row
    or column is cropped. One encoder thread makes equal frames give equal bytes.

    Raises:
        InputError: the size is too small, the rate is not positive, the folder does not exist,
            a frame has another size, or PyAV has no encoder for the codec.
        ArtefactError: the file cannot be written.
    """

    def __init__(
        self, path: Path, width: int, height: int, fps: float, codec: Codec = DEFAULT_CODEC
    ) -> None:
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
        check_codec(codec)
        self._path = path
        self._size = (height, width)
        self._temporary = partial_name(path)
        self._container, self._stream = _open(self._temporary, width, height, fps, codec)

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
            # None flushes the encoder.
            if kind is None:
                self._mux(None)
            self._container.close()
            if kind is None:
                os.replace(self._temporary, self._path)
        except (FFmpegError, OSError) as failure:
            raise unwritable(self._path, failure) from failure
        finally:
            self._temporary.unlink(missing_ok=True)


def check_codec(codec: Codec) -> None:
    """Check that this build of PyAV can encode a codec.

    Raises:
        InputError: the codec is unknown, or PyAV has no encoder for it.
    """
    import av

    check_choice("--video-codec", codec, get_args(Codec))
    encoder = _ENCODERS[codec][0]
    if encoder not in av.codecs_available:
        others = [name for name, (other, _) in _ENCODERS.items() if other in av.codecs_available]
        raise InputError(
            "the installed PyAV cannot encode this video codec",
            where=f"--video-codec {codec}",
            got=f"no encoder {encoder} in av {av.__version__}",
            expected=f"one of {', '.join(others)}" if others else None,
            remedy="Install the wheel of PyPI: pip install --force-reinstall av",
        )


def _open(path: Path, width: int, height: int, fps: float, codec: Codec) -> tuple[Any, Any]:
    """Open the file and return its container and video stream."""
    import av

    encoder, settings = _ENCODERS[codec]
    container = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
    stream: Any = container.add_stream(encoder, rate=Fraction(fps).limit_denominator(1001))
    stream.width, stream.height = width - width % 2, height - height % 2
    stream.pix_fmt = "yuv420p"
    stream.thread_count = 1
    stream.options = dict(settings)
    context = stream.codec_context
    context.color_primaries = context.color_trc = context.colorspace = _BT709
    context.color_range = 1  # AVCOL_RANGE_MPEG, limited range
    return container, stream
