"""Written tables: the same data frame in every pandas since 1.0."""

from __future__ import annotations

import gzip
import pickle
import pickletools
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from lightsim.datasets.safe_pickle import names_in, read_table
from lightsim.store.pandaset_tables import CUBOID_COLUMNS, cuboid_table, write_table
from lightsim.store.table_pickle import PORTABLE_NAMES, pickled_frame

OF_PANDASET = {
    "pandas.core.frame DataFrame",
    "pandas.core.internals.managers BlockManager",
    "pandas.core.indexes.base _new_Index",
    "pandas.core.indexes.base Index",
    "pandas.core.indexes.range RangeIndex",
    "numpy.core.multiarray _reconstruct",
    "numpy ndarray",
    "numpy dtype",
    "builtins slice",
}
"""Globals in PandaSet's own files of 2020, which pandas 0.25 to 3 load. That they exist
in pandas 1.0.5 and NumPy 1.20.3 was checked by hand once; no test repeats it."""
ROWS = [
    {"uuid": "a", "label": "Car", "yaw": 0.5, "stationary": True, "camera_used": -1},
    {"uuid": "ä", "label": None, "yaw": np.nan, "stationary": False, "camera_used": np.int64(2)},
]
TABLES: dict[str, dict[str, np.ndarray]] = {
    "sweep": {
        **{name: np.linspace(0, 1, 5) + i for i, name in enumerate("xyzit")},
        "d": np.arange(5),
    },
    "boxes": cuboid_table(ROWS, ("uuid", "label", "yaw", "stationary", "camera_used")),
    "no boxes": cuboid_table([]),
    "types": {
        f"{kind}{i}": np.arange(3).astype(kind)
        for i, kind in enumerate(("i1", "u2", "f4", ">f8", "?", "f4"))
    },
    "a row": {"class": np.array([7])},
}


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_the_installed_pandas_loads_the_same_frame(tmp_path: Path, table: dict[str, Any]) -> None:
    write_table(tmp_path / "00.pkl.gz", table, "index")
    frame = pd.read_pickle(tmp_path / "00.pkl.gz")
    assert isinstance(frame, pd.DataFrame)
    types = {name: column.dtype.newbyteorder("=") for name, column in table.items()}
    expected = pd.DataFrame(
        {name: pd.Series(c.astype(types[name]), dtype=types[name]) for name, c in table.items()},
        index=pd.RangeIndex(len(next(iter(table.values()))), name="index"),
        columns=pd.Index(list(table), dtype=object),
    )
    pd.testing.assert_frame_equal(frame, expected)
    frame["new"] = 1
    pd.testing.assert_frame_equal(pickle.loads(pickle.dumps(frame)), frame)


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_our_own_reader_loads_it(tmp_path: Path, table: dict[str, Any]) -> None:
    write_table(tmp_path / "00.pkl.gz", table)
    found = read_table(tmp_path / "00.pkl.gz", list(table))
    assert list(found) == list(table)
    for name, column in table.items():
        # By words, as NaN among objects is unequal to itself.
        assert str(found[name].tolist()) == str(column.tolist())
        assert found[name].dtype == column.dtype.newbyteorder("=")


@pytest.mark.parametrize("table", TABLES.values(), ids=list(TABLES))
def test_old_pandas_and_numpy_know_every_name(table: dict[str, Any]) -> None:
    data = pickled_frame(table, None)
    steps = list(pickletools.genops(data))
    names = {argument for step, argument, _ in steps if step.name == "GLOBAL"}
    assert names == OF_PANDASET
    assert {" ".join(name) for name in PORTABLE_NAMES} == OF_PANDASET
    assert names_in(data, "test") == PORTABLE_NAMES
    assert max(step.proto for step, _, _ in steps) <= 3, "Python 3.0 and later"
    assert not {"STACK_GLOBAL", "FRAME"} & {step.name for step, _, _ in steps}


def test_equal_tables_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_table(tmp_path / f"{name}.pkl.gz", cuboid_table(ROWS, CUBOID_COLUMNS))
    assert (tmp_path / "a.pkl.gz").read_bytes() == (tmp_path / "b.pkl.gz").read_bytes()


@pytest.mark.parametrize("cell", [b"bytes", pd.Timestamp(0), {"a": 1}, 1j])
def test_other_cells_are_a_fault(cell: Any) -> None:
    with pytest.raises(TypeError, match="cells of a table"):
        pickled_frame({"a": np.array([cell], dtype=object)}, None)


def test_tables_of_version_0_2_are_still_read(tmp_path: Path) -> None:
    """They were written by pandas itself, with texts as plain objects."""
    table = TABLES["boxes"]
    frame = pd.DataFrame({n: pd.Series(c, dtype=c.dtype) for n, c in table.items()})
    frame.columns = pd.Index(list(table), dtype=object)
    data = pickle.dumps(frame, protocol=4)
    (tmp_path / "00.pkl.gz").write_bytes(gzip.compress(data))
    assert not names_in(data, "test") <= PORTABLE_NAMES
    found = read_table(tmp_path / "00.pkl.gz", list(table))
    for name, column in table.items():
        assert str(found[name].tolist()) == str(column.tolist())
