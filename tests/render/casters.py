"""Ray casters that the rendering tests are run with; append a backend here to have it checked."""

from __future__ import annotations

import pytest

from lightsim.render.composite import CompositeCaster
from lightsim.render.embree import make_embree_caster


def _one_each(meshes):
    return CompositeCaster([make_embree_caster([mesh]) for mesh in meshes])


CASTERS = [
    pytest.param(make_embree_caster, id="embree"),
    pytest.param(_one_each, id="composite"),
]
"""Each is a `core.casting.MakeCaster`."""
