"""Source files that determine the result of a stage or of a simulation.

The hash of every such file is in the key of the artefact, so a changed constant makes the artefacts
of the stages that use it stale, and no others. docs/reference/artefacts.md lists the files of each
stage.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lightsim.core.reading import OWN_DATASETS
from lightsim.store.source_hash import SourceTree, installed_sources

UNCOUNTED = {
    "lightsim.errors": "texts of errors; `need` returns an installed library or raises",
    "lightsim.progress": "progress bars",
    "lightsim.core.version": "number of the release; a record has it as package_version",
    "lightsim.core.cores": "number of threads; results do not depend on it",
    "lightsim.core.option_types": "reads the command line; the values are in the configuration",
    "lightsim.build.options": "names and ranges of options; the values are in the configuration",
    "lightsim.simulation.options": "options of simulations; the values are in the configuration",
    "lightsim.core.checks": "accepts a value unchanged or raises",
    "lightsim.store.reading": "returns the bytes of a file or raises",
    "lightsim.store.atomic": "writes files atomically",
    "lightsim.store.lock": "excludes a second process",
    "lightsim.store.artefact": "records and keys, which carry the number of their own format",
    "lightsim.store.source_hash": "computes these hashes",
    "lightsim.store.staleness": "descriptions of stale artefacts",
    "lightsim.build.sources": "this list",
}
"""Modules that do not affect results, each with the reason. They and their imports are not hashed,
so that a better error message does not make a twin stale."""
WORKSPACE = "lightsim.build.workspace"
"""Reads artefacts with the modules that wrote them. Those modules are in the key of the stage that
wrote, and that key is in the key of the stage that reads: the imports need not count again. If they
did, a change in one file format would make all stages stale."""
RECORDING = (
    "lightsim.core.kept_sweeps",
    "lightsim.datasets.fingerprint",
    "lightsim.datasets.reader",
    "lightsim.datasets.scale",
    "lightsim.datasets.selection",
    "lightsim.masks.ego_body",
    "lightsim.masks.ego_vehicle",
    # `datasets.reader` imports them by names that the walk over imports does not see.
    *(f"lightsim.datasets.{name}.log" for name in OWN_DATASETS),
)
"""Modules with which the work folder reads the recording. No stage writes the recording, so these
are in the key of the first stage, and by its key in all others."""


def stage_sources(
    make: Callable[..., Any], *, is_first: bool, tree: SourceTree | None = None
) -> dict[str, str]:
    """Return the hashes of the source files that decide the artefact of a build stage, by path.

    Args:
        make: function that fills the folder of the artefact.
        is_first: the stage reads the recording instead of other artefacts.
        tree: sources; by default the installed ones.
    """
    # Only the module of `make` is named; modules that it imports are found by the search.
    modules = [make.__module__, *(RECORDING if is_first else ())]
    return (tree or installed_sources()).hashes_of(
        modules, uncounted=UNCOUNTED, unfollowed=(WORKSPACE,)
    )


def simulation_sources(*modules: str) -> dict[str, str]:
    """Return the hashes of the source files that decide simulated frames or logs, by path.

    A simulation may run on artefacts of an older LightSim, so what reads them counts, too.

    Args:
        modules: dotted names of the modules that make the result; an extension may be in another
            package, whose modules count then, too.
    """
    # No `unfollowed`: the modules that read artefacts are followed here.
    packages = {"lightsim", *(name.split(".")[0] for name in modules)}
    return installed_sources(*sorted(packages)).hashes_of(modules, uncounted=UNCOUNTED)
