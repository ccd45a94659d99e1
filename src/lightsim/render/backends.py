"""The ray casters there are, by name."""

from __future__ import annotations

from typing import Literal

from lightsim.core.casting import MakeCaster
from lightsim.render.embree import make_embree_caster
from lightsim.render.mitsuba_caster import is_usable, mitsuba_caster_maker

Backend = Literal["auto", "embree", "mitsuba-cuda", "mitsuba-llvm"]


def choose_caster(backend: Backend) -> MakeCaster:
    """The maker of ray casters of a name; "auto" takes CUDA where Mitsuba finds it, else Embree.

    Raises:
        InputError: this machine does not have it.
    """
    if backend == "embree":
        return make_embree_caster
    if backend == "auto":
        return mitsuba_caster_maker("cuda") if is_usable("cuda") else make_embree_caster
    return mitsuba_caster_maker("cuda" if backend == "mitsuba-cuda" else "llvm")
