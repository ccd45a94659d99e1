"""Choice of the weights of the lighting networks: shipped ones by name, or files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lightsim.errors import ArtefactError, InputError
from lightsim.store.artefact import hash_file
from lightsim.store.weights import load_weights, read_weights

if TYPE_CHECKING:
    from torch import Tensor

SKY_WEIGHTS = "sky-small"
INPAINT_WEIGHTS = "inpaint-small"


@dataclass(frozen=True)
class LightingWeights:
    """Weights of the lighting networks: names of shipped weights, or files.

    Args:
        sky: of the sky network, in this package's form or in the published one.
        inpaint: of the panorama completion, in this package's form or in the published one.
    """

    sky: str | Path = SKY_WEIGHTS
    inpaint: str | Path = INPAINT_WEIGHTS

    @classmethod
    def chosen(
        cls, sky: Path | None, inpaint: Path | None, shipped: str = SKY_WEIGHTS
    ) -> LightingWeights:
        """Return the given files, and shipped weights for a network without a file.

        Args:
            shipped: name of the shipped weights of the sky network.
        """
        return cls(sky or shipped, inpaint or INPAINT_WEIGHTS)

    @property
    def content(self) -> dict[str, str]:
        """Names of shipped weights and hashes of files, for artefact keys.

        Keys also contain hashes of shipped weights, with those of the modules that name them.
        """
        return {"sky": _content_of(self.sky), "inpaint": _content_of(self.inpaint)}

    def check(self) -> None:
        """Raise InputError if a file is missing, damaged or of another network."""
        from lightsim.lighting.panorama.inpaint_network import InpaintGenerator
        from lightsim.lighting.sky.forms import load_sky_network

        forms = ((self.sky, load_sky_network), (self.inpaint, InpaintGenerator.from_weights))
        for weights, form in forms:
            if isinstance(weights, Path):
                try:
                    form(tensors_of(weights))
                except InputError as error:
                    raise error.at(weights) from error


def tensors_of(weights: str | Path) -> Mapping[str, Tensor]:
    """Return the tensors of shipped weights or of a file.

    Raises:
        InputError: the weights are missing, unknown or damaged.
    """
    if isinstance(weights, str):
        return load_weights(weights)
    try:
        return read_weights(weights)
    except ArtefactError as error:
        raise InputError(
            "the weights cannot be read",
            where=weights,
            got=error.got,
            expected="weights.safetensors of lightsim train",
        ) from error


def _content_of(weights: str | Path) -> str:
    if isinstance(weights, str):
        return weights
    # A missing file counts as different from that of the build.
    return hash_file(weights) if weights.is_file() else "missing"
