"""Names of the relighting methods."""

from __future__ import annotations

from typing import Literal

Method = Literal["physical", "network", "paper", "colour-transfer"]
NETWORKS: tuple[Method, ...] = ("network", "paper")
"""Methods that have weights."""
NETWORK_WEIGHTS = "relight-network"
"""Of the package, for `network`."""
