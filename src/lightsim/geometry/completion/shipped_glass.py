"""The shipped network that tells glass."""

from __future__ import annotations

from lightsim.geometry.completion.glass import GlassOdds

PANE_WEIGHTS = "panes-small"


def shipped_glass_odds() -> GlassOdds:
    """The package's.

    Raises:
        InputError: the weights are damaged.
    """
    from lightsim.networks.panes import PaneNetwork
    from lightsim.store.weights import load_weights

    return PaneNetwork.stored(load_weights(PANE_WEIGHTS)).odds
