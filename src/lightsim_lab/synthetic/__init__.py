"""Procedural streets with exact ground truth, in PandaSet's layout (docs/guides/synthetic.md)."""

from __future__ import annotations

from pathlib import Path

from lightsim.errors import InputError
from lightsim_lab.synthetic.edit_truth import synthesize_edits
from lightsim_lab.synthetic.generate import synthesize
from lightsim_lab.synthetic.plan import Size

__all__ = ["Size", "shipped_street", "synthesize", "synthesize_edits"]


def shipped_street() -> Path:
    """Return the folder (log/ and truth/) of the built-in street: seed 0, size small.

    Raises:
        InputError: the installation has no such folder.
    """
    path = Path(__file__).resolve().parents[1] / "data" / "street"
    if not (path / "log" / "camera").is_dir():
        raise InputError(
            "the built-in street is missing from this installation",
            where=path,
            remedy="Install LightSim again, or make it: lightsim synthesize --seed 0 --out DIR.",
        )
    return path
