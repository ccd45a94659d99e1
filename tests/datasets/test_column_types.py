"""Tables whose columns have other types than PandaSet's: read with one meaning, or refused."""

from __future__ import annotations

import gzip
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from datasets import arrow_pickles as arrow
from datasets.mini_log import START_S, cuboid_columns, sweep_columns, write_frame, write_mini_log
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.datasets.columns import number_column, truth_column, whole_column
from lightsim.datasets.reader import read_log
from lightsim.datasets.safe_pickle import parse_table
from lightsim.errors import InputError

NAN = float("nan")
ARROW: dict[str, tuple[Any, list[Any]]] = {
    "large text": (arrow.texts(["a", "bé", ""]), ["a", "bé", ""]),
    "text": (arrow.texts(["a", None, "c"], large=False), ["a", None, "c"]),
    "text from the middle": (arrow.texts(["x", "a", None, "c"], offset=1), ["a", None, "c"]),
    "chunks": (
        arrow.arrow("chunked_array")([arrow.texts(["a", "b"]), arrow.texts(["c"])]),
        ["a", "b", "c"],
    ),
    "int64": (arrow.numbers(arrow.alias("int64"), "<i8", [1, 2, 3]), [1, 2, 3]),
    "int8 with a gap": (arrow.numbers(arrow.alias("int8"), "i1", [1, None, 3]), [1, NAN, 3]),
    "double": (arrow.numbers(arrow.alias("double"), "<f8", [0.5, None, 3]), [0.5, NAN, 3]),
    "bool": (arrow.numbers(arrow.alias("bool"), "?", [True, False, True]), [True, False, True]),
    "timestamp": (
        arrow.numbers(arrow.arrow("timestamp")("ms", "UTC"), "<i8", [1500, None, -500]),
        [1.5, NAN, -0.5],
    ),
    "null": (arrow.array(arrow.alias("null"), 3, [None]), [NAN] * 3),
    "dictionary": (
        arrow.array(
            arrow.arrow("dictionary")(arrow.alias("int32"), arrow.alias("string"), False),
            3,
            [None, arrow.buffer(np.array([1, 0, 1], "<i4").tobytes())],
            words=arrow.words(["u", "v"]),
        ),
        ["v", "u", "v"],
    ),
}


@pytest.mark.parametrize(("made", "expected"), ARROW.values(), ids=list(ARROW))
def test_arrow_columns_are_read_without_pyarrow(made: Any, expected: list[Any]) -> None:
    table = parse_table(arrow.frame({"a": arrow.column(made)}), "test")
    np.testing.assert_array_equal(table["a"], np.array(expected, dtype=table["a"].dtype))


DAMAGED = {
    "too few offsets": arrow.array(arrow.alias("string"), 9, arrow.text_parts(["a"])[1]),
    "text beyond its buffer": arrow.array(
        arrow.alias("large_string"),
        1,
        [None, arrow.buffer(np.array([0, 99]).tobytes()), arrow.buffer(b"abc")],
    ),
    "offsets that run back": arrow.array(
        arrow.alias("large_string"),
        2,
        [None, arrow.buffer(np.array([0, 3, 1]).tobytes()), arrow.buffer(b"abc")],
    ),
    "a short validity": arrow.array(
        arrow.alias("int8"), 20, [arrow.buffer(b"\1"), arrow.buffer(bytes(20))]
    ),
    "rows without end": arrow.array(arrow.alias("null"), 10**12, [None]),
    "an unknown type": arrow.array(arrow.alias("decimal128"), 0, [None, arrow.buffer(b"")]),
    "a code without a word": arrow.array(
        arrow.arrow("dictionary")(arrow.alias("int8"), arrow.alias("string"), False),
        1,
        [None, arrow.buffer(b"\7")],
        words=arrow.words(["u"]),
    ),
}


@pytest.mark.parametrize("made", DAMAGED.values(), ids=list(DAMAGED))
def test_damaged_arrow_columns_are_refused(made: Any) -> None:
    with pytest.raises(InputError, match="that no table needs"):
        parse_table(arrow.frame({"a": arrow.column(made)}), "test")


BASE = pd.DataFrame({"s": ["a", None, "c"], "x": [0.5, NAN, -1.0], "n": [1, 2, 3]})
TIMES = pd.to_datetime([1.5, None, 3.0], unit="s")
PANDAS: dict[str, tuple[Any, dict[str, list[Any]]]] = {
    "categories": (BASE.astype("category"), {"s": ["a", None, "c"], "x": [0.5, NAN, -1.0]}),
    "Int64": (BASE.astype({"n": "Int64"}), {"n": [1, 2, 3]}),
    "Int64 with a gap": (pd.DataFrame({"n": pd.array([1, None], "Int64")}), {"n": [1, NAN]}),
    "boolean": (pd.DataFrame({"b": pd.array([True, None], "boolean")}), {"b": [1, NAN]}),
    "Float64": (BASE.astype({"x": "Float64"}), {"x": [0.5, NAN, -1.0]}),
    "string": (BASE.astype({"s": "string"}), {"s": ["a", None, "c"]}),
    "times": (pd.DataFrame({"t": TIMES}), {"t": [1.5, NAN, 3.0]}),
    "times of a zone": (pd.DataFrame({"t": TIMES.tz_localize("UTC")}), {"t": [1.5, NAN, 3.0]}),
    "durations": (pd.DataFrame({"t": pd.to_timedelta([2, 3], unit="ms")}), {"t": [0.002, 0.003]}),
    "NumPy's numbers among objects": (
        pd.DataFrame({"o": np.array([np.float32(0.5), "x", pd.NA], object)}),
        {"o": [0.5, "x", None]},
    ),
    "rows by two names": (
        BASE.set_index(pd.MultiIndex.from_product([["p"], ["q", "r", "s"]])),
        {"n": [1, 2, 3]},
    ),
    "rows by time": (BASE.set_index(pd.date_range("2020", periods=3, freq="h")), {"n": [1, 2, 3]}),
    "rows by name": (BASE.set_index(pd.Index(["u", "v", "w"])), {"n": [1, 2, 3]}),
    "rows in another order": (BASE.iloc[::-1], {"n": [3, 2, 1]}),
    "columns in another order": (BASE[["n", "s", "x"]], {"n": [1, 2, 3], "x": [0.5, NAN, -1.0]}),
}


@pytest.mark.parametrize("protocol", [2, 5])
@pytest.mark.parametrize(("made", "expected"), PANDAS.values(), ids=list(PANDAS))
def test_columns_of_pandas_types(
    made: pd.DataFrame, expected: dict[str, list[Any]], protocol: int
) -> None:
    table = parse_table(pickle.dumps(made, protocol=protocol), "test")
    assert list(table) == list(made.columns)
    for name, values in expected.items():
        np.testing.assert_array_equal(table[name], np.array(values, dtype=table[name].dtype))


@pytest.mark.parametrize(
    ("made", "what"),
    [
        (BASE.set_axis(pd.MultiIndex.from_product([["g"], list("abc")]), axis=1), "column names"),
        (pd.DataFrame(np.zeros((2, 2))), "column names"),
        (BASE.assign(z=pd.arrays.SparseArray([0, 0, 1])), "SparseArray"),
        (BASE["x"], "Series"),
        ({"x": np.zeros(3)}, "a dict"),
    ],
)
def test_what_is_refused_names_what_it_found_and_what_is_needed(made: Any, what: str) -> None:
    with pytest.raises(InputError, match=rf"{what}.*columns x, n alone"):
        parse_table(pickle.dumps(made), "test", ("x", "n"))


PATH = Path("a.pkl")


@pytest.mark.parametrize(
    ("values", "numbers"),
    [
        (np.array([1.5, 2.0], np.float32), [1.5, 2.0]),
        (np.array([True, False]), [1, 0]),
        (np.array([1, 2.5, None, True], object), [1, 2.5, NAN, 1]),
    ],
)
def test_numbers_of_any_type(values: np.ndarray, numbers: list[float]) -> None:
    np.testing.assert_array_equal(number_column({"x": values}, "x", PATH), numbers)


@pytest.mark.parametrize(
    ("values", "bad"),
    [
        ([0.0, 1.0, -1.0], None),
        ([True, False, True], None),
        (np.array([0, 1, 1], np.uint8), None),
        (np.array([0, 1.0, True], object), None),
        ([0.0, NAN, 1.0], "nan in row 1"),
        ([0.0, 0.5, 1.0], "0.5 in row 1"),
        ([0.0, 1.0, np.inf], "inf in row 2"),
        ([0, 2, 1], "2 in row 1"),
        (["0", "1", "1"], "the text '0' in row 0"),
    ],
)
def test_ids_are_whole_numbers_of_any_type(values: Any, bad: str | None) -> None:
    table = {"d": np.asarray(values)}
    if bad is None:
        assert whole_column(table, "d", PATH, -1, 1).tolist() == [int(v) for v in values]
    else:
        with pytest.raises(InputError, match=f"{PATH}: the column 'd' .*{bad}"):
            whole_column(table, "d", PATH, -1, 1)


def test_truths_of_any_type() -> None:
    cells = np.array([True, 0, 1.0, "False", "true", None, NAN], object)
    for missing in (True, False):
        truths = truth_column({"b": cells}, "b", PATH, missing=missing)
        assert truths.tolist() == [True, False, True, False, True, missing, missing]
    with pytest.raises(InputError, match="'maybe' in row 0"):
        truth_column({"b": np.array(["maybe"], object)}, "b", PATH, missing=True)


def read(folder: Path) -> DrivingLog:
    return read_log(LogReading(source=str(folder)))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> DrivingLog:
    return read(write_mini_log(tmp_path_factory.mktemp("plain") / "log"))


def as_arrow(path: Path, table: dict[str, Any]) -> None:
    path.write_bytes(gzip.compress(arrow.text_frame(table)))


def as_floats(path: Path, table: dict[str, Any]) -> None:
    floats = {k: np.array(v, float) for k, v in table.items() if not isinstance(v[0], str)}
    write_frame(path, {**table, **floats})


def as_objects(path: Path, table: dict[str, Any]) -> None:
    pd.DataFrame(table).astype(object).to_pickle(path)


def as_categories(path: Path, table: dict[str, Any]) -> None:
    frame = pd.DataFrame(table)
    names = {"uuid", "label", "cuboids.sensor_id", "d", "class"} & set(frame)
    frame.astype(dict.fromkeys(names, "category")).to_pickle(path)


@pytest.mark.parametrize("write", [as_arrow, as_floats, as_objects, as_categories])
def test_a_log_of_other_types_is_the_same_log(
    tmp_path: Path, plain: DrivingLog, write: Any
) -> None:
    folder = write_mini_log(tmp_path / "log")
    for i in range(3):
        time_s, name = START_S + 0.1 * i, f"{i:02d}.pkl.gz"
        write(folder / "annotations/cuboids" / name, cuboid_columns(time_s))
        write(folder / "lidar" / name, sweep_columns(time_s))
        write(folder / "annotations/semseg" / name, {"class": np.full(400, 7)})
    log = read(folder)
    assert log.notes == plain.notes
    assert [(a.actor_id, a.label, a.is_moving) for a in log.actors] == [
        (a.actor_id, a.label, a.is_moving) for a in plain.actors
    ]
    ours, theirs = log.sweeps[1].load(), plain.sweeps[1].load()
    np.testing.assert_array_equal(ours.points_world, theirs.points_world)
    np.testing.assert_array_equal(ours.semantic_class, theirs.semantic_class)


def test_whole_floats_name_actors_as_their_numbers_do(tmp_path: Path) -> None:
    folder = write_mini_log(tmp_path / "log")
    for i in range(3):
        table = cuboid_columns(START_S + 0.1 * i)
        table |= {"uuid": [1.0, 2.0, 3.0], "cuboids.sibling_id": [NAN, 3.0, 2.0]}
        write_frame(folder / f"annotations/cuboids/{i:02d}.pkl.gz", table)
    assert [actor.actor_id for actor in read(folder).actors] == ["1", "2"]
