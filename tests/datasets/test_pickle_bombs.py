"""Small pickles that would take for ever, or all memory, each refused at once."""

from __future__ import annotations

import gzip
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest

from datasets import arrow_pickles as arrow
from datasets.test_safe_pickle import FRAME
from lightsim.datasets import pickle_machine, pickle_values, safe_pickle
from lightsim.datasets.safe_pickle import parse_table
from lightsim.errors import InputError
from limits import run_limited


def word(text: str) -> bytes:
    return b"X" + struct.pack("<I", len(text)) + text.encode()


def number(value: int) -> bytes:
    return b"\x8a\x08" + struct.pack("<q", value)


def name(module: str, attribute: str) -> bytes:
    return f"c{module}\n{attribute}\n".encode()


def dtype(code: str) -> bytes:
    return name("numpy", "dtype") + word(code) + b"\x85R(K\x03" + word("|") + b"tb"


def array(code: str, shape: tuple[int, ...], content: bytes) -> bytes:
    sizes = b"(" + b"".join(map(number, shape)) + b"t"
    empty = name("numpy.core.multiarray", "_reconstruct") + name("numpy", "ndarray") + b"\x85R"
    return empty + b"(K\x01" + sizes + dtype(code) + b"\x89" + content + b"tb"


def frame(names: bytes, blocks: bytes) -> bytes:
    """A data frame of the newer layout: column names (an array), and (values, placement) pairs."""
    axes = b"](" + name("pandas", "Index") + names + b"\x85RNe"
    manager = name("pandas.core.internals.managers", "BlockManager")
    manager += b"((" + blocks + b"t" + axes + b"tR"
    return b"\x80\x02" + name("pandas", "DataFrame") + b")\x81}" + word("_mgr") + manager + b"sb."


def doubled(start: bytes, step: bytes, count: int) -> bytes:
    return start + step * count


NO_BYTES = b"C\x00"
MANY = 200_000
TWICE = b"q\x00h\x00\x86"
"""Remembers the top of the stack and makes a pair of it with itself."""
NAMES_X = array("O8", (1,), b"](" + word("x") + b"e")
SLICE = name("builtins", "slice") + b"K\x00K\x01\x86R"
TEXT = b"X" + struct.pack("<I", 1 << 26) + b"a" * (1 << 26)
BUFFER = b"\x96" + struct.pack("<Q", 1 << 26) + bytes(1 << 26)
FROM_BUFFER = name("numpy.core.numeric", "_frombuffer") + b"q\x03"
OBJECTS = b"](" + b"N" * MANY + b"eq\x01"
LONG_STATE = b"(" + b"N" * MANY + b"tq\x01"

BOMBS: dict[str, bytes] = {
    "a doubled tuple as key": b"\x80\x02}" + doubled(b"N\x85", TWICE, 64) + b"Ns.",
    "the same by DUP": b"\x80\x02}" + doubled(b"N\x85", b"2\x86", 64) + b"Ns.",
    "a doubled list as code": b"\x80\x02"
    + name("numpy", "dtype")
    + doubled(b"]", TWICE, 64)
    + b"\x85R.",
    "a doubled tuple as global": b"\x80\x04" + doubled(b"N\x85", TWICE, 64) + b"h\x00\x93.",
    "a doubled tuple as encoding": b"\x80\x02"
    + name("_codecs", "encode")
    + word("a")
    + doubled(b"N\x85", TWICE, 64)
    + b"\x86R.",
    "names without end": frame(array("f8", (10**12, 0), NO_BYTES), b""),
    "rows without end": frame(NAMES_X, array("f8", (1, 10**12), NO_BYTES) + SLICE + b"\x86"),
    "encoded again and again": b"\x80\x02]("
    + name("_codecs", "encode")
    + b"q\x00"
    + TEXT
    + b"q\x01"
    + word("latin1")
    + b"\x86q\x02"
    + b"h\x00h\x02R" * 200
    + b"e.",
    "one buffer in many arrays": b"\x80\x05]("
    + BUFFER
    + b"q\x01"
    + dtype("i1")
    + b"q\x02"
    + FROM_BUFFER
    + (b"h\x03(h\x01h\x02" + number(64) + number(1 << 20) + b"\x86" + word("C") + b"tR") * 200
    + b"e.",
    "one list in many arrays": b"\x80\x02]("
    + OBJECTS
    + array("O8", (MANY,), b"h\x01") * 200
    + b"e.",
    "many blocks": frame(
        NAMES_X, array("f8", (1, 0), NO_BYTES) + SLICE + b"\x86q\x07" + b"h\x07" * MANY
    ),
    "many arguments again and again": b"\x80\x02]("
    + LONG_STATE
    + (name("pandas", "StringDtype") + b"h\x01R") * 2000
    + b"e.",
    "a long state again and again": b"\x80\x02]("
    + LONG_STATE
    + name("pandas.arrays", "StringArray")
    + b")R"
    + b"h\x01b" * MANY
    + b"e.",
    "steps without end": b"\x80\x02" + b"}" * 5_000_000 + b".",
    "nested without end": b"\x80\x02N" + b"\x85" * MANY + b"Nb.",
}
LONG = 2_000_000
"""Rows of the longest table."""
BYTES = np.zeros(LONG, np.int8)
ALL_NULL = arrow.array(arrow.alias("null"), LONG, [None])
SOME_NULL = arrow.array(
    arrow.alias("int8"), LONG, [arrow.buffer(bytes(LONG // 8)), arrow.buffer(bytes(LONG))]
)
NO_TEXT = [None, arrow.buffer(bytes(8 * (LONG + 1))), arrow.buffer(b"")]
EMPTY_TEXTS = arrow.array(arrow.alias("large_string"), LONG, NO_TEXT)
LONG_TEXTS = arrow.array(
    arrow.alias("string"),
    1 << 16,
    [
        None,
        arrow.buffer(np.arange((1 << 16) + 1, dtype="<i4").tobytes()),
        arrow.buffer(b"a" * (1 << 16)),
    ],
)
MASKED = arrow.Global("pandas.arrays", "IntegerArray")(state={"_data": BYTES, "_mask": BYTES == 0})
CATEGORIES = arrow.Global("pandas", "CategoricalDtype")(
    state={"categories": arrow.Global("pandas", "Index")(np.array(["a", "b"], object))}
)
CODES = arrow.Global("pandas.arrays", "Categorical")(state=(CATEGORIES, BYTES))


def repeated(made: arrow.Call, count: int = 500) -> bytes:
    """The same parts built again and again, each time by a call of its own."""
    return arrow.dumped(
        [arrow.Call(made.function, made.arguments, made.state) for _ in range(count)]
    )


BOMBS |= {
    "nothing without end": repeated(ALL_NULL),
    "a mask of Arrow again and again": repeated(SOME_NULL),
    "empty texts again and again": repeated(EMPTY_TEXTS),
    "texts again and again": repeated(LONG_TEXTS),
    "one chunk many times": arrow.dumped(arrow.arrow("chunked_array")([SOME_NULL] * 9_000)),
    "a mask of pandas again and again": repeated(MASKED),
    "categories again and again": repeated(CODES),
}
READ = """
from pathlib import Path
from lightsim.errors import InputError
from lightsim.datasets.safe_pickle import read_table
for path in sorted(Path(sys.argv[1]).iterdir()):
    try:
        read_table(path, ())
    except InputError as error:
        print(f"{path.name}: {error}")
"""


def test_bombs_are_refused_in_bounded_time_and_memory(tmp_path: Path) -> None:
    for title, data in BOMBS.items():
        (tmp_path / title).write_bytes(gzip.compress(data, 1))
    finished = run_limited(READ, tmp_path, cpu_s=20, memory_mb=1500)
    lines = finished.output.splitlines()
    assert [line.partition(":")[0] for line in lines] == sorted(BOMBS)
    assert max(map(len, lines)) < 500


def test_the_parts_make_a_table() -> None:
    """The bombs are refused for what they are, not for how they are written here."""
    values = array("f8", (1, 2), b"C\x10" + np.array([1.0, 2.0]).tobytes())
    table = parse_table(frame(NAMES_X, values + SLICE + b"\x86"), "test")
    assert table["x"].tolist() == [1.0, 2.0]


@pytest.mark.parametrize(("limit", "value"), [("MAX_ROWS", 2), ("MAX_COLUMNS", 5), ("MAX_TEXT", 3)])
def test_limits_of_a_table(monkeypatch: pytest.MonkeyPatch, limit: str, value: int) -> None:
    data = pickle.dumps(FRAME)
    parse_table(data, "test")
    module = safe_pickle if hasattr(safe_pickle, limit) else pickle_values
    monkeypatch.setattr(module, limit, value)
    with pytest.raises(InputError, match="no table needs"):
        parse_table(data, "test")


def test_limit_of_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pickle_machine, "MAX_STEPS", 50)
    with pytest.raises(InputError, match="more objects"):
        parse_table(pickle.dumps(FRAME), "test")
