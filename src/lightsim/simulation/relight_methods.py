"""Ways of relighting with what they need of a work folder."""

from __future__ import annotations

from pathlib import Path

from lightsim.errors import InputError
from lightsim.pipeline.workspace import Workspace
from lightsim.relighting.estimate import Relight
from lightsim.relighting.methods import relight_by
from lightsim.relighting.options import FIELD_WEIGHTS, SHIPPED
from lightsim.simulation.options import RelightOptions
from lightsim.store.artefact import hash_file
from lightsim.store.weights import list_weights


def relight_of(workspace: Workspace, options: RelightOptions) -> Relight:
    """The way of relighting that is asked for.

    Raises:
        InputError, ArtefactError: weights are missing or damaged, or another network's.
    """
    path = _weights_file(workspace, options)
    if options.method != "nerf-osr":
        return relight_by(options.method, path)
    assert path is not None
    from lightsim.simulation.nerf_osr import relight_by_field

    return relight_by_field(path)


def weights_hash(workspace: Workspace, options: RelightOptions) -> dict[str, str]:
    """What tells the network apart, where there is one; raises as `relight_of`."""
    path = _weights_file(workspace, options)
    if path is not None:
        return {"weights": hash_file(path)}
    if options.method in SHIPPED:
        return {"weights": " ".join(list_weights()[SHIPPED[options.method]].values())}
    return {}


def _weights_file(workspace: Workspace, options: RelightOptions) -> Path | None:
    """The file that is given, or the street's own; None for those of the package."""
    if options.method != "nerf-osr" or options.weights is not None:
        return options.weights
    path = workspace.root / FIELD_WEIGHTS
    if not path.is_file():
        raise InputError(
            "the street has no relightable field",
            where=path,
            remedy=f"Train it: lightsim train nerf-osr {workspace.root}",
        )
    return path
