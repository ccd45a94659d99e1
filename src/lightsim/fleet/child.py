"""Process of a line: `lightsim` that is killed when the process that started it ends.

Without it a killed worker would leave a command behind that holds the lock of its work folder, and
the line could not be run again.
"""

from __future__ import annotations

import ctypes
import runpy
import signal

# prctl(2): signal that the kernel sends when the parent ends.
_PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Make the kernel kill this process when its parent ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    end_with_parent()
    # By its name: this package must not import the command line above it.
    runpy.run_module("lightsim", run_name="__main__", alter_sys=True)
