"""Import of optional, heavy packages: in one place, with the pip command in the error."""

from __future__ import annotations

import importlib
from types import ModuleType

from lightsim.errors import MissingDependencyError


def need(module: str, *, extra: str) -> ModuleType:
    """Import `module`, or say which extra brings it.

    Raises:
        MissingDependencyError: the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(
            f"the optional package '{module}' is not installed",
            remedy=f"Run: pip install 'lightsim[{extra}]'",
        ) from error
