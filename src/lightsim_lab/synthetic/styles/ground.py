"""Road, kerbs that drives lower, sidewalks and open ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lightsim_lab.synthetic.shapes import Part, box, quads, rectangle
from lightsim_lab.synthetic.styles.base import STREET_END_M, STREET_START_M

Span = tuple[float, float]
# Width of the kerb stones, in metres.
KERB_M = 0.18
# Height of a lowered kerb above the road, in metres; 3 cm are usual.
LOWERED_M = 0.03
# Length of the last stone before a lowered kerb, which slopes, in metres.
_SLOPED_M = 1.0


@dataclass(frozen=True)
class Kerbside:
    """Kerb and sidewalk on one side of a road.

    Args:
        side: +1 if the sidewalk is at larger y than the road, -1 otherwise.
        kerb_y_m: y of the road's edge, frame `street`.
        strips: materials and widths of the strips behind the kerb, from the road outwards.
        height_m: height of kerb and strips above the road.
        lowered: ranges of x where a drive crosses.
        paving: material of the crossings, which slope up from the lowered kerb.
    """

    side: int
    kerb_y_m: float
    strips: Sequence[tuple[str, float]]
    height_m: float
    lowered: Sequence[Span] = ()
    paving: str = "paving"

    @property
    def outer_y_m(self) -> float:
        """Return y of the far edge of the last strip."""
        return self.kerb_y_m + self.side * (KERB_M + sum(width for _, width in self.strips))

    @property
    def top_m(self) -> float:
        """Return the height of the strips: 5 mm below the stones, so that both stay visible."""
        return self.height_m - 0.005

    def build(self) -> list[Part]:
        """Build kerb stones, strips and crossings."""
        inner = self.kerb_y_m + self.side * KERB_M
        parts = self._stones(self.kerb_y_m, inner)
        for x0, x1 in self.lowered:
            near, far = (inner, LOWERED_M), (self.outer_y_m, self.top_m)
            corners = np.array([[x0, *near], [x1, *near], [x1, *far], [x0, *far]])
            corners = corners if self.side > 0 else corners[::-1].copy()
            parts.append(quads(self.paving, corners[None], corners[None, :, :2]))
        y = inner
        for material, width in self.strips:
            low, high = sorted((y, y + self.side * width))
            y += self.side * width
            for x0, x1 in gaps_between(self.lowered):
                parts.append(box(material, (x0, low, -0.02), (x1, high, self.top_m)))
        return parts

    def _stones(self, edge: float, inner: float) -> list[Part]:
        low, high = sorted((edge, inner))
        parts = []
        for x in np.arange(STREET_START_M, STREET_END_M, 1.0).tolist():
            heights = [self._height(x + 0.006), self._height(x + 0.994)]
            if heights[0] == heights[1]:
                stone = box("kerb", (x + 0.006, low, -0.02), (x + 0.994, high, heights[0]))
                parts.append(stone)
                continue
            parts.append(_sloped_stone((x + 0.006, x + 0.994), (low, high), heights))
        return parts

    def _height(self, x: float) -> float:
        """Return the height of the kerb: lowered at drives, with a slope on either side."""
        away = min((max(x0 - x, x - x1, 0.0) for x0, x1 in self.lowered), default=np.inf)
        fraction = float(np.clip(away / _SLOPED_M, 0.0, 1.0))
        return LOWERED_M + fraction * (self.height_m - LOWERED_M)


def gaps_between(spans: Sequence[Span]) -> list[Span]:
    """Return the ranges of x of the street outside some disjoint ranges."""
    gaps, x = [], STREET_START_M
    for x0, x1 in sorted(spans):
        if x0 - x > 0.01:
            gaps.append((x, x0))
        x = x1
    if STREET_END_M - x > 0.01:
        gaps.append((x, STREET_END_M))
    return gaps


def _sloped_stone(x: Span, y: Span, heights_m: Sequence[float]) -> Part:
    """Build a kerb stone whose top slopes along the street."""
    stone = box("kerb", (x[0], y[0], -0.02), (x[1], y[1], 1.0))
    vertices = stone.vertices.copy()
    is_top = vertices[:, 2] > 0.5
    fraction = (vertices[is_top, 0] - x[0]) / (x[1] - x[0])
    vertices[is_top, 2] = heights_m[0] + fraction * (heights_m[1] - heights_m[0])
    return Part(stone.material, vertices, stone.faces, stone.uv_m)


def flat(material: str, x: Span, y: Span, height_m: float) -> Part:
    """Build level ground over ranges of x and y."""
    (x0, x1), (y0, y1) = sorted(x), sorted(y)
    return rectangle(material, (x0, y0, height_m), (x1 - x0, 0, 0), (0, y1 - y0, 0), (x0, y0))


def carriageway(y: Span, is_reversed: bool = False) -> Part:
    """Build a road over the whole street; reversed: its texture is turned by 180 degrees."""
    (x0, x1), (y0, y1) = (STREET_START_M, STREET_END_M), sorted(y)
    if is_reversed:
        return rectangle("road", (x1, y1, 0.0), (x0 - x1, 0, 0), (0, y0 - y1, 0))
    return rectangle("road", (x0, y0, 0.0), (x1 - x0, 0, 0), (0, y1 - y0, 0))


def surroundings() -> list[Part]:
    """Build earth below and around the street."""
    x0, length = STREET_START_M, STREET_END_M - STREET_START_M
    return [rectangle("earth", (x0 - 150, -200.0, -0.03), (length + 300, 0, 0), (0, 400.0, 0))]
