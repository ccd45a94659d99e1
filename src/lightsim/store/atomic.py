"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from lightsim.errors import InputError


@contextmanager
def whole_file(path: Path) -> Generator[Path]:
    """A temporary sibling to write to; it becomes `path` when the block ends without an error.

    The sibling keeps the suffix, by which many writers choose their format; it is removed after
    an error.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    if not path.parent.is_dir():
        raise InputError(
            "the folder to write to does not exist",
            where=path.parent,
            remedy="Create the folder first.",
        )
    try:
        yield temporary
        os.replace(temporary, path)
    except PermissionError as error:
        raise InputError(
            "the file may not be written",
            where=path,
            got=error,
            remedy="Choose a folder that you may write to.",
        ) from error
    finally:
        temporary.unlink(missing_ok=True)
