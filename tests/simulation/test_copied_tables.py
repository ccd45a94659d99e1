"""Recorded tables in a written log: their bytes where all pandas load them, else the same table."""

from __future__ import annotations

import gzip
import pickle
from pathlib import Path

import numpy as np
import pytest

from datasets import arrow_pickles
from lightsim.datasets.safe_pickle import names_in, parse_table
from lightsim.export.pandaset.log import copy_table
from lightsim.store.table_pickle import PORTABLE_NAMES, pickled_frame

TABLE = {"uuid": ["a", "b", "c"], "yaw": [0.5, 1.5, 2.5]}
PORTABLE = pickled_frame({"uuid": np.array(["a", "b"], object), "yaw": np.arange(2.0)}, "index")


@pytest.mark.parametrize("is_packed", [True, False])
def test_a_portable_table_keeps_its_bytes(tmp_path: Path, is_packed: bool) -> None:
    own, target = tmp_path / "07.pkl", tmp_path / "new" / "00.pkl.gz"
    own.write_bytes(gzip.compress(PORTABLE) if is_packed else PORTABLE)
    copy_table(own, target)
    assert gzip.decompress(target.read_bytes()) == PORTABLE
    if is_packed:
        assert target.read_bytes() == own.read_bytes()


def test_a_table_of_a_new_pandas_is_written_anew(tmp_path: Path) -> None:
    own, target = tmp_path / "07.pkl", tmp_path / "00.pkl.gz"
    own.write_bytes(arrow_pickles.text_frame(TABLE))
    copy_table(own, target)
    data = gzip.decompress(target.read_bytes())
    assert names_in(data, target) == PORTABLE_NAMES
    assert {k: v.tolist() for k, v in parse_table(data, target).items()} == TABLE
    assert pickle.loads(data).to_dict("list") == TABLE
