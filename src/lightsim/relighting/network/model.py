"""The network of `--method network`: what physical relighting gets wrong, in log space.

A U-Net (Ronneberger et al. 2015, arXiv:1505.04597) looks at the frame at half of its working size
and predicts, for every pixel there, how the log of the physical estimate changes: a constant and a
few factors on guides that are computed at the size of the picture, as in Gharbi et al. 2017
(doi:10.1145/3072959.3073592). So the size of the picture costs little, and edges stay where the
picture has them. Besides, it says how far off it expects to be. Networks that learned from
different first weights, streets or sizes err differently where nothing tells what is right, so that
the mean of their pictures is closer to the truth than each (Hansen and Salamon 1990,
doi:10.1109/34.58871).
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
from lightsim.relighting.network.blocks import Residual, Rise, padded
from lightsim.relighting.network.features import (
    Batch,
    Unseen,
    features,
    grey,
    level,
    linear_of,
    srgb_of,
    without,
)

_FEATURES = 39
_COLOURS = 3
_LEVEL = 0.05
"""Mean of the physical estimate, of white, to which the network's own exposure brings every frame:
one that sees absolute brightness takes what is brighter than its streets for wrong."""
_LEAST_LEVEL = 1e-3
"""Of white: a frame that is black but for a few codes is not brought up to day."""
_FLOOR = 0.01
"""Of white at the network's exposure: darker pixels change by an addition rather than a factor."""
_CODE_POWER = 2.4
"""sRGB codes grow as light to one over this."""
_MOST_EXACT = 6.0
"""The expected error lies between exp of minus this, less than a code of 8 bits, and 1."""
_LARGEST = 2.5
"""Log of the largest factor."""
_SMALL_CHANGE = 0.1
"""Of the log of light, in the mean over a frame: less than this hardly shows."""


@dataclass(frozen=True)
class RelitNetConfig:
    """Size of the network."""

    widths: tuple[int, ...] = (32, 64, 96, 128)
    """Channels at a half, a quarter, ... of the working size."""
    guide_count: int = 8
    """Guides that corrections follow."""
    dropout: float = 0.1
    """Of channels, while it learns: streets are few."""
    working_columns: int = 480
    """The picture is brought to this width before the network looks at it; narrower ones stay."""
    unseen: tuple[Unseen, ...] = ()
    """What ablations leave out."""
    partners: tuple[RelitNetConfig, ...] = ()
    """Further networks, which look at the same planes, whose pictures are averaged with its."""


@dataclass(frozen=True, eq=False)
class Correction:
    """What the network found for a batch.

    Args:
        picture: linear, 1 is the camera's white; not clipped.
        log_error: natural log of the mean absolute error expected of the picture's sRGB code, at
            half of the working size.
    """

    picture: Float[Tensor, "n 3 h w"]
    log_error: Float[Tensor, "n 1 p q"]


class RelitNet(nn.Module):
    """Physical estimate and what it was made of -> a better picture."""

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
        self.up = nn.ModuleList(Rise(b, a) for a, b in reversed(list(itertools.pairwise(widths))))
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
                    "networks whose pictures are averaged look at the same planes",
                    got=partner,
                    expected=f"{config.working_columns} columns, unseen {config.unseen}",
                )
        self.partners = nn.ModuleList(RelitNet(partner) for partner in config.partners)
        # The first guess is physics.
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)  # type: ignore[arg-type]

    def alone(self) -> list[RelitNet]:
        """The networks whose pictures are averaged, each on its own."""
        first = RelitNet(replace(self.config, partners=()))
        first.load_state_dict(
            {k: v for k, v in self.state_dict().items() if not k.startswith("partners.")}
        )
        return [first, *cast(list[RelitNet], list(self.partners))]

    def forward(self, batch: Batch, working: Batch | None = None) -> Correction:
        """The batch corrected.

        Args:
            batch: planes at the size of the picture; `target_level`, where they are crops, is that
                of their whole frames (`features.level`).
            working: the same at the working size; None: the picture has it.
        """
        given, batch = batch, without(batch, self.config.unseen)
        if working is None or working is given:
            working = batch
        else:
            working = without(working, self.config.unseen)
        known = working.get("target_level")
        frame_level = level(working) if known is None else known
        exposure = _LEVEL / frame_level.clamp_min(_LEAST_LEVEL)
        floor = _FLOOR / exposure
        seen = features(working, exposure)
        guiding = seen if working is batch else features(batch, exposure)
        is_land, is_new = 1 - batch["matte"], _how_new(working, floor)
        physical = batch["target_physical"].clamp_min(0.0) + floor
        found = []
        for network in cast(list[RelitNet], [self, *self.partners]):
            change, log_error = network.look(seen, guiding)
            picture = physical * torch.exp(change * is_land * is_new) - floor
            log_error = (log_error - torch.log(exposure) / _CODE_POWER).clamp(-_MOST_EXACT, 0.0)
            found.append(Correction(picture.clamp_min(0.0), log_error))
        return found[0] if len(found) == 1 else _mean(found)

    def look(
        self, seen: Float[Tensor, "n f p q"], guiding: Float[Tensor, "n f h w"]
    ) -> tuple[Float[Tensor, "n 3 h w"], Tensor]:
        """How the log of the estimate changes, by this network alone, and the expected error's log.

        Args:
            seen: features at the working size.
            guiding: at the size of the picture.
        """
        coefficients, log_error = self._coefficients(seen)
        spread = functional.interpolate(coefficients, guiding.shape[-2:], mode="bilinear")
        constant, factors = spread[:, :_COLOURS], spread[:, _COLOURS:]
        followed = self.guide(guiding)
        change = constant + (
            factors.unflatten(1, (_COLOURS, self.config.guide_count)) * followed[:, None]
        ).sum(2)
        return _LARGEST * torch.tanh(change / _LARGEST), log_error

    def _coefficients(self, seen: Float[Tensor, "n f h w"]) -> tuple[Tensor, Tensor]:
        """Coefficients of the correction, times their confidence, and the expected error's log."""
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
        is_sure = "confidence" in self.config.unseen
        confidence = 1.0 if is_sure else torch.sigmoid(found[:, -2:-1] + 1.0)
        # Bounded, or one surprise of a likelihood ends the training.
        return found[:, :-2] * confidence, -_MOST_EXACT * torch.sigmoid(found[:, -1:])


def _mean(found: Sequence[Correction]) -> Correction:
    """Of pictures by their codes."""
    code = torch.stack([srgb_of(one.picture) for one in found]).mean(0)
    error = torch.stack([one.log_error for one in found]).exp().mean(0)
    return Correction(linear_of(code), error.log())


def _how_new(batch: Batch, floor: Float[Tensor, "n 1 1 1"]) -> Float[Tensor, "n 1 1 1"]:
    """0 under the recorded light, where the recorded picture is right and so is the physical
    estimate, which gives it back; 1 under any other: twice _SMALL_CHANGE is .98."""
    source, target = (grey(batch[f"{which}_shaded"]) for which in ("source", "target"))
    surface, axes = batch["surface"], (1, 2, 3)
    change = torch.log((target + floor) / (source + floor)).abs() * surface
    mean = change.sum(axes, keepdim=True) / surface.sum(axes, keepdim=True).clamp_min(1.0)
    return 1 - torch.exp(-((mean / _SMALL_CHANGE) ** 2))
