"""Typed columns of a table: measurements, integer ids, booleans.

Exporters change types: a merge turns integers into floats, a missing cell turns booleans into
objects. Unambiguous cells are read; any other cell is an error that names the row.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int64, Shaped

from lightsim.datasets.safe_pickle import Table
from lightsim.errors import InputError

_TRUTHS = {"true": True, "false": False}


def number_column(table: Table, name: str, path: Path) -> Shaped[np.ndarray, " n"]:
    """Return a column of measurements, of the stored type or float64; missing ones are NaN.

    Raises:
        InputError: a cell is text, or not a single number.
    """
    # Numbers keep their type: a conversion of all columns would double the memory of a sweep.
    column = table[name]
    if column.dtype.kind in "fiu":
        return column
    if column.dtype.kind == "b":
        return column.astype(np.uint8)
    cells = column.tolist()
    wrong = [i for i, cell in enumerate(cells) if isinstance(cell, str)]
    if wrong:
        raise InputError(
            f"the column '{name}' does not contain numbers",
            where=path,
            got=f"the text {cells[wrong[0]]!r:.40} in row {wrong[0]}",
            expected="numbers",
            remedy=f"Convert it before writing the table: table['{name}'].astype(float)."
            if _is_number(cells[wrong[0]])
            else "Write the numbers of PandaSet's tables, such as class ids instead of names.",
        )
    try:
        return np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
    except OverflowError as error:
        raise InputError(
            f"the column '{name}' contains a number that is too large",
            where=path,
            got=error,
            expected="numbers of double precision",
        ) from error


def whole_column(
    table: Table, name: str, path: Path, least: int, most: int, meaning: str = ""
) -> Int64[np.ndarray, " n"]:
    """Return a column of integer ids, which may be stored as floats or booleans.

    Args:
        least, most: smallest and largest valid id.
        meaning: meaning of the ids, for the message.

    Raises:
        InputError: a cell is no integer, or out of range.
    """
    column = number_column(table, name, path)
    # NaN fails both comparisons and is not good.
    is_good = (column >= least) & (column <= most)
    is_good[is_good] = np.mod(column[is_good], 1) == 0
    if not is_good.all():
        row = int(np.flatnonzero(~is_good)[0])
        raise InputError(
            f"the column '{name}' contains a value that is not an id",
            where=path,
            got=f"{column[row]} in row {row}",
            expected=meaning or f"whole numbers from {least} to {most}",
            remedy="Remove the row or fill the missing number, or copy the file again from the "
            "original data set.",
        )
    return column.astype(np.int64)


def truth_column(table: Table, name: str, path: Path, *, missing: bool) -> Bool[np.ndarray, " n"]:
    """Return a column of booleans, which may be stored as numbers 0 and 1 or as text.

    Args:
        missing: value of missing cells.

    Raises:
        InputError: a cell is none of these.
    """
    truths = np.full(len(table[name]), missing)
    for row, cell in enumerate(table[name].tolist()):
        # NaN differs from itself.
        if cell is None or cell != cell:
            continue
        value = _TRUTHS.get(cell.lower()) if isinstance(cell, str) else cell
        if value not in (True, False):
            raise InputError(
                f"the column '{name}' contains a value that is neither true nor false",
                where=path,
                got=f"{cell!r:.40} in row {row}",
                expected="True or False",
            )
        truths[row] = bool(value)
    return truths


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
