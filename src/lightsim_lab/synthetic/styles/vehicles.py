"""Trams, lorries and trailers of the synthetic street, in frame `actor`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.participants import centred
from lightsim_lab.synthetic.shapes import Part, box, loft, quads, tube

Built = tuple[tuple[Part, ...], tuple[float, float, float]]

# Length of a module of the tram, in metres.
_MODULE_M = 8.6
# Length of the bellows between two modules, in metres.
_BELLOWS_M = 0.7
# Width of the tram, in metres.
_TRAM_WIDTH_M = 2.4
# Number of modules of the tram.
_MODULES = 3
# Width of a lorry, in metres.
_LORRY_WIDTH_M = 2.5
# Height of a lorry's load area above the road, in metres.
_FLOOR_M = 1.15
# Radius of a lorry's wheel, in metres.
_WHEEL_M = 0.5


def build_tram(wire_m: float) -> Built:
    """Build an articulated tram with three modules; its pantograph reaches up to `wire_m`."""
    total = _MODULES * _MODULE_M + (_MODULES - 1) * _BELLOWS_M
    parts: list[Part] = []
    for number in range(_MODULES):
        x0 = -total / 2 + number * (_MODULE_M + _BELLOWS_M)
        is_first, is_last = number == 0, number == _MODULES - 1
        parts += _module(x0, tapers=(is_first, is_last))
        if not is_last:
            x = x0 + _MODULE_M
            parts.append(box("rubber", (x - 0.02, -1.1, 0.45), (x + _BELLOWS_M + 0.02, 1.1, 3.15)))
    half = total / 2
    for end in (-1.0, 1.0):
        material = "lamp" if end > 0 else "tail"
        for side in (-1.0, 1.0):
            low, high = sorted((end * (half - 0.32), end * (half - 0.02)))
            y0, y1 = sorted((side * 0.55, side * 0.85))
            parts.append(box(material, (low, y0, 0.75), (high, y1, 0.95)))
    parts += _pantograph(wire_m)
    return centred(parts)


def _module(x0: float, tapers: tuple[bool, bool]) -> list[Part]:
    """Build a module: body, panes, doors, skirt with wheels, and equipment on the roof."""
    x1 = x0 + _MODULE_M
    xs = np.array([x0, x0 + 0.15, x0 + 0.7, x0 + 1.6, x1 - 1.6, x1 - 0.7, x1 - 0.15, x1])
    width = np.full(8, _TRAM_WIDTH_M / 2)
    top = np.full(8, 3.35)
    if tapers[0]:
        width[:3] *= [0.72, 0.84, 0.95]
        top[:3] -= [0.9, 0.55, 0.15]
    if tapers[1]:
        width[-3:] *= [0.95, 0.84, 0.72]
        top[-3:] -= [0.15, 0.55, 0.9]
    parts = [
        loft("livery1", _sections(xs, width, np.full(8, 0.95), top)),
        loft("livery", _sections(xs, width * 1.004, np.full(8, 0.32), np.full(8, 1.35))),
    ]
    y = _TRAM_WIDTH_M / 2 + 0.012
    inner = (x0 + (1.5 if tapers[0] else 0.35), x1 - (1.5 if tapers[1] else 0.35))
    count = 4
    pitch = (inner[1] - inner[0]) / count
    for k in range(count):
        a, b = inner[0] + k * pitch + 0.08, inner[0] + (k + 1) * pitch - 0.08
        # Every second opening is a double door, whose panes reach down.
        low = 0.55 if k % 2 else 1.45
        parts.append(box("car_glass", (a, -y, low), (b, y, 2.7)))
        if k % 2:
            middle = (a + b) / 2
            parts.append(
                box("livery", (middle - 0.05, -y - 0.006, low), (middle + 0.05, y + 0.006, 2.7))
            )
    for end, is_tapered in ((x0, tapers[0]), (x1, tapers[1])):
        if is_tapered:
            inward = 1.0 if end == x0 else -1.0
            low, high = sorted((end - inward * 0.015, end + inward * 0.3))
            parts.append(box("car_glass", (low, -0.78, 1.35), (high, 0.78, 2.3)))
    for x in (x0 + 2.1, x1 - 2.1):
        for side in (-1.0, 1.0):
            wheel = tube("rail", (x, side * 0.66, 0.3), (x, side * 0.79, 0.3), (0.3, 0.3), 16)
            parts.append(wheel)
        parts.append(box("rubber", (x - 0.9, -0.95, 0.12), (x + 0.9, 0.95, 0.5)))
    parts.append(box("zinc", (x0 + 2.0, -0.8, 3.3), (x1 - 2.0, 0.8, 3.62)))
    return parts


def _sections(
    x: Float[np.ndarray, " n"],
    half: Float[np.ndarray, " n"],
    low: Float[np.ndarray, " n"],
    high: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n k 3"]:
    """Return rounded rectangles across x, from half widths and heights."""
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False) + np.pi / 24
    c, s = np.cos(angle), np.sin(angle)
    y, z = np.sign(c) * np.abs(c) ** 0.25, np.sign(s) * np.abs(s) ** 0.25
    return np.stack(
        [
            np.broadcast_to(x[:, None], (len(x), len(angle))),
            half[:, None] * y,
            ((low + high) / 2)[:, None] + ((high - low) / 2)[:, None] * z,
        ],
        axis=-1,
    )


def _pantograph(wire_m: float) -> list[Part]:
    """Build a single-arm pantograph on the middle module."""
    knee = (wire_m + 3.6) / 2
    parts = [box("zinc", (-0.9, -0.5, 3.6), (0.6, 0.5, 3.7))]
    parts.append(tube("iron", (0.5, 0.0, 3.7), (-0.9, 0.0, knee), (0.05, 0.04), 8))
    parts.append(tube("iron", (-0.9, 0.0, knee), (0.2, 0.0, wire_m - 0.06), (0.035, 0.03), 8))
    parts.append(box("iron", (0.08, -0.8, wire_m - 0.08), (0.32, 0.8, wire_m - 0.01)))
    return parts


def build_lorry(paint: str, body: str, load_m: float) -> Built:
    """Build a rigid lorry with a box body of length `load_m`; two or three axles."""
    parts = _cab(paint, load_m / 2 + 0.15)
    parts += _box_body(body, (-load_m / 2, load_m / 2), 2.55)
    parts += _chassis((-load_m / 2 + 0.1, load_m / 2 + 1.9), _rear_axles(-load_m / 2, load_m > 6.5))
    parts += _axle(load_m / 2 + 1.0)
    parts += _rear(-load_m / 2)
    return centred(parts)


def build_semi(paint: str, body: str) -> Built:
    """Build an articulated lorry: tractor and box trailer in line, as one rigid actor."""
    load_m = 12.6
    parts = _cab(paint, load_m / 2 + 0.6)
    parts += _box_body(body, (-load_m / 2, load_m / 2), 2.7)
    parts += _chassis((-load_m / 2 + 0.1, load_m / 2 - 3.5), [-4.9, -3.6, -2.3])
    parts += _chassis((load_m / 2 - 3.2, load_m / 2 + 2.3), [load_m / 2 - 1.9])
    parts += _axle(load_m / 2 + 1.45)
    parts += _rear(-load_m / 2)
    # Landing legs.
    for y in (-0.8, 0.8):
        parts.append(box("iron", (2.0, y - 0.06, 0.12), (2.14, y + 0.06, 1.05)))
    return centred(parts)


def build_trailer(body: str, load_m: float) -> Built:
    """Build a two-axle trailer with a drawbar in front."""
    parts = _box_body(body, (-load_m / 2, load_m / 2), 2.45)
    parts += _chassis((-load_m / 2 + 0.1, load_m / 2), [-load_m / 2 + 1.1, load_m / 2 - 1.1])
    for y in (-0.5, 0.5):
        start, end = (load_m / 2 - 0.1, y, 0.75), (load_m / 2 + 1.5, 0.0, 0.65)
        parts.append(tube("iron", start, end, (0.06, 0.05), 6))
    parts += _rear(-load_m / 2)
    return centred(parts)


def _cab(paint: str, x: float) -> list[Part]:
    """Build a cab-over cab behind whose back is x: body, screen, side panes, lamps, mirrors."""
    xs = x + np.array([0.0, 0.08, 1.2, 1.75, 1.98, 2.05])
    half = _LORRY_WIDTH_M / 2 * np.array([0.97, 0.985, 0.985, 0.97, 0.93, 0.88])
    low = np.array([0.75, 0.7, 0.55, 0.45, 0.45, 0.5])
    high = np.array([3.0, 3.1, 3.15, 3.0, 2.75, 1.5])
    y = half[2] + 0.01
    parts = [loft(paint, _sections(xs, half, low, high))]
    parts.append(box("car_glass", (x + 0.75, -y, 1.75), (x + 1.7, y, 2.6)))
    # The windscreen leans back from its lower edge and is in front of the body.
    low_x, high_x = x + 2.08, x + 2.01
    screen = np.array(
        [[[low_x, -1.05, 1.6], [low_x, 1.05, 1.6], [high_x, 1.05, 2.68], [high_x, -1.05, 2.68]]]
    )
    parts.append(quads("car_glass", screen, screen[..., 1:]))
    parts.append(box("rubber", (x + 1.7, -1.2, 0.38), (x + 2.12, 1.2, 0.75)))
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * 0.65, side * 1.05))
        parts.append(box("lamp", (x + 1.9, y0, 0.8), (x + 2.1, y1, 1.0)))
        y0, y1 = sorted((side * 1.22, side * 1.4))
        parts.append(box("rubber", (x + 1.75, y0, 1.8), (x + 1.85, y1, 2.4)))
    return parts


def _box_body(material: str, x: tuple[float, float], height_m: float) -> list[Part]:
    """Build a box with ribs at its edges and sides."""
    y, z0, z1 = _LORRY_WIDTH_M / 2 - 0.03, _FLOOR_M, _FLOOR_M + height_m
    parts = [box(material, (x[0], -y, z0), (x[1], y, z1))]
    for edge in np.linspace(x[0], x[1] - 0.08, max(3, round((x[1] - x[0]) / 1.25))).tolist():
        parts.append(box("zinc", (edge, -y - 0.02, z0), (edge + 0.08, y + 0.02, z1 + 0.015)))
    for z in (z0, z1 - 0.1):
        parts.append(box("zinc", (x[0] - 0.01, -y - 0.03, z), (x[1] + 0.01, y + 0.03, z + 0.12)))
    return parts


def _chassis(x: tuple[float, float], axles: list[float]) -> list[Part]:
    """Build the frame, side guards and axles."""
    parts = [box("iron", (x[0], -0.45, 0.75), (x[1], 0.45, _FLOOR_M))]
    for axle in axles:
        parts += _axle(axle)
    return parts


def _axle(x: float) -> list[Part]:
    parts = []
    for side in (-1.0, 1.0):
        inner, outer = side * (_LORRY_WIDTH_M / 2 - 0.55), side * (_LORRY_WIDTH_M / 2 - 0.03)
        centre = _WHEEL_M
        parts.append(
            tube("rubber", (x, inner, centre), (x, outer, centre), (_WHEEL_M, _WHEEL_M), 18)
        )
        hub = outer + side * 0.02
        parts.append(tube("steel", (x, outer, centre), (x, hub, centre), (0.27, 0.2), 12))
    return parts


def _rear_axles(x0: float, has_two: bool) -> list[float]:
    return [x0 + 1.3, x0 + 2.5] if has_two else [x0 + 1.6]


def _rear(x: float) -> list[Part]:
    """Build rear lamps and the underrun guard."""
    parts = [box("iron", (x, -1.1, 0.5), (x + 0.1, 1.1, 0.62))]
    for side in (-1.0, 1.0):
        y0, y1 = sorted((side * 0.75, side * 1.1))
        parts.append(box("tail", (x - 0.03, y0, 0.85), (x + 0.1, y1, 1.0)))
        parts.append(box("iron", (x + 0.02, y0, 0.5), (x + 0.2, y1, 1.2)))
    parts.append(box("plate", (x - 0.04, -0.26, 0.72), (x + 0.02, 0.26, 0.83)))
    return parts
