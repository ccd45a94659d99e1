"""Types of options, for Python and the command line alike."""

from __future__ import annotations

from typing import Annotated

from tyro.constructors import PrimitiveConstructorSpec


def _parse(words: list[str]) -> tuple[str, ...]:
    return tuple(part.strip() for part in words[0].split(",") if part.strip())


Names = Annotated[
    tuple[str, ...],
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="A,B,...",
        instance_from_str=_parse,
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(value)],
    ),
]
"""Several names: a tuple in Python, "a,b" on the command line."""
