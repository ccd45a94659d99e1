"""Objects in industrial yards: containers, pallets, drums, tanks and chimneys."""

from __future__ import annotations

import numpy as np

from lightsim_lab.synthetic.facades import Corners, ring
from lightsim_lab.synthetic.shapes import Part, box, tube
from lightsim_lab.synthetic.styles import industrial_table as table
from lightsim_lab.synthetic.styles.fences import bars
from lightsim_lab.synthetic.styles.halls import ribbed

Point = tuple[float, float, float]


def container(material: str, middle_m: Point) -> list[Part]:
    """Build a container of 20 feet along x, from its lower centre."""
    x, y, z = middle_m
    length, width, height = table.CONTAINER_M
    area: Corners = (x - length / 2, y - width / 2, x + length / 2, y + width / 2)
    x0, y0, x1, y1 = area
    parts = [box(material, (x0, y0, z + 0.02), (x1, y1, z + 0.2))]
    parts.append(box(material, (x0, y0, z + height - 0.12), (x1, y1, z + height)))
    for number, (plane, wide) in enumerate(ring(area, 1)):
        rect = (0.08, z + 0.15, wide - 0.08, z + height - 0.1)
        parts.append(ribbed(material, plane, rect, -0.05, (0.28, 0.04)))
        parts.append(plane.block(material, (0.0, z, 0.12, z + height), (-0.12, 0.005)))
        if number == 1:
            # Locking bars of the doors at one end.
            for s in (0.45, 0.95, wide - 0.99, wide - 0.49):
                bar = (s, z + 0.1, s + 0.04, z + height - 0.1)
                parts.append(plane.block("zinc", bar, (-0.02, 0.03)))
    return parts


def containers(rng: np.random.Generator, foot_m: Point) -> list[Part]:
    """Build a stack of one to three containers."""
    x, y, z = foot_m
    parts = []
    for level in range(int(rng.integers(1, 4))):
        shift = 0.0 if level == 0 else float(rng.uniform(-0.15, 0.15))
        middle = (x + shift, y, z + level * table.CONTAINER_M[2])
        parts += container(f"crate{int(rng.integers(table.BOXES))}", middle)
    return parts


def pallets(rng: np.random.Generator, foot_m: Point) -> list[Part]:
    """Build three stacks of pallets of 1.2 m x 0.8 m."""
    x, y, z = foot_m
    low, high = [], []
    for stack in range(3):
        for level in range(int(rng.integers(4, 12))):
            base = np.array([x - 2.0 + 1.5 * stack, y - 0.4, z + 0.145 * level])
            base = base + np.array([*rng.uniform(-0.02, 0.02, 2), 0.0])
            for k in range(5):
                low.append(base + [0.0, 0.17 * k, 0.12])
                high.append(base + [1.2, 0.17 * k + 0.12, 0.142])
            for k in range(3):
                low.append(base + [0.54 * k, 0.0, 0.0])
                high.append(base + [0.54 * k + 0.12, 0.8, 0.12])
    return [bars("pallet", np.array(low), np.array(high))]


def drums(rng: np.random.Generator, foot_m: Point) -> list[Part]:
    """Build a group of drums of 200 litres."""
    x, y, z = foot_m
    parts = []
    for i in range(4):
        for j in range(2):
            if rng.random() < 0.8:
                at = (x - 1.2 + 0.66 * i, y + 0.66 * j)
                material = "drum" if rng.random() < 0.7 else "crate3"
                parts.append(tube(material, (*at, z), (*at, z + 0.88), (0.29, 0.29), 16))
                parts.append(tube(material, (*at, z + 0.42), (*at, z + 0.46), (0.3, 0.3), 16))
    return parts


def tank(rng: np.random.Generator, foot_m: Point) -> list[Part]:
    """Build an upright tank on four legs, with a ladder and a pipe to the ground."""
    x, y, z = foot_m
    radius, height = float(rng.uniform(1.2, 1.6)), float(rng.uniform(5.0, 7.5))
    parts = [
        tube("tank", (x, y, z + 1.0), (x, y, z + 1.0 + height), (radius, radius), 28),
        tube("tank", (x, y, z + 1.0 + height), (x, y, z + 1.7 + height), (radius, 0.2), 28),
        tube("pipe", (x, y, z), (x, y, z + 1.0), (0.12, 0.12), 10),
    ]
    for angle in np.arange(4) * np.pi / 2 + np.pi / 4:
        at = (x + 0.85 * radius * float(np.cos(angle)), y + 0.85 * radius * float(np.sin(angle)))
        parts.append(tube("iron", (*at, z), (*at, z + 1.1), (0.09, 0.09), 8))
    for dx in (-0.2, 0.2):
        at = (x + dx, y - radius - 0.06)
        parts.append(tube("iron", (*at, z), (*at, z + 1.0 + height), (0.025, 0.025), 6))
    for rung in np.arange(z + 0.3, z + height, 0.32).tolist():
        ends = (x - 0.2, y - radius - 0.06, rung), (x + 0.2, y - radius - 0.06, rung)
        parts.append(tube("iron", *ends, (0.015, 0.015), 5))
    return parts


def chimney(rng: np.random.Generator, foot_m: Point) -> list[Part]:
    """Build a tall chimney with painted bands at its top."""
    x, y, z = foot_m
    height = float(rng.uniform(19.0, 27.0))
    parts = [tube("brick", foot_m, (x, y, z + height), (1.5, 0.9), 24)]
    for k, material in enumerate(("sign0", "box0", "sign0")):
        low = z + height - 4.5 + 1.5 * k
        parts.append(tube(material, (x, y, low), (x, y, low + 1.5), (1.05, 1.02), 24))
    return parts
