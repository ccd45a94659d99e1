"""The network for glass that the package contains."""

from __future__ import annotations

from lightsim.geometry.completion.glass import GlassLogOdds

PANE_WEIGHTS = "panes-small"


def shipped_glass_log_odds() -> GlassLogOdds:
    """Load the package's classifier of glass.

    Raises:
        InputError: the weights are damaged.
    """
    from lightsim.networks.panes import PaneNetwork
    from lightsim.store.weights import load_weights

    return PaneNetwork.stored(load_weights(PANE_WEIGHTS)).log_odds
