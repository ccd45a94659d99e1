"""The network of `--method network`: a correction of the physical estimate, in log space.

A U-Net (Ronneberger et al. 2015, arXiv:1505.04597) processes the frame at half of its working size
and predicts, for every pixel there, the change of the log of the physical estimate: a constant and
a few factors on guides that are computed at the size of the picture, as in Gharbi et al. 2017
(doi:10.1145/3072959.3073592). The cost therefore hardly depends on the size of the picture, and
edges stay in place. The network also predicts its own error. Networks trained with different
initial weights, streets or sizes have different errors where the input is ambiguous, so the mean of
an ensemble is more accurate than each member (Hansen and Salamon 1990, doi:10.1109/34.58871).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.errors import InputError
from lightsim.relighting.network.blocks import Residual, UpBlock, padded
from lightsim.relighting.network.channels import OF_SKIES
from lightsim.relighting.network.features import (
    Batch,
    RemovedInput,
    features,
    grey,
    level,
    linear_of,
    srgb_of,
    without,
)

# Channels of `features`.
_FEATURES = 39
# Colour channels of the correction.
_COLOURS = 3

# Chosen on synthetic streets; sensitivity not measured, unless stated.

# Mean of the physical estimate, as a fraction of white, to which the network's input is exposed.
# With absolute brightness as an input, corrections failed on frames brighter than in training.
_MEAN_LEVEL = 0.05
# Lower limit of a frame's mean for that exposure, as a fraction of white, so that almost black
# frames are not amplified to daylight.
_MIN_LEVEL = 1e-3
# Radiance, as a fraction of white at the network's exposure, below which the correction acts as an
# addition rather than a factor.
_FLOOR = 0.01

# The expected error lies between exp(-_LOG_ERROR_RANGE), below one 8-bit code, and 1.
_LOG_ERROR_RANGE = 6.0
# Number of rows whose guides are computed together. For a width of 960 pixels, bands of 30 rows
# take half the time of the whole picture; other sizes are not measured.
_BAND_ROWS = 30
# Log of the largest correction factor.
_MAX_LOG_FACTOR = 2.5
# Mean change of the log of light over a frame below which the correction fades out: smaller changes
# are hardly visible.
_SMALL_CHANGE = 0.1


@dataclass(frozen=True)
class RelitNetConfig:
    """Size of the network."""

    widths: tuple[int, ...] = (32, 64, 96, 128)
    """Channels at a half, a quarter, ... of the working size."""
    guide_count: int = 8
    """Number of guides that corrections follow."""
    dropout: float = 0.1
    """Fraction of channels dropped in training, because the training streets are few."""
    working_columns: int = 480
    """Width to which wider pictures are reduced before the network."""
    unseen: tuple[RemovedInput, ...] = ()
    """Inputs that ablations remove."""
    partners: tuple[RelitNetConfig, ...] = ()
    """Further networks with the same inputs, whose pictures are averaged with this one's."""


@dataclass(frozen=True, eq=False)
class Correction:
    """Output of the network for a batch.

    Args:
        picture: linear, 1 is the camera's white; not clipped.
        log_error: natural log of the expected mean absolute error of the picture's sRGB code, at
            half of the working size.
    """

    picture: Float[Tensor, "n 3 h w"]
    log_error: Float[Tensor, "n 1 p q"]


class RelitNet(nn.Module):
    """Network that corrects the physical estimate, given the estimate and its inputs."""

    def __init__(self, config: RelitNetConfig) -> None:
        super().__init__()
        self.config = config
        widths = config.widths
        self.stem = nn.Sequential(
            nn.PixelUnshuffle(2), nn.Conv2d(4 * _FEATURES, widths[0], 1), Residual(widths[0])
        )
        self.down = nn.ModuleList(
            nn.Sequential(nn.Conv2d(a, b, 3, 2, 1), Residual(b), Residual(b))
            for a, b in itertools.pairwise(widths)
        )
        self.up = nn.ModuleList(
            UpBlock(b, a) for a, b in reversed(list(itertools.pairwise(widths)))
        )
        outputs = _COLOURS * (1 + config.guide_count) + 2
        self.head = nn.Conv2d(widths[0], outputs, 3, padding=1)
        self.guide = nn.Sequential(
            nn.Conv2d(_FEATURES, 32, 1),
            nn.SiLU(),
            nn.Dropout2d(config.dropout),
            nn.Conv2d(32, config.guide_count, 1),
            nn.Tanh(),
        )
        self.drop = nn.Dropout2d(config.dropout)
        for partner in config.partners:
            mine = (config.unseen, config.working_columns)
            if (partner.unseen, partner.working_columns) != mine:
                raise InputError(
                    "networks whose pictures are averaged must have the same inputs",
                    got=partner,
                    expected=f"{config.working_columns} columns, unseen {config.unseen}",
                )
        self.partners = nn.ModuleList(RelitNet(partner) for partner in config.partners)
        # With zero weights the untrained network returns the physical estimate.
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def alone(self) -> list[RelitNet]:
        """Return the members of the ensemble as single networks."""
        first = RelitNet(replace(self.config, partners=()))
        first.load_state_dict(
            {k: v for k, v in self.state_dict().items() if not k.startswith("partners.")}
        )
        return [first, *cast(list[RelitNet], list(self.partners))]

    def forward(self, batch: Batch, working: Batch | None = None) -> Correction:
        """Correct the batch.

        Args:
            batch: planes at the size of the picture; if they are crops, `target_level` is the level
                of the whole frames (`features.level`).
            working: the planes at the working size; None if the picture has that size.
        """
        given, batch = batch, without(batch, self.config.unseen)
        if working is None or working is given:
            working = batch
        else:
            working = without(working, self.config.unseen)
        known = working.get("target_level")
        frame_level = level(working) if known is None else known
        exposure = _MEAN_LEVEL / frame_level.clamp_min(_MIN_LEVEL)
        floor = _FLOOR / exposure
        seen = features(working, exposure)
        networks = cast(list[RelitNet], [self, *self.partners])
        guides = self._guides(networks, batch, exposure, seen if working is batch else None)
        is_land, is_new = 1 - batch["matte"], _change_weight(working, floor)
        physical = batch["target_physical"].clamp_min(0.0) + floor
        found = []
        for network, guide in zip(networks, guides, strict=True):
            change, log_error = network.predict_correction(seen, guide)
            picture = physical * torch.exp(change * is_land * is_new) - floor
            # sRGB codes are about proportional to light to the power of 1 / 2.4.
            log_error = (log_error - torch.log(exposure) / 2.4).clamp(-_LOG_ERROR_RANGE, 0.0)
            found.append(Correction(picture.clamp_min(0.0), log_error))
        return found[0] if len(found) == 1 else _mean(found)

    def _guides(
        self,
        networks: Sequence[RelitNet],
        batch: Batch,
        exposure: Float[Tensor, "n 1 1 1"],
        known: Float[Tensor, "n f h w"] | None,
    ) -> list[Float[Tensor, "n g h w"]]:
        """Return the guides of each network at the size of the picture.

        Args:
            known: features at that size; None: they are computed.
        """
        # In training all rows belong to one band, because dropout drops whole channels. Otherwise
        # a band's features fit into a processor's cache, which halves the time.
        height, is_whole = batch["matte"].shape[-2], self.training or batch["matte"].is_cuda
        rows = height if is_whole else _BAND_ROWS
        found = []
        for start in range(0, height, rows):
            band = slice(start, start + rows)
            if known is not None:
                guiding = known[..., band, :]
            else:
                planes = {k: v[..., band, :] for k, v in batch.items() if not k.endswith(OF_SKIES)}
                guiding = features(planes, exposure)
            found.append([network.guide(guiding) for network in networks])
        return [torch.cat(bands, dim=-2) for bands in zip(*found, strict=True)]

    def predict_correction(
        self, seen: Float[Tensor, "n f p q"], guides: Float[Tensor, "n g h w"]
    ) -> tuple[Float[Tensor, "n 3 h w"], Tensor]:
        """Return the log radiance correction of this network alone, and its log expected error.

        Args:
            seen: the frame's features at the working size.
            guides: guides at the size of the picture.
        """
        coefficients, log_error = self._coefficients(seen)
        wide = functional.interpolate(coefficients, guides.shape[-2:], mode="bilinear")
        constant, factors = wide[:, :_COLOURS], wide[:, _COLOURS:]
        factors = factors.unflatten(1, (_COLOURS, self.config.guide_count))
        # Guides are processed one by one: the product of all would be the largest array.
        change = factors[:, :, 0] * guides[:, None, 0]
        for k in range(1, self.config.guide_count):
            change = change + factors[:, :, k] * guides[:, None, k]
        change = constant + change
        return _MAX_LOG_FACTOR * torch.tanh(change / _MAX_LOG_FACTOR), log_error

    def _coefficients(self, seen: Float[Tensor, "n f h w"]) -> tuple[Tensor, Tensor]:
        """Return the coefficients of the correction times their confidence, and the log of the
        expected error."""
        x, size = padded(seen, 2 ** len(self.config.widths))
        x = self.stem(x)
        levels = [x]
        for step in self.down:
            levels.append(step(levels[-1]))
        x = levels.pop()
        x = self.drop(x)
        for step in self.up:
            x = step(x, levels.pop())
        found = self.head(x)[..., : (size[0] + 1) // 2, : (size[1] + 1) // 2]
        is_fixed = "confidence" in self.config.unseen
        confidence = 1.0 if is_fixed else torch.sigmoid(found[:, -2:-1] + 1.0)
        # Bounded, because a single improbable pixel would otherwise make the likelihood diverge.
        return found[:, :-2] * confidence, -_LOG_ERROR_RANGE * torch.sigmoid(found[:, -1:])


def _mean(found: Sequence[Correction]) -> Correction:
    """Return the mean of several corrections: of pictures in sRGB codes, and of expected errors."""
    code = torch.stack([srgb_of(one.picture) for one in found]).mean(0)
    error = torch.stack([one.log_error for one in found]).exp().mean(0)
    return Correction(linear_of(code), error.log())


def _change_weight(batch: Batch, floor: Float[Tensor, "n 1 1 1"]) -> Float[Tensor, "n 1 1 1"]:
    """Return the weight of the correction: 0 under the recorded light, 1 under other light.

    Under the recorded light the physical estimate equals the recorded picture. At twice
    _SMALL_CHANGE the weight is 0.98.
    """
    source, target = (grey(batch[f"{which}_shaded"]) for which in ("source", "target"))
    surface, axes = batch["surface"], (1, 2, 3)
    change = torch.log((target + floor) / (source + floor)).abs() * surface
    mean = change.sum(axes, keepdim=True) / surface.sum(axes, keepdim=True).clamp_min(1.0)
    return 1 - torch.exp(-((mean / _SMALL_CHANGE) ** 2))
