"""DeepFill v2 on panoramas: a coarse and a refining generator of gated convolutions, and the
spectrally normalised patch discriminator.

Yu et al., Free-Form Image Inpainting with Gated Convolution, ICCV 2019,
doi:10.1109/ICCV.2019.00457. Padding follows the sphere, and the only position input is the
elevation, so the networks are equivariant to rotations in azimuth.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm

from lightsim.errors import InputError
from lightsim.lighting.panorama.attention_network import contextual_attention, pad_sphere
from lightsim.lighting.sky.panorama_layers import filled

# Panorama sizes must be multiples of this: encoder stride 4, times MATCH_STRIDE of the attention.
TOTAL_STRIDE = 8
# Input channels: RGB, hole mask, elevation.
_INPUTS = 5


class GatedConvolution(nn.Module):
    """ELU(features) x sigmoid(gate), both convolutions of the input."""

    def __init__(
        self, inputs: int, outputs: int, size: int = 3, *, stride: int = 1, dilation: int = 1
    ) -> None:
        super().__init__()
        self.padding = dilation * (size // 2)
        self.convolution = nn.Conv2d(inputs, 2 * outputs, size, stride=stride, dilation=dilation)

        deviation = self.convolution.weight[0].numel() ** -0.5
        # A gain of 2.4 compensates an ELU times a gate of about one half. With the usual gain of 1
        # every layer would halve the signal, and deep layers would not learn.
        nn.init.normal_(self.convolution.weight[:outputs], 0.0, 2.4 * deviation)
        nn.init.normal_(self.convolution.weight[outputs:], 0.0, deviation)
        nn.init.constant_(self.convolution.bias, 0.0)  # type: ignore[arg-type]

    def forward(self, x: Float[Tensor, "n _ _ _"]) -> Float[Tensor, "n _ _ _"]:
        """Map [n, inputs, h, w] to [n, outputs, h / stride, w / stride], padded on the sphere."""
        features, gate = self.convolution(pad_sphere(x, self.padding)).chunk(2, dim=1)
        return functional.elu(features) * torch.sigmoid(gate)


class _Output(nn.Module):
    """Plain convolution to RGB."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, 3, 3)
        # A small gain (0.1), so that training starts near the smooth fill.
        deviation = 0.1 * (9 * inputs) ** -0.5
        nn.init.normal_(self.convolution.weight, 0.0, deviation)

    def forward(self, x: Float[Tensor, "n _ h w"]) -> Float[Tensor, "n 3 h w"]:
        """Map features to RGB of the same size, padded as on the sphere."""
        return self.convolution(pad_sphere(x, 1))


def _encoder(width: int) -> list[nn.Module]:
    """Layers that reduce to a quarter of the size, with four times the channels."""
    return [
        GatedConvolution(_INPUTS, width, 5),
        GatedConvolution(width, 2 * width, stride=2),
        GatedConvolution(2 * width, 2 * width),
        GatedConvolution(2 * width, 4 * width, stride=2),
        GatedConvolution(4 * width, 4 * width),
    ]


def _decoder(inputs: int, width: int) -> list[nn.Module]:
    """Layers that enlarge a quarter of the size to full-size RGB."""
    return [
        GatedConvolution(inputs, 4 * width),
        nn.Upsample(scale_factor=2),
        GatedConvolution(4 * width, 2 * width),
        GatedConvolution(2 * width, 2 * width),
        nn.Upsample(scale_factor=2),
        GatedConvolution(2 * width, width),
        GatedConvolution(width, max(width // 2, 1)),
        _Output(max(width // 2, 1)),
    ]


def _dilated(width: int, dilations: tuple[int, ...]) -> list[nn.Module]:
    return [GatedConvolution(4 * width, 4 * width, dilation=dilation) for dilation in dilations]


class InpaintGenerator(nn.Module):
    """Generator in two stages; the second has a branch of dilated convolutions and one of
    attention.

    Args:
        width: channels at the full resolution; deeper layers have up to four times as many.
        height_px: rows of the panoramas that it is trained for (stored with the weights).
        dilations: dilations of the layers at a quarter of the size, at most height_px / 4.
        propagates: the attention averages its scores over neighbouring patches.
        is_residual: holes start as a smooth continuation of the known pixels, and each stage adds
            to its input; otherwise holes start grey and each stage predicts colours, as published.
    """

    def __init__(
        self,
        width: int,
        height_px: int,
        dilations: tuple[int, ...] = (2, 4, 8, 16),
        *,
        propagates: bool = False,
        is_residual: bool = True,
    ) -> None:
        super().__init__()
        self.coarse = nn.Sequential(
            *_encoder(width), *_dilated(width, dilations), *_decoder(4 * width, width)
        )
        self.refining = nn.Sequential(*_encoder(width), *_dilated(width, dilations))
        self.matching = nn.Sequential(*_encoder(width), GatedConvolution(4 * width, 4 * width))
        self.copied = nn.Sequential(
            GatedConvolution(4 * width, 4 * width), GatedConvolution(4 * width, 4 * width)
        )
        self.decoder = nn.Sequential(*_decoder(8 * width, width))
        self.height_px: Tensor
        self.dilations: Tensor
        self.options: Tensor
        self.register_buffer("height_px", torch.tensor(float(height_px)))
        self.register_buffer("dilations", torch.tensor([float(d) for d in dilations]))
        self.register_buffer("options", torch.tensor([float(propagates), float(is_residual)]))
        self._propagates = propagates
        self._is_residual = is_residual

    @classmethod
    def from_weights(cls, weights: Mapping[str, Tensor]) -> InpaintGenerator:
        """Return the generator of a stored `state_dict`; the tensors hold shape and working size.

        Raises:
            InputError: the tensors are those of another network.
        """
        try:
            generator = cls(
                weights["coarse.0.convolution.weight"].shape[0] // 2,
                int(weights["height_px"]),
                tuple(int(d) for d in weights["dilations"]),
                propagates=bool(weights["options"][0]),
                is_residual=bool(weights["options"][1]),
            )
            generator.load_state_dict({name: value.float() for name, value in weights.items()})
        # PyTorch reports tensors of other names or shapes as RuntimeError.
        except (KeyError, IndexError, ValueError, RuntimeError) as error:
            raise InputError(
                "the weights are not those of the panorama completion",
                got=f"{type(error).__name__}: {error}"[:120],
                remedy="Give weights.safetensors of lightsim train inpaint.",
            ) from error
        return generator.eval()

    def forward(
        self, image: Float[Tensor, "n 3 h w"], hole: Float[Tensor, "n 1 h w"]
    ) -> tuple[Float[Tensor, "n 3 h w"], Float[Tensor, "n 3 h w"]]:
        """Return the coarse and the refined picture, values about -1 to 1 as `image`, observed
        pixels included.

        Values of `image` inside the holes are ignored.
        """
        known = image * (1 - hole)
        elevation = elevation_map(image)
        start = filled(known, 1 - hole) if self._is_residual else known
        coarse = self.coarse(torch.cat([start, hole, elevation], 1)).float()
        coarse = start + coarse if self._is_residual else coarse
        merged = known + coarse * hole
        x = torch.cat([merged, hole, elevation], 1)
        small = functional.max_pool2d(hole, 4)
        matched = contextual_attention(self.matching(x).float(), small, propagates=self._propagates)
        features = torch.cat([self.refining(x), self.copied(matched)], 1)
        refined = self.decoder(features).float()
        return coarse, merged + refined if self._is_residual else refined


class PatchDiscriminator(nn.Module):
    """SN-PatchGAN: one score for every position and channel of the last, small feature map.

    Args:
        width: channels of the first of `layers` layers; from the third on, four times as many.
    """

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        outputs = [width * min(2**i, 4) for i in range(layers)]
        self.layers = nn.ModuleList(
            spectral_norm(nn.Conv2d(a, b, 5, stride=2))
            for a, b in zip([_INPUTS, *outputs[:-1]], outputs, strict=True)
        )

    def forward(
        self, image: Float[Tensor, "n 3 h w"], hole: Float[Tensor, "n 1 h w"]
    ) -> Float[Tensor, "n _ _ _"]:
        """Return unbounded scores, high for real pictures, at 1 / 2^layers of the size.

        Args:
            image: values about -1 to 1, the holes filled or real.
            hole: 1 where the picture was to be completed.
        """
        x = torch.cat([image, hole, elevation_map(image)], 1)
        for number, layer in enumerate(self.layers):
            x = layer(pad_sphere(x, 2))
            if number < len(self.layers) - 1:
                x = functional.leaky_relu(x, 0.2)
        return x


def elevation_map(image: Float[Tensor, "n _ h w"]) -> Float[Tensor, "n 1 h w"]:
    """Linear elevation of each row: 1 at the zenith and -1 at the nadir."""
    count, _, height, width = image.shape
    rows = 1 - (torch.arange(height, device=image.device) + 0.5) * (2 / height)
    return rows[:, None].expand(count, 1, height, width).to(image.dtype)
