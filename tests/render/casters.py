"""Ray casters that the rendering tests are run with; append a backend here to have it checked."""

from __future__ import annotations

import pytest

from lightsim.core.casting import MakeCaster
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.casters.mitsuba import MitsubaBackend, MitsubaCaster, is_usable
from lightsim.render.composite import CompositeCaster


def _one_each(meshes):
    return CompositeCaster([make_embree_caster([mesh]) for mesh in meshes])


def _mitsuba(backend: MitsubaBackend) -> MakeCaster:
    def make(meshes):
        if not is_usable(backend):
            pytest.skip(f"Mitsuba cannot use {backend} here")
        return MitsubaCaster(meshes, backend)

    return make


CASTERS = [
    pytest.param(make_embree_caster, id="embree"),
    pytest.param(_one_each, id="composite"),
    pytest.param(_mitsuba("llvm"), id="mitsuba-llvm"),
    pytest.param(_mitsuba("cuda"), id="mitsuba-cuda", marks=pytest.mark.gpu),
]
"""Each is a `core.casting.MakeCaster`."""
