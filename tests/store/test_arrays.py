from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lightsim.errors import InputError
from lightsim.store import arrays as arrays_file
from lightsim.store.arrays import load_arrays, save_arrays


@pytest.mark.parametrize("is_mapped", [False, True])
def test_round_trip(tmp_path: Path, rng: np.random.Generator, is_mapped: bool) -> None:
    arrays = {
        "a": rng.random((3, 4)).astype(np.float32),
        "mask": np.array([True, False]),
        "names": np.array(["x", "yy"]),
        "scalar": np.array(3),
        "columns": np.asfortranarray(rng.random((2, 5))),
        "none": np.zeros((0, 3)),
    }
    save_arrays(tmp_path / "a.npz", arrays)
    back = load_arrays(tmp_path / "a.npz", is_mapped=is_mapped)
    assert back.keys() == arrays.keys()
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype
        np.testing.assert_array_equal(back[name], array)
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_what_is_mapped_is_not_written_and_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    save_arrays(path, {"a": np.zeros(3)})
    load_arrays(path, is_mapped=True)["a"][0] = 1
    assert load_arrays(path)["a"].tolist() == [0, 0, 0]
    np.savez_compressed(path, a=np.zeros(3))
    with pytest.raises(InputError, match=r"a\.npz.*compressed"):
        load_arrays(path, is_mapped=True)


def test_objects_and_pickles_are_refused(tmp_path: Path) -> None:
    objects = np.array([{"a": 1}], dtype=object)
    with pytest.raises(InputError, match="Python objects"):
        save_arrays(tmp_path / "a.npz", {"o": objects})
    np.savez(tmp_path / "pickled.npz", o=objects, allow_pickle=True)
    with pytest.raises(InputError, match=r"pickled\.npz"):
        load_arrays(tmp_path / "pickled.npz")


def test_archives_that_unpack_to_far_more_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(10_000))
    assert len(load_arrays(tmp_path / "a.npz")["a"]) == 10_000
    monkeypatch.setattr(arrays_file, "_MAX_INFLATED_BYTES", 10_000)
    with pytest.raises(InputError, match=r"a\.npz.*claims to hold 0 and, compressed, 80128 bytes"):
        load_arrays(tmp_path / "a.npz")


def test_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with pytest.raises(InputError, match="cannot open"):
        load_arrays(path)
    save_arrays(path, {"a": np.arange(1000)})
    whole = path.read_bytes()
    for end in range(0, len(whole), 97):
        path.write_bytes(whole[:end])
        for is_mapped in (False, True):
            with pytest.raises(InputError, match=r"a\.npz"):
                load_arrays(path, is_mapped=is_mapped)
    damaged = bytearray(whole)
    damaged[400] ^= 255
    path.write_bytes(bytes(damaged))
    with pytest.raises(InputError, match="damaged"):
        load_arrays(path)
