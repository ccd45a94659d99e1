"""Pickles built opcode by opcode: attempts to run code, and bombs for memory and time.

Each builder gets the canary that running code would touch, and the generator for sizes. Opcodes:
Lib/pickletools.py.
"""

from __future__ import annotations

import pickle
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from .mutations import Rng, pick

_END = b"."
_PROTO = b"\x80\x04"


def _text(value: str) -> bytes:
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def _global(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def _call(module: str, name: str, *arguments: bytes) -> bytes:
    return _global(module, name) + b"(" + b"".join(arguments) + b"tR"


def _command(canary: Path) -> str:
    return f"touch {canary}"


def _python(canary: Path) -> str:
    return f"open({str(canary)!r}, 'w').close()"


def os_system(canary: Path, rng: Rng) -> bytes:
    module = pick(rng, ("os", "posix"))
    return _call(module, "system", _text(_command(canary))) + _END


def builtin_eval(canary: Path, rng: Rng) -> bytes:
    module = pick(rng, ("builtins", "__builtin__"))
    return _call(module, pick(rng, ("eval", "exec")), _text(_python(canary))) + _END


def instance_opcode(canary: Path, rng: Rng) -> bytes:
    return b"(" + _text(_command(canary)) + b"ios\nsystem\n."


def object_opcode(canary: Path, rng: Rng) -> bytes:
    return b"(" + _global("os", "system") + _text(_command(canary)) + b"o."


def stack_global(canary: Path, rng: Rng) -> bytes:
    return _PROTO + _text("os") + _text("system") + b"\x93" + _text(_command(canary)) + b"\x85R."


def dotted_name(canary: Path, rng: Rng) -> bytes:
    names = ("DataFrame.eval", "io.common.os.system", "compat.os.system")
    piece = _text("pandas") + _text(pick(rng, names)) + b"\x93"
    return _PROTO + piece + _text(_command(canary)) + b"\x85R."


def new_object(canary: Path, rng: Rng) -> bytes:
    arguments = _text("sh") + _text("-c") + _text(_command(canary))
    head = _PROTO + _global("subprocess", "Popen") + b"(](" + arguments + b"et"
    return head + pick(rng, (b"\x81", b"}\x92", b"R")) + _END


def through_numpy(canary: Path, rng: Rng) -> bytes:
    function = _global("numpy.core.multiarray", "_reconstruct")
    attack = _call("os", "system", _text(_command(canary)))
    return function + b"(" + attack + b"(I0\ntC\x01btR."


def build_on_function(canary: Path, rng: Rng) -> bytes:
    """Attributes written onto an allowed function or class."""
    name = pick(rng, (("numpy", "ndarray"), ("pandas", "DataFrame"), ("_codecs", "encode")))
    attribute = pick(rng, ("__setstate__", "__defaults__", "__call__", "function", "__class__"))
    return _global(*name) + b"}" + _text(attribute) + _global("os", "system") + b"sb."


def inside_a_table(canary: Path, rng: Rng) -> bytes:
    class Runs:
        def __reduce__(self) -> tuple:
            return eval, (_python(canary),)

    table = pd.DataFrame({"x": np.array([Runs(), 1.0], dtype=object), "y": [1.0, 2.0]})
    return pickle.dumps(table, protocol=pick(rng, (2, 3, 4, 5)))


def extension_codes(canary: Path, rng: Rng) -> bytes:
    return pick(rng, (b"\x82\x01.", b"\x83\x01\x00.", b"\x84\x01\x00\x00\x00.", b"Pname\n.", b"Q."))


def doubled_tuples(canary: Path, rng: Rng) -> bytes:
    """2^n leaves by reference: hashing, comparing or printing walks all of them."""
    body = b"N\x85" + b"2\x86" * int(rng.integers(20, 5000))
    return body + pick(rng, (b".", b"}q\x01h\x010N\x87.", b"\x85R.", b"0}" + body + b"Ns."))


def laughing_lists(canary: Path, rng: Rng) -> bytes:
    """Lists of ten times the list before."""
    piece = b"]q\x00"
    for i in range(int(rng.integers(5, 60))):
        index = bytes([i % 250])
        following = bytes([(i + 1) % 250])
        piece += b"](" + (b"h" + index) * 10 + b"eq" + following
    return piece + pick(rng, (b".", _global("pandas", "DataFrame") + b")\x81" + b"h\x00b."))


def laughing_tuples_as_keys(canary: Path, rng: Rng) -> bytes:
    piece = b")q\x00"
    for i in range(int(rng.integers(5, 60))):
        piece += b"(" + b"h" + bytes([i]) * 1 + (b"h" + bytes([i])) * 9 + b"tq" + bytes([i + 1])
    return b"}" + piece + b"Ns."


def deep_nesting(canary: Path, rng: Rng) -> bytes:
    depth = int(10 ** rng.uniform(3, 5.5))
    opening, closing = pick(rng, ((b"]", b"a"), (b"N", b"\x85"), (b"(", b"l"), (b"}N", b"s")))
    return opening * depth + closing * (depth - 1) + _END


def deep_tuple_as_key(canary: Path, rng: Rng) -> bytes:
    return b"}N" + b"\x85" * int(10 ** rng.uniform(3, 5.5)) + b"Ns."


def many_opcodes(canary: Path, rng: Rng) -> bytes:
    piece = pick(rng, (b"N0", b"N", b"]0", b"}", b"K\x010", b"(0", b"I1\n0"))
    return piece * int(10 ** rng.uniform(5, 7)) + b"N."


def huge_memo(canary: Path, rng: Rng) -> bytes:
    index = pick(rng, (1 << 20, 1 << 24, (1 << 31) - 1, (1 << 32) - 1))
    one = b"r" + struct.pack("<I", index)
    return (
        b"\x80\x02"
        + pick(rng, (b"N" + one, f"Np{index}\n".encode(), f"Np{'9' * 30}\n".encode()))
        + _END
    )


def _array_state(shape: bytes, dtype: str, data: bytes) -> bytes:
    """A numpy array by `_reconstruct` and a state."""
    head = _call(
        "numpy.core.multiarray",
        "_reconstruct",
        _global("numpy", "ndarray"),
        b"K\x00\x85",
        b"C\x01b",
    )
    kind = _call("numpy", "dtype", _text(dtype), b"\x89", b"\x88")
    order = pick_order(dtype)
    kind += b"(K\x03" + order + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    return head + b"(K\x01" + shape + kind + b"\x89" + data + b"tb"


def pick_order(dtype: str) -> bytes:
    return _text("|" if dtype.startswith(("O", "b", "S")) else "<")


def huge_shape(canary: Path, rng: Rng) -> bytes:
    number = pick(rng, (1 << 30, 1 << 40, 1 << 62, -1, 0))
    size = b"\x8a\x09" + number.to_bytes(9, "little", signed=True)
    shape = pick(rng, (size + b"\x85", size + size + b"\x86", b"K\x00" + size + b"\x86"))
    dtype = pick(
        rng, ("f8", "O8", "i8", "O", "S99999999", "V99999999", "U9999999", "M8", "f99", "b1")
    )
    data = pick(rng, (b"C\x08abcdefgh", b"]", b"C\x00", b"N"))
    return _PROTO + _array_state(shape, dtype, data) + _END


def huge_length(canary: Path, rng: Rng) -> bytes:
    """A string that claims more bytes than the file has."""
    head = pick(rng, (b"X", b"B", b"T"))
    size = pick(rng, (0x7FFFFFFF, 0xFFFFFFFF, 0x10000000))
    big = pick(rng, (b"\x8d", b"\x8e", b"\x96", b"\x95"))
    if rng.random() < 0.5:
        return (
            _PROTO + big + struct.pack("<Q", pick(rng, (1 << 31, 1 << 40, (1 << 63) - 1))) + b"ab."
        )
    return _PROTO + head + struct.pack("<I", size) + b"ab."


def repeated_encode(canary: Path, rng: Rng) -> bytes:
    """One long text, encoded to fresh bytes again and again."""
    text = _text("é" * int(10 ** rng.uniform(5, 6.7)))
    once = _global("_codecs", "encode") + b"h\x01" + _text("latin1") + b"\x86R"
    return _PROTO + text + b"q\x010](" + once * int(10 ** rng.uniform(1, 4)) + b"e."


def repeated_arrays(canary: Path, rng: Rng) -> bytes:
    """One buffer, copied into fresh arrays again and again."""
    count = int(10 ** rng.uniform(5, 6.8)) // 8 * 8
    buffer = pick(rng, (b"B", b"\x96"))
    length = struct.pack("<I" if buffer == b"B" else "<Q", count)
    kind = _call("numpy", "dtype", _text("f8"), b"\x89", b"\x88")
    one = (
        _global("numpy._core.numeric", "_frombuffer") + b"(h\x01h\x02"
        + b"J" + struct.pack("<i", count // 8) + b"\x85" + _text(pick(rng, ("C", "F"))) + b"tR"
    )  # fmt: skip
    head = _PROTO + buffer + length + b"\0" * count + b"q\x010" + kind + b"q\x020"
    return head + b"](" + one * int(10 ** rng.uniform(1, 4)) + b"e."


def repeated_object_arrays(canary: Path, rng: Rng) -> bytes:
    """One list, copied into fresh object arrays."""
    count = int(10 ** rng.uniform(4, 5.7))
    head = _PROTO + b"](" + b"N" * count + b"eq\x010"
    shape = b"J" + struct.pack("<i", count) + b"\x85"
    one = _array_state(shape, "O8", b"h\x01")
    return head + b"](" + one * int(10 ** rng.uniform(1, 3.5)) + b"e."


def big_integers(canary: Path, rng: Rng) -> bytes:
    way = int(rng.integers(3))
    if way == 0:
        size = int(10 ** rng.uniform(3, 6.5))
        return _PROTO + b"\x8b" + struct.pack("<i", size) + b"\x7f" * size + _END
    if way == 1:
        return b"L" + b"9" * int(10 ** rng.uniform(3, 6)) + b"L\n."
    return b"I" + b"9" * int(10 ** rng.uniform(3, 6)) + b"\n."


def _frame(blocks: bytes, axes: bytes) -> bytes:
    manager = _call("pandas.core.internals.managers", "BlockManager", blocks, axes)
    return _PROTO + _global("pandas", "DataFrame") + b")\x81}" + _text("_mgr") + manager + b"sb."


def _block(canary: Path, rng: Rng, names: list[str]) -> bytes:
    """A block of one row each, with a placement that may be anything."""
    array = _array_state(b"K\x01K\x01\x86", "f8", b"C\x08abcdefgh")
    number = pick(rng, (0, 1, 1 << 30, (1 << 31) - 1))
    bound = b"J" + struct.pack("<i", number)
    placement = pick(
        rng,
        (
            _call("builtins", "slice", b"K\x00", b"K\x01", b"K\x01"),
            _call("builtins", "slice", b"K\x00", bound, b"K\x01"),
            _call("builtins", "slice", b"N", b"N", b"N"),
            _call("builtins", "slice", _text("a"), b"]", b"K\x00"),
            _array_state(b"K\x01\x85", "i8", b"C\x08" + struct.pack("<q", number)),
            b"N",
            b"]",
        ),
    )
    return _call("pandas._libs.internals", "_unpickle_block", array, placement, b"K\x02")


def strange_frames(canary: Path, rng: Rng) -> bytes:
    count = int(10 ** rng.uniform(0, 3.5))
    one = _block(canary, rng, [])
    blocks = b"(" + one * count + b"t"
    names = b"".join(_text(pick(rng, ("x", "y", "", "z" * 5000))) for _ in range(3))
    name_list = b"](" + names * int(10 ** rng.uniform(0, 3)) + b"e"
    shape = b"K\x03\x85"
    index = _call(
        "pandas.core.indexes.base", "_new_Index", _global("pandas", "Index"),
        b"}" + _text("data") + _array_state(shape, "O8", name_list) + b"s",
    )  # fmt: skip
    axes = pick(rng, (b"](" + index + b"Ne", b"](" + index + index + b"e", b"]", b"N", index))
    return _frame(pick(rng, (blocks, blocks, b"N", b"](Ne", one)), axes)


def self_reference(canary: Path, rng: Rng) -> bytes:
    """A list, dict or frame that holds itself."""
    table = _PROTO + _global("pandas", "DataFrame") + b")\x81q\x01}" + _text("_mgr") + b"h\x01sb."
    return pick(
        rng, (b"]q\x01h\x01a.", b"}q\x01Nh\x01s.", b"(]q\x01tq\x02h\x01h\x02a0h\x02.", table)
    )


def bad_escapes(canary: Path, rng: Rng) -> bytes:
    return pick(
        rng,
        (b"S'\\q\\x'\n.", b"S'\\", b"V\\ud800\\uZZ\n.", b"F1_0_\n.", b"I01\n0I0_1\n.", b"Snan\n."),
    )


BUILDERS: tuple[Callable[[Path, Rng], bytes], ...] = (
    os_system, builtin_eval, instance_opcode, object_opcode, stack_global, dotted_name, new_object,
    through_numpy, build_on_function, inside_a_table, extension_codes, doubled_tuples,
    laughing_lists, laughing_tuples_as_keys, deep_nesting, deep_tuple_as_key, many_opcodes,
    huge_memo, huge_shape, huge_length, repeated_encode, repeated_arrays, repeated_object_arrays,
    big_integers, strange_frames, self_reference, bad_escapes,
)  # fmt: skip
RUNS_CODE = (
    os_system, builtin_eval, instance_opcode, object_opcode, stack_global,
    through_numpy, inside_a_table,
)  # fmt: skip
"""Those that do run code in the plain unpickler."""
