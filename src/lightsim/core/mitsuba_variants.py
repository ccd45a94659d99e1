"""Variants of Mitsuba 3 (interpreted, LLVM, CUDA), in the only file that imports it."""

from __future__ import annotations

import ctypes
import os
import re
import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from lightsim.errors import InputError

Variant = Literal["scalar_rgb", "llvm_ad_rgb", "cuda_ad_rgb"]
"""Mitsuba's modes: interpreted, compiled for the processor, or on CUDA."""
TracingDevice = Literal["cpu", "cuda"]
"""Value of --device: the interpreted and LLVM variants run on the processor."""

# Versions 14 to 16 cannot translate Mitsuba's kernels for every processor and end the process
# (observed on processors with AVX-512).
_MIN_LLVM = 17
# Reentrant: the sky of a scene is evaluated while the scene is rendered.
_variant_lock = threading.RLock()


def choose_variant(*, may_use_cuda: bool = True) -> Variant:
    """Return the fastest usable variant: CUDA if allowed and present, LLVM if configured.

    Mitsuba itself uses the first LLVM it finds, which may end the process. LLVM is therefore used
    only if DRJIT_LIBLLVM_PATH names version 17 or newer.
    """
    if may_use_cuda and has_cuda():
        return "cuda_ad_rgb"
    return "llvm_ad_rgb" if has_llvm() else "scalar_rgb"


def variant_on(device: TracingDevice) -> Variant:
    """Return the fastest variant of a device.

    Raises:
        InputError: there is no CUDA device.
    """
    if device == "cuda" and not has_cuda():
        raise InputError(
            "no CUDA device is available", where="--device cuda", remedy="Use --device cpu."
        )
    return choose_variant(may_use_cuda=device == "cuda")


def has_cuda() -> bool:
    """Return whether the driver finds a CUDA device."""
    # The driver itself is queried: Dr.Jit ends the process if a variant needs a device and has
    # none.
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int(0)
    return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 < count.value


def has_llvm() -> bool:
    """Return whether DRJIT_LIBLLVM_PATH names a library of version 17 or newer."""
    # File names such as libLLVM-17.so.1 or libLLVM.so.18.1; the library itself is not loaded.
    path = Path(os.environ.get("DRJIT_LIBLLVM_PATH", ""))
    version = re.search(r"LLVM(?:-|\.so\.)(\d+)", path.name)
    return path.is_file() and version is not None and int(version.group(1)) >= _MIN_LLVM


@contextmanager
def mitsuba_with(variant: Variant) -> Generator[Any]:
    """Provide Mitsuba with a variant, and restore the caller's variant afterwards.

    Only one thread at a time is inside.
    """
    # The variant is global to the process, and a caller's objects are valid in its variant only.
    with _variant_lock:
        import mitsuba

        previous = mitsuba.variant()
        if previous != variant:
            mitsuba.set_variant(variant)
        try:
            yield mitsuba
        finally:
            if previous not in (None, variant):
                mitsuba.set_variant(previous)
