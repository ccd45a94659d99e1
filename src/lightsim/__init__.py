"""LightSim: a lighting simulator for driving logs.

The functions below do what the commands of the same name do; they are loaded on first use, so
that `import lightsim` stays quick.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from lightsim.core.cores import limit_numba_threads
from lightsim.core.version import __version__

if TYPE_CHECKING:
    from lightsim.api import (
        BuildOptions,
        LogReading,
        RelightOptions,
        SimulateOptions,
        build_twin,
        load_log,
        load_twin,
        relight,
        simulate,
    )

__all__ = [
    "BuildOptions",
    "LogReading",
    "RelightOptions",
    "SimulateOptions",
    "__version__",
    "build_twin",
    "load_log",
    "load_twin",
    "relight",
    "simulate",
]

limit_numba_threads(os.environ)


def __getattr__(name: str) -> object:
    if name in __all__:
        from lightsim import api

        return getattr(api, name)
    raise AttributeError(f"module 'lightsim' has no attribute '{name}'")
