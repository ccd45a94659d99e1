from __future__ import annotations

from pathlib import Path
from typing import get_args

import av
import numpy as np
import pytest

from lightsim.errors import InputError
from lightsim.store.mp4 import DEFAULT_CODEC, Codec, Mp4Writer


def _frame(index: int) -> np.ndarray:
    frame = np.zeros((49, 65, 3), np.uint8)
    frame[:, :20], frame[:, 20:40], frame[:, 40:] = [200, 30, 30], [30, 200, 30], [30, 30, 200]
    frame[:24] = np.minimum(frame[:24].astype(int) + 5 * index, 255)
    return frame


def _write(path: Path, codec: Codec = DEFAULT_CODEC) -> None:
    with Mp4Writer(path, 65, 49, 10.0, codec) as video:
        for index in range(8):
            video.write(_frame(index))


@pytest.mark.parametrize("codec", get_args(Codec))
def test_frames_come_back(tmp_path: Path, codec: Codec) -> None:
    _write(tmp_path / "a.mp4", codec)
    with av.open(str(tmp_path / "a.mp4")) as container:
        back = [
            frame.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray()
            for frame in container.decode(video=0)
        ]
    assert len(back) == 8
    for index, frame in enumerate(back):
        expected = _frame(index)[:48, :64].astype(int)
        inside = np.abs(frame.astype(int) - expected)[4:18, 4:16]
        assert inside.max() <= 6
        assert np.abs(frame.astype(int) - expected).mean() < 6


@pytest.mark.parametrize("codec", get_args(Codec))
def test_standard_tags_and_same_bytes(tmp_path: Path, codec: Codec) -> None:
    _write(tmp_path / "a.mp4", codec)
    _write(tmp_path / "b.mp4", codec)
    data = (tmp_path / "a.mp4").read_bytes()
    assert data == (tmp_path / "b.mp4").read_bytes()
    assert data.find(b"moov") < data.find(b"mdat")
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert context.codec.canonical_name == codec
        assert (context.pix_fmt, stream.average_rate) == ("yuv420p", 10)
        assert (context.color_primaries, context.color_trc, context.colorspace) == (1, 1, 1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mp4", "b.mp4"]


def test_nothing_is_left_after_an_error(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match="another size"),
        Mp4Writer(tmp_path / "a.mp4", 64, 48, 10.0) as video,
    ):
        video.write(_frame(0))
    assert not list(tmp_path.iterdir())
    with pytest.raises(InputError, match="frame rate"):
        Mp4Writer(tmp_path / "a.mp4", 64, 48, 0.0)
    with pytest.raises(InputError, match="does not exist"):
        Mp4Writer(tmp_path / "no" / "a.mp4", 64, 48, 10.0)


def test_the_default_encoder_is_not_under_the_gpl(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the encoders under the GPL taken out of PyAV, films are written all the same; a codec
    without an encoder is refused before a file is made."""
    free = {name for name in av.codecs_available if not name.startswith(("libx264", "libx265"))}
    monkeypatch.setattr(av, "codecs_available", free)
    _write(tmp_path / "a.mp4")
    with pytest.raises(InputError, match=r"--video-codec h264.*libx264.*expected one of vp9"):
        _write(tmp_path / "b.mp4", "h264")
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
