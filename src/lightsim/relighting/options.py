"""Names of the relighting methods."""

from __future__ import annotations

from typing import Literal

Method = Literal["physical", "network", "paper", "colour-transfer"]
