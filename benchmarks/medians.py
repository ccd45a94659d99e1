"""What the medians of relighting cost a picture and sky: processor seconds of one core; Markdown.

    python benchmarks/medians.py

A smooth random log ratio stands for the light's change. Each further sky of a frame takes these
medians anew, except the source's reflections. Only wanted pixels are computed; here all are.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from lightsim.relighting.physical.filters import box_mean, median_smoothed

WIDTHS = {
    "light, level": 5 / 480,
    "light, upright": 14 / 480,
    "reflections, source": 6 / 480,
    "reflections, target": 6 / 480,
    "correction": 4 / 480,
}
"""Fractions of the picture's width, as `relighting.physical.ratio` has them."""


def main() -> None:
    rng = np.random.default_rng(0)
    median_smoothed(np.zeros((8, 16, 3), np.float32), 0.2)  # compiles
    lines = [
        "| picture | " + " | ".join(WIDTHS) + " | all |",
        "|---|" + "---:|" * (len(WIDTHS) + 1),
    ]
    for width, height in ((480, 270), (960, 540), (1920, 1080)):
        noise = rng.normal(size=(height, width, 3)).astype(np.float32)
        image = box_mean(noise, 8) + 0.02 * noise
        seconds = [_seconds(image, detail) for detail in WIDTHS.values()]
        cells = " | ".join(f"{value:.2f}" for value in (*seconds, sum(seconds)))
        lines.append(f"| {width}x{height} | {cells} |")
    sys.stdout.write("\n".join(lines) + "\n")


def _seconds(image: np.ndarray, detail: float) -> float:
    start = time.process_time()
    median_smoothed(image, detail)
    return time.process_time() - start


if __name__ == "__main__":
    main()
