"""Pictures of the detector's experiment: colour changes, equal treatment, and prepared inputs.

Relit and path-traced pictures have less noise than recorded ones, and no traces of JPEG. All
pictures, recorded ones included, therefore get the same noise and the same compression.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from PIL import Image

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.core.resample import resize_area
from lightsim.networks.devices import device_of
from lightsim.progress import Progress
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.images import read_srgb8
from lightsim_lab.detect.labels import View
from lightsim_lab.detect.model import Detector

Change = Literal["none", "colour", "exposure"]
# Standard deviation of the added noise, in 8-bit codes, above the 2 codes of recorded pictures at
# mid grey. Sensitivity not measured.
_NOISE_CODES = 3.0
# JPEG quality below that of the recordings (92), so that their traces are covered.
_QUALITY = 80


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture of a view under a light.

    Args:
        change: random change of the colours; `draw` is its number.
    """

    view: View
    light: str
    path: Path
    change: Change = "none"
    draw: int = 0

    def read(self, size_px: tuple[int, int]) -> UInt8[np.ndarray, "3 h w"]:
        """Return the treated picture at the network's size."""
        rng = np.random.default_rng([crc32(f"{self.view.name}/{self.light}".encode()), self.draw])
        srgb = read_srgb8(self.path).astype(np.float32) / 255
        height = round(srgb.shape[0] * size_px[0] / srgb.shape[1])
        small = resize_area(srgb, height, size_px[0])
        return treated(_CHANGES[self.change](small, rng), size_px, rng)


def treated(
    srgb: Float32[np.ndarray, "p q 3"], size_px: tuple[int, int], rng: np.random.Generator
) -> UInt8[np.ndarray, "3 h w"]:
    """Add noise, compress as JPEG with 4:2:0, and pad or crop the picture at the bottom."""
    noisy = 255 * srgb + _NOISE_CODES * rng.standard_normal(srgb.shape)
    file = io.BytesIO()
    picture = Image.fromarray(np.round(np.clip(noisy, 0, 255)).astype(np.uint8))
    picture.save(file, "JPEG", quality=_QUALITY, subsampling="4:2:0")
    decoded = np.asarray(Image.open(file))[: size_px[1]]
    below = size_px[1] - len(decoded)
    return np.ascontiguousarray(np.pad(decoded, ((0, below), (0, 0), (0, 0))).transpose(2, 0, 1))


def distort(
    srgb: Float32[np.ndarray, "h w 3"], rng: np.random.Generator
) -> Float32[np.ndarray, "h w 3"]:
    """Return the picture after BEVFormer's PhotoMetricDistortionMultiViewImage (mmdetection3d):
    brightness, contrast, saturation, hue and order of the channels, each with probability 1/2."""
    from skimage.color import hsv2rgb, rgb2hsv

    does = rng.integers(2, size=6).astype(bool)
    contrast = rng.uniform(0.5, 1.5) if does[1] else 1.0
    x = srgb + rng.uniform(-32, 32) / 255 * does[0]
    # Contrast changes either before or after the colours. The original keeps values outside
    # [0, 1]; conversion to HSV needs them inside.
    hsv = rgb2hsv(np.clip(x * (contrast if does[2] else 1.0), 0, 1))
    hsv[..., 1] = np.clip(hsv[..., 1] * (rng.uniform(0.5, 1.5) if does[3] else 1.0), 0, 1)
    hsv[..., 0] = (hsv[..., 0] + rng.uniform(-18, 18) / 360 * does[4]) % 1
    x = hsv2rgb(hsv) * (1.0 if does[2] else contrast)
    return (x[..., rng.permutation(3)] if does[5] else x).astype(np.float32)


def jitter_exposure(
    srgb: Float32[np.ndarray, "h w 3"], rng: np.random.Generator
) -> Float32[np.ndarray, "h w 3"]:
    """Return the picture at a random exposure within one stop and a random white balance.

    Gains of red and blue are within 20 %; both ranges are chosen, not measured.
    """
    gain = 2 ** rng.uniform(-1, 1) * np.exp(rng.uniform(-0.2, 0.2, 3) * [1, 0, 1])
    return srgb_from_linear(linear_from_srgb(srgb) * gain.astype(np.float32))


_Changed = Callable[[Float32[np.ndarray, "h w 3"], np.random.Generator], np.ndarray]
_CHANGES: dict[Change, _Changed] = {
    "none": lambda srgb, _: srgb,
    "colour": distort,
    "exposure": jitter_exposure,
}


@dataclass(frozen=True, eq=False)
class Sample:
    """A prepared picture; boxes and projection of its view are those of the network's input.

    Args:
        inputs: prepared picture, and its mirror image (`Detector.prepared`).
    """

    street: str
    light: str
    view: View
    inputs: np.ndarray

    @property
    def mirrored(self) -> Sample:
        """Mirror image: pixels to the left become pixels to the right, and so do boxes."""
        view, sign = self.view, np.array([1, -1, 1, 1, 1, 1, -1])
        pixels = np.array([[-1.0, 0, view.size_px[0]], [0, 1, 0], [0, 0, 1]])
        turned = replace(
            view,
            projection=pixels @ view.projection @ np.diag([1.0, -1.0, 1.0, 1.0]),
            boxes=view.boxes * sign,
            ignored=view.ignored * sign,
        )
        return replace(self, view=turned, inputs=self.inputs[::-1])


def prepared_samples(
    street: str, pictures: Sequence[Picture], path: Path, network: Detector, progress: Progress
) -> list[Sample]:
    """Return the samples of pictures. Their inputs are read from the file, which is written first
    if it does not exist or belongs to other pictures."""
    size, device = network.config.picture_px, device_of(network)
    reach_m = network.config.reach_m
    # The size of a file in bytes distinguishes pictures of one name, also after copying.
    names = np.array(
        [f"{p.light} {p.view.name} {p.change} {p.draw} {p.path.stat().st_size}" for p in pictures]
    )
    stored = load_arrays(path, is_mapped=True) if path.is_file() else {}
    if not np.array_equal(stored.get("pictures", np.array([])), names):
        rows = []
        for picture in progress.track(pictures, f"inputs {path.stem}", len(pictures)):
            read = torch.from_numpy(picture.read(size)).to(device)
            rows.append(network.prepared(torch.stack([read, read.flip(-1)])).cpu().numpy())
        path.parent.mkdir(parents=True, exist_ok=True)
        save_arrays(path, {"inputs": np.stack(rows), "pictures": names})
        stored = load_arrays(path, is_mapped=True)
    return [
        Sample(street, picture.light, _scaled(picture.view.within(reach_m), size), prepared)
        for picture, prepared in zip(pictures, stored["inputs"], strict=True)
    ]


def _scaled(view: View, size_px: tuple[int, int]) -> View:
    """Return the view at the width of the network's input; rows have the same factor, rounded."""
    width, height = view.size_px
    scale = np.diag([size_px[0] / width, round(height * size_px[0] / width) / height, 1.0])
    return replace(view, size_px=size_px, projection=scale @ view.projection)
