"""Choice of a ray caster by name."""

from __future__ import annotations

from lightsim.core.casting import MakeCaster
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.casters.mitsuba import is_usable, mitsuba_caster_maker
from lightsim.render.options import Backend


def resolve_backend(backend: Backend) -> Backend:
    """Return the backend; "auto" becomes CUDA if Mitsuba can use it here, else Embree."""
    if backend != "auto":
        return backend
    # Mitsuba's LLVM backend is never chosen: it requires DRJIT_LIBLLVM_PATH to be set.
    return "mitsuba-cuda" if is_usable("cuda") else "embree"


def choose_caster(backend: Backend) -> MakeCaster:
    """Return the constructor of ray casters of a backend; see `resolve_backend`.

    Raises:
        InputError: this machine does not have it.
    """
    backend = resolve_backend(backend)
    if backend == "embree":
        return make_embree_caster
    return mitsuba_caster_maker("cuda" if backend == "mitsuba-cuda" else "llvm")
