"""The twin of the paper, whose base colours keep the light of the recording."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from lightsim.build.assemble import build_twin
from lightsim.build.stages.context import Context
from lightsim.build.workspace import Workspace
from lightsim.store.twin import empty_mesh, write_twin


def make_twin(work: Workspace, _: None, folder: Path, context: Context) -> Iterable[str]:
    """Write the twin with k_d as base colour, which contains the light of the recording."""
    # k_d is already the base colour of the assets, and no unobserved occluders were inferred.
    write_twin(folder, build_twin(work.log, work.assets, work.sky), empty_mesh())
    return ("base colour is the field's k_d: shadows and light of the recording are baked in",)
