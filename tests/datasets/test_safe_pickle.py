"""The pickle reader: both generations of pandas, and nothing that a hostile file can do."""

from __future__ import annotations

import gzip
import io
import pickle
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets import arrow_pickles
from lightsim.datasets import pickle_values, safe_pickle
from lightsim.datasets.safe_pickle import parse_table, read_table
from lightsim.errors import InputError, LightSimError

FRAME = pd.DataFrame(
    {
        "uuid": ["a", "b", "c"],
        "yaw": [0.5, np.nan, -1.0],
        "n": np.array([1, 2, 3], dtype=np.int32),
        "is_on": [True, False, True],
        "label": ["Car", None, "Cones"],
        "x": np.array([1, 2, 3], dtype=np.float32),
    }
)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_tables_of_the_installed_pandas_come_back_exactly(protocol: int) -> None:
    table = parse_table(pickle.dumps(FRAME, protocol=protocol), "test")
    assert list(table) == list(FRAME.columns)
    for name in ("yaw", "n", "is_on", "x"):
        np.testing.assert_array_equal(table[name], FRAME[name].to_numpy())
        assert table[name].dtype == FRAME[name].dtype
    assert table["uuid"].tolist() == ["a", "b", "c"]
    assert [table["label"][0], table["label"][2]] == ["Car", "Cones"]


class _OldFrame:
    def __getstate__(self) -> dict:
        return {"_data": _OldManager(), "_typ": "dataframe"}


class _OldManager:
    def __getstate__(self) -> tuple:
        blocks = [
            {"values": np.arange(6.0).reshape(2, 3), "mgr_locs": slice(0, 3, 2)},
            {"values": np.array([[7, 8, 9]], order="F"), "mgr_locs": slice(1, 2, 1)},
        ]
        axes = [_OldIndex(np.array(["y", "d", "x"], dtype=object)), _OldIndex(np.arange(3))]
        return (axes, [], [], {"0.14.1": {"axes": axes, "blocks": blocks}})


class _OldIndex:
    def __init__(self, data: np.ndarray) -> None:
        self.data = data

    def __reduce__(self) -> tuple:
        return _old_new_index, (_OldIndex, {"data": self.data, "name": None})


def _old_new_index() -> None: ...


_Pickler: Any = pickle._Pickler  # type: ignore[attr-defined] - unknown to the stubs


class _OldPickler(_Pickler):
    """Writes our classes under the names that they stand for."""

    dispatch = dict(_Pickler.dispatch)  # noqa: RUF012
    names = {  # noqa: RUF012
        _OldFrame: "pandas.core.frame DataFrame",
        _OldManager: "pandas.core.internals.managers BlockManager",
        _OldIndex: "pandas.core.indexes.base Index",
        _old_new_index: "pandas.core.indexes.base _new_Index",
    }

    def save_global(self, obj: Any, name: str | None = None) -> None:
        if obj not in self.names:
            super().save_global(obj, name)
            return
        module, name = self.names[obj].split()
        self.write(f"c{module}\n{name}\n".encode())
        self.memoize(obj)

    dispatch[type(_old_new_index)] = save_global


def test_tables_as_old_pandas_wrote_them() -> None:
    """The state layout of pandas < 1.3 (PandaSet's own files; test_pandaset reads real ones)."""
    stream = io.BytesIO()
    _OldPickler(stream, protocol=3).dump(_OldFrame())
    table = parse_table(stream.getvalue(), "test")
    assert {name: column.tolist() for name, column in table.items()} == {
        "y": [0.0, 1.0, 2.0],
        "d": [7, 8, 9],
        "x": [3.0, 4.0, 5.0],
    }


class _RunsCode:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple:
        return subprocess.call, (["touch", str(self.marker)],)


def test_hostile_pickles_run_nothing(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    hidden = FRAME.astype(object)
    hidden.loc[0, "uuid"] = _RunsCode(marker)
    for value in (_RunsCode(marker), [_RunsCode(marker)], hidden):
        path = tmp_path / "evil.pkl.gz"
        path.write_bytes(gzip.compress(pickle.dumps(value)))
        with pytest.raises(InputError, match=r"evil\.pkl\.gz.*its code was run.*subprocess"):
            read_table(path, ())
    assert not marker.exists()
    pickle.loads(pickle.dumps(_RunsCode(marker)))
    assert marker.exists(), "the pickle does run code in the plain unpickler"


@pytest.mark.parametrize(
    "data",
    [
        b"cbuiltins\neval\n.",
        b"cnumpy\nload\n.",
        b"cpandas\nread_pickle\n.",
        b"cpandas\nDataFrame.query\n.",
        b"(ios\nsystem\n.",
        b"\x80\x02r\xff\xff\xff\x7f.",
        b"\x80\x02cpandas\nIndex\nN}U\x04datab.",
        b"\x80\x02cpandas\nIndex\nN}U\x04dataNs\x86b.",
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\n}U\x0c__defaults__)sb.",
        b"\x80\x02N" + b"\x85" * 100_000 + b".",
        b"]" * 100_000 + b"0" * 99_999 + b".",
    ],
)
def test_no_name_or_trick_beyond_the_allow_list_works(data: bytes) -> None:
    before = dict(vars(pickle_values.Index))
    with pytest.raises(InputError):
        parse_table(data, "test")
    assert dict(vars(pickle_values.Index)) == before


def test_a_decompression_bomb_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(safe_pickle, "MAX_BYTES", 1 << 20)
    path = tmp_path / "bomb.pkl.gz"
    path.write_bytes(gzip.compress(bytes(1 << 22)))
    with pytest.raises(InputError, match=r"bomb\.pkl\.gz.*decompresses"):
        read_table(path, ())


@pytest.mark.filterwarnings("ignore:invalid escape sequence")
@settings(max_examples=300, deadline=2000)
@given(st.binary(max_size=300))
def test_arbitrary_bytes_raise_only_our_errors(data: bytes) -> None:
    with pytest.raises(LightSimError):
        parse_table(data, "test")


_VALID = [
    *(pickle.dumps(FRAME, protocol=p) for p in (2, 4, 5)),
    pickle.dumps(FRAME.astype({"label": "category", "n": "Int64"}), protocol=4),
    arrow_pickles.text_frame({"uuid": ["a", "b", "c"], "yaw": [0.5, 1.5, 2.5]}),
    arrow_pickles.frame(
        {
            "a": arrow_pickles.column(arrow_pickles.texts(["a", None, "c"], large=False)),
            "b": arrow_pickles.column(
                arrow_pickles.numbers(arrow_pickles.alias("int32"), "<i4", [1, None, 3])
            ),
        }
    ),
]
_EDITS = st.lists(
    st.tuples(st.integers(0, 10**6), st.integers(0, 255), st.sampled_from("rid")), max_size=8
)


@pytest.mark.filterwarnings("ignore:invalid escape sequence")
@settings(max_examples=500, deadline=2000)
@given(st.sampled_from(_VALID), _EDITS)
def test_mutated_tables_raise_only_our_errors(
    valid: bytes, edits: list[tuple[int, int, str]]
) -> None:
    data = bytearray(valid)
    for position, value, kind in edits:
        i = position % len(data)
        if kind == "r":
            data[i] = value
        elif kind == "i":
            data.insert(i, value)
        else:
            del data[i]
    try:
        table = parse_table(bytes(data), "test")
    except LightSimError:
        return
    assert all(isinstance(column, np.ndarray) for column in table.values())
