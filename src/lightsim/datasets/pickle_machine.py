"""Interpreter of the few pickle instructions that a table needs, on stand-ins only.

Python's unpickler builds any object of a file, and some operations on it never end, such as hashing
a tuple that was doubled 64 times. Here only text is hashed, nothing is compared or printed, and the
time and memory of every instruction are proportional to its length; so the cost of a file is
bounded by its size. Calls go to stand-ins, which bound the size of their results (`safe_pickle`).
"""

from __future__ import annotations

import io
import pickletools
import warnings
from collections.abc import Callable
from typing import Any

MAX_STEPS = 500_000
"""Largest number of instructions. A label file of 5,000 boxes takes some 200,000 instructions, a
sweep 500."""
# Largest number of arguments of a call, or of parts of a state: those of the dtype of times.
_MAX_ARGUMENTS = 9

_LITERALS = frozenset(
    (
        *("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE"),
        *("BINBYTES", "SHORT_BINBYTES"),
    )
)
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}


class RefusedError(Exception):
    """The pickle contains something that no table needs."""


class PickleMachine:
    """Runs one pickle of protocol 2 or later.

    Args:
        find: returns the stand-in of a module and a name, or refuses. Its `make(*arguments)`
            replaces a call, and the result accepts a state by `set_state`; both may refuse.
    """

    def __init__(self, find: Callable[[str, str], Any]) -> None:
        self._find = find
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        self._steps: dict[str, Callable[[Any], None]] = {
            "PROTO": self._ignore,
            "FRAME": self._ignore,
            "MARK": self._mark,
            "EMPTY_LIST": self._new_list,
            "EMPTY_DICT": self._new_dict,
            "BYTEARRAY8": self._bytearray,
            "TUPLE": self._tuple,
            "TUPLE1": lambda _: self._short_tuple(1),
            "TUPLE2": lambda _: self._short_tuple(2),
            "TUPLE3": lambda _: self._short_tuple(3),
            "APPEND": self._append,
            "APPENDS": self._appends,
            "SETITEM": self._set_item,
            "SETITEMS": self._set_items,
            "MEMOIZE": self._memoize,
            "BINPUT": self._put,
            "LONG_BINPUT": self._put,
            "BINGET": self._get,
            "LONG_BINGET": self._get,
            "GLOBAL": self._global,
            "STACK_GLOBAL": self._stack_global,
            "REDUCE": self._call,
            "NEWOBJ": self._call,
            "BUILD": self._build,
        }

    def run(self, data: bytes) -> Any:
        """Return the object that the pickle describes.

        Raises:
            RefusedError: it needs something that no table needs.
            ValueError, LookupError, TypeError, AttributeError: it is damaged.
        """
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python's own, of escapes in texts of protocol 0.
            return self._run(data)

    def _run(self, data: bytes) -> Any:
        for step, (opcode, argument, _) in enumerate(pickletools.genops(io.BytesIO(data))):
            if step >= MAX_STEPS:
                raise RefusedError("more objects than a table has")
            name = opcode.name
            if name in _LITERALS:
                self._stack.append(argument)
            elif name in _CONSTANTS:
                self._stack.append(_CONSTANTS[name])
            elif name in self._steps:
                self._steps[name](argument)
            elif name == "STOP":
                return self._stack.pop()
            else:
                raise RefusedError(f"the instruction {name}")
        raise ValueError("it does not end")

    def _mark(self, _: Any) -> None:
        self._marks.append(len(self._stack))

    def _since_mark(self) -> list[Any]:
        start = self._marks.pop()
        items = self._stack[start:]
        del self._stack[start:]
        return items

    def _new_list(self, _: Any) -> None:
        self._stack.append([])

    def _new_dict(self, _: Any) -> None:
        self._stack.append({})

    def _bytearray(self, argument: bytearray) -> None:
        self._stack.append(bytes(argument))

    def _tuple(self, _: Any) -> None:
        self._stack.append(tuple(self._since_mark()))

    # A slice beyond the stack is short instead of an error: hence the check of the length.
    def _short_tuple(self, size: int) -> None:
        items = tuple(self._stack[-size:])
        if len(items) != size:
            raise IndexError("the stack is empty")
        self._stack[-size:] = [items]

    def _append(self, _: Any) -> None:
        item = self._stack.pop()
        _require(self._stack[-1], list).append(item)

    def _appends(self, _: Any) -> None:
        items = self._since_mark()
        _require(self._stack[-1], list).extend(items)

    def _set_item(self, _: Any) -> None:
        value, key = self._stack.pop(), self._stack.pop()
        # Only text as a key: hashing an adversarial tuple takes exponential time.
        _require(self._stack[-1], dict)[_require(key, str)] = value

    def _set_items(self, _: Any) -> None:
        items = self._since_mark()
        table = _require(self._stack[-1], dict)
        for key, value in zip(items[::2], items[1::2], strict=True):
            table[_require(key, str)] = value

    def _memoize(self, _: Any) -> None:
        self._memo[len(self._memo)] = self._stack[-1]

    def _put(self, index: int) -> None:
        self._memo[index] = self._stack[-1]

    def _get(self, index: int) -> None:
        self._stack.append(self._memo[index])

    def _global(self, argument: str) -> None:
        module, _, name = argument.partition(" ")
        self._stack.append(self._find(module, name))

    def _stack_global(self, _: Any) -> None:
        name, module = self._stack.pop(), self._stack.pop()
        self._stack.append(self._find(_require(module, str), _require(name, str)))

    def _call(self, _: Any) -> None:
        arguments, maker = _require(self._stack.pop(), tuple), self._stack.pop()
        if len(arguments) > _MAX_ARGUMENTS:
            raise RefusedError(f"a call with {len(arguments)} arguments")
        self._stack.append(maker.make(*arguments))

    def _build(self, _: Any) -> None:
        state = self._stack.pop()
        if isinstance(state, tuple) and len(state) > _MAX_ARGUMENTS:
            raise RefusedError(f"a state of {len(state)} parts")
        self._stack[-1].set_state(state)

    def _ignore(self, _: Any) -> None: ...


def _require(value: Any, kind: type) -> Any:
    # Exactly this type, so that no subclass with other behaviour is accepted.
    if type(value) is not kind:
        raise RefusedError(f"a {type(value).__name__.strip('_')} where only a {kind.__name__} fits")
    return value
