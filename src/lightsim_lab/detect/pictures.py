"""Pictures of the detector's experiment: colour changes, equal treatment, and prepared inputs.

Relit and path-traced pictures have less noise than recorded ones, and no traces of JPEG. All
pictures, recorded ones included, therefore get the same noise and the same compression.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from zlib import crc32

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from PIL import Image

from lightsim.core.colour import linear_from_srgb, srgb_from_linear
from lightsim.core.resample import resize_area
from lightsim.networks.devices import device_of
from lightsim.progress import Progress
from lightsim.store.arrays import load_arrays, save_arrays
from lightsim.store.images import read_srgb8
from lightsim_lab.detect.labels import Views
from lightsim_lab.detect.model import Detector

Change = Literal["none", "colour", "exposure"]
# Standard deviation of the added noise, in 8-bit codes: above that of recorded pictures at the
# network's resolution, which is at most 1 code. Sensitivity not measured.
_NOISE_CODES = 2.0
# JPEG quality below that of the recordings (92), so that their traces are covered.
_QUALITY = 80


@dataclass(frozen=True)
class Picture:
    """A picture of a view under a light.

    Args:
        view: index in the street's `Views`.
        change: random change of the colours.
        draw: number of the random change.
    """

    view: int
    light: str
    path: Path
    change: Change = "none"
    draw: int = 0

    def read(self, size_px: tuple[int, int]) -> UInt8[np.ndarray, "3 h w"]:
        """Return the treated picture at the network's size."""
        name = f"{self.path.parent.name}/{self.path.stem}/{self.light}"
        rng = np.random.default_rng([crc32(name.encode()), self.draw])
        srgb8 = read_srgb8(self.path)
        width = size_px[0]
        height = round(srgb8.shape[0] * width / srgb8.shape[1])
        srgb = resize_area(srgb8.astype(np.float32) / 255, height, width)
        return treated(_CHANGES[self.change](srgb, rng), size_px, rng)


def treated(
    srgb: Float32[np.ndarray, "p q 3"], size_px: tuple[int, int], rng: np.random.Generator
) -> UInt8[np.ndarray, "3 h w"]:
    """Add noise, compress as JPEG with 4:2:0, and pad or crop the picture at the bottom."""
    noisy = 255 * srgb + _NOISE_CODES * rng.standard_normal(srgb.shape)
    file = io.BytesIO()
    picture = Image.fromarray(np.round(np.clip(noisy, 0, 255)).astype(np.uint8))
    picture.save(file, "JPEG", quality=_QUALITY, subsampling="4:2:0")
    decoded = np.asarray(Image.open(file))
    width, height = size_px
    whole = np.zeros((height, width, 3), np.uint8)
    rows = min(height, len(decoded))
    whole[:rows] = decoded[:rows]
    return np.ascontiguousarray(whole.transpose(2, 0, 1))


def distort(
    srgb: Float32[np.ndarray, "h w 3"], rng: np.random.Generator
) -> Float32[np.ndarray, "h w 3"]:
    """Return the picture after BEVFormer's PhotoMetricDistortionMultiViewImage (mmdetection3d):
    brightness, contrast, saturation, hue and order of the channels, each with probability 1/2."""
    from skimage.color import hsv2rgb, rgb2hsv

    def happens() -> bool:
        return bool(rng.integers(2))

    if happens():
        srgb = srgb + rng.uniform(-32, 32) / 255
    is_contrast_first, contrast = happens(), rng.uniform(0.5, 1.5) if happens() else 1.0
    srgb = srgb * contrast if is_contrast_first else srgb
    # The original keeps values outside [0, 1]; conversion to HSV needs them inside.
    hsv = rgb2hsv(np.clip(srgb, 0, 1))
    if happens():
        hsv[..., 1] = np.clip(hsv[..., 1] * rng.uniform(0.5, 1.5), 0, 1)
    if happens():
        hsv[..., 0] = (hsv[..., 0] + rng.uniform(-18, 18) / 360) % 1
    srgb = hsv2rgb(hsv)
    srgb = srgb if is_contrast_first else srgb * contrast
    if happens():
        srgb = srgb[..., rng.permutation(3)]
    return srgb.astype(np.float32)


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
    """A picture with its labels.

    Args:
        inputs: prepared picture, and its mirror image (`Detector.prepared`).
        projection: pixels of the network's input from the level frame, homogeneous.
        boxes, ignored: vehicles that have to be detected, and others, in the level frame.
    """

    street: str
    light: str
    view: str
    inputs: np.ndarray
    projection: Float[np.ndarray, "3 4"]
    boxes: Float[np.ndarray, "_ 7"]
    ignored: Float[np.ndarray, "_ 7"]

    def mirrored(self, width_px: int) -> Sample:
        """Return the mirror image: pixels to the left become pixels to the right, and so do
        boxes."""
        pixels = np.array([[-1.0, 0.0, width_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        sign = np.array([1, -1, 1, 1, 1, 1, -1])
        return Sample(
            self.street,
            self.light,
            self.view,
            self.inputs[::-1],
            pixels @ self.projection @ np.diag([1.0, -1.0, 1.0, 1.0]),
            self.boxes * sign,
            self.ignored * sign,
        )


def prepare_inputs(
    path: Path, pictures: Sequence[Picture], network: Detector, progress: Progress
) -> np.ndarray:
    """Return the prepared inputs [n, 2, ...] of pictures and their mirror images, as a view of the
    file, which is written first if it does not exist."""
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        rows, device = [], device_of(network)
        for picture in progress.track(pictures, f"inputs {path.stem}", len(pictures)):
            read = torch.from_numpy(picture.read(network.config.picture_px)).to(device)
            rows.append(network.prepared(torch.stack([read, read.flip(-1)])).cpu().numpy())
        save_arrays(path, {"inputs": np.stack(rows)})
    return load_arrays(path, is_mapped=True)["inputs"]


def samples_of(
    street: str,
    views: Views,
    pictures: Sequence[Picture],
    inputs: np.ndarray,
    config_px: tuple[int, int],
) -> list[Sample]:
    """Return the samples of a street's pictures with the labels of their views."""
    samples = []
    for picture, prepared in zip(pictures, inputs, strict=True):
        k = picture.view
        # The picture was scaled to the network's width; rows have the same factor up to rounding.
        width, height = (int(v) for v in views.sizes_px[k])
        scale = config_px[0] / width
        rows = round(height * scale) / height
        projection = np.diag([scale, rows, 1.0]) @ views.projections[k]
        samples.append(
            Sample(street, picture.light, views.names[k], prepared, projection, *views.labels(k))
        )
    return samples
