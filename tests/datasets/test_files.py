"""JSON, gzip and frame ranges: only our errors, whatever the bytes."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lightsim.datasets import files
from lightsim.datasets.files import read_json, read_packed, read_times_ns, require_numbers
from lightsim.datasets.pandaset.cameras import read_poses
from lightsim.datasets.selection import FrameSelection
from lightsim.errors import InputError, LightSimError

_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["position", "heading", "x", "w"]), inner, max_size=4)
    ),
    max_leaves=12,
)
_FUZZ = settings(
    max_examples=150, deadline=2000, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def names_the_file(read: Callable[[Path], Any], path: Path) -> None:
    """Either `read` accepts the file, or our error names it; no other error is let through."""
    try:
        read(path)
    except LightSimError as error:
        message = str(error)
    else:
        return
    assert str(path) in message


@_FUZZ
@given(st.binary(max_size=200))
def test_arbitrary_bytes_raise_only_our_errors(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "any"
    path.write_bytes(data)
    for read in (read_json, read_poses, read_times_ns, lambda p: read_packed(p, 1000)):
        names_the_file(read, path)


@_FUZZ
@given(_JSON)
def test_arbitrary_json_raises_only_our_errors(tmp_path: Path, value: Any) -> None:
    path = tmp_path / "any.json"
    path.write_text(json.dumps(value))
    for read in (read_poses, read_times_ns):
        names_the_file(read, path)


@pytest.mark.parametrize(
    "text", ["[" * 200_000, "1" * 10_000, '{"a": 1e999}', "\ud800".encode("utf-8", "surrogatepass")]
)
def test_extreme_json_raises_our_error(tmp_path: Path, text: str | bytes) -> None:
    path = tmp_path / "extreme.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=r"extreme\.json"):
        require_numbers(read_json(path), ("a",), path)


def test_gzip_members_and_padding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.gz"
    parts = [bytes(300_000), b"", np.random.default_rng(0).bytes(200_000), b"end"]
    path.write_bytes(b"".join(map(gzip.compress, parts)) + bytes(1000))
    assert read_packed(path, 500_003) == b"".join(parts)
    with pytest.raises(InputError, match="decompresses to more"):
        read_packed(path, 500_002)
    monkeypatch.setattr(files, "_MAX_MEMBERS", 3)
    with pytest.raises(InputError, match="in 3 gzip members"):
        read_packed(path, 500_003)


def test_json_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text("[1, 2]")
    monkeypatch.setattr(files, "MAX_JSON_BYTES", 5)
    with pytest.raises(InputError, match=r"a\.json: this JSON file is too large"):
        read_json(path)


def test_times_keep_microseconds(tmp_path: Path) -> None:
    path = tmp_path / "timestamps.json"
    path.write_text("[1557539956.45018, 1557539956.550184]")
    assert read_times_ns(path).tolist() == [1557539956450180000, 1557539956550184000]


def test_frame_ranges() -> None:
    numbers = range(10)

    def select(text: str) -> list[int]:
        return [n for n in numbers if FrameSelection.parse(text).holds(n)]

    assert select("") == list(numbers)
    assert select("3:6") == [3, 4, 5]
    assert select("2::3") == [2, 5, 8]
    assert select(":4:2") == [0, 2]
    for wrong in ("5", "6:3", "a:b", "1:2:0", "-1:5", "1:2:3:4", "1:1"):
        with pytest.raises(InputError, match="--frames"):
            FrameSelection.parse(wrong)
