"""Relighting method of a command, with its weights."""

from __future__ import annotations

from pathlib import Path

from lightsim.build.workspace import Workspace
from lightsim.errors import InputError
from lightsim.relighting.estimate import Relight
from lightsim.relighting.methods import find_method, relight_by
from lightsim.simulation.options import RelightOptions
from lightsim.store.artefact import hash_file
from lightsim.store.weights import list_weights


def relight_of(workspace: Workspace, options: RelightOptions) -> Relight:
    """Return the function that relights one frame by the chosen method.

    Raises:
        InputError, ArtefactError: weights are missing or damaged, or belong to another network.
    """
    return relight_by(options.method, _weights_file(workspace, options))


def weights_hash(workspace: Workspace, options: RelightOptions) -> dict[str, str]:
    """Return the hash of the method's weights, empty without weights; raises as `relight_of`."""
    method, path = find_method(options.method), _weights_file(workspace, options)
    if path is not None:
        return {"weights": hash_file(path)}
    # Shipped weights are listed in a manifest with their hashes, so the files need not be read.
    if method.weights_name:
        files = list_weights(method.weights_folder)[method.weights_name]
        return {"weights": " ".join(files.values())}
    return {}


def _weights_file(workspace: Workspace, options: RelightOptions) -> Path | None:
    """Return the weights file of the command or of the work folder; None for shipped weights."""
    method = find_method(options.method)
    if options.weights is not None or not method.weights_in_work:
        return options.weights
    # Some methods are trained on each log: their weights are part of the work folder.
    path = workspace.root / method.weights_in_work
    if not path.is_file():
        raise InputError(
            f"this log has no weights of --method {options.method}",
            where=path,
            expected="a weights file",
            remedy=f"Train it: {method.train_command} {workspace.root}",
        )
    return path
