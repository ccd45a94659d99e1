"""Finishes of the styles beyond the city: claddings, roofs, paints, metals and ground."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from zlib import crc32

import numpy as np
from jaxtyping import Float

from lightsim_lab.synthetic.finishes import make_finishes
from lightsim_lab.synthetic.plan import StreetPlan
from lightsim_lab.synthetic.styles.base import STREET_END_M, STREET_START_M
from lightsim_lab.synthetic.textures import (
    Finish,
    Line,
    coloured,
    constant,
    glass,
    noise,
    road,
    slabs,
    speckled,
)

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Coating:
    """Row of a style's table of finishes.

    Args:
        make: function from a random stream and a colour to a finish.
        rgb: linear albedo, chosen by eye within the range of real materials.
        spread: standard deviation of the logarithm of each channel between streets.
    """

    make: Callable[[np.random.Generator, Rgb], Finish]
    rgb: Rgb
    spread: float = 0.08


@dataclass(frozen=True)
class RoadTable:
    """Road surface of a style: width, wheel tracks and lines, measured from the road's middle."""

    width_m: float
    tracks_m: Sequence[float]
    lines: Sequence[Line]
    rgb: Rgb = (0.190, 0.186, 0.182)


def style_finishes(
    plan: StreetPlan, coatings: Mapping[str, Coating], table: RoadTable
) -> dict[str, Finish]:
    """Return the finishes of a style by name: its own, and the city's for actors and furniture."""
    length_m = STREET_END_M - STREET_START_M
    finishes = make_finishes(plan.stream(0), length_m, table.width_m, 3.2)
    finishes["road"] = road(
        plan.stream(1), (length_m, table.width_m), table.tracks_m, table.lines, table.rgb
    )
    for name, coating in coatings.items():
        # Each finish has its own stream, so that the tables can be extended.
        rng = plan.stream(crc32(name.encode()))
        r, g, b = (np.asarray(coating.rgb) * np.exp(rng.normal(0, coating.spread, 3))).tolist()
        finishes[name] = coating.make(rng, (r, g, b))
    return finishes


def _rows(count: int, period: int, joint: int, depth: float) -> Float[np.ndarray, "{count} 1"]:
    """Return relative albedos of overlapping rows: dark below the lap, brighter towards it."""
    height = np.arange(count) % period / period
    lap = np.where(np.arange(count) % period < joint, 1 - depth, 1.0)
    return ((0.94 + 0.1 * height) * lap)[:, None]


def clapboard(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return painted boards 16 cm high, each with a shadow line; satin paint."""
    board = 1 + 0.03 * np.repeat(rng.standard_normal((32, 1)), 16, axis=0)
    grain = 0.02 * noise(rng, 512, 512, 0.3) + 0.03 * noise(rng, 512, 512, 1.3)
    return Finish(
        coloured(board * _rows(512, 16, 2, 0.42) + grain, rgb), (5.12, 5.12), constant(0.5)
    )


def vertical_boards(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return upright boards 12 cm wide with dark joints, stained and matt."""
    board = 1 + 0.12 * np.repeat(rng.standard_normal((1, 32)), 16, axis=1)
    grain = 0.06 * np.repeat(noise(rng, 16, 512, 0.4), 32, axis=0) + 0.05 * noise(
        rng, 512, 512, 1.2
    )
    return Finish(
        coloured(board * _rows(512, 16, 1, 0.5).T + grain, rgb), (3.84, 3.84), constant(0.75)
    )


def tiles(
    rng: np.random.Generator, rgb: Rgb, roughness: float = 0.7, specular: float = 0.3
) -> Finish:
    """Return roof tiles 20 cm wide in courses of 32 cm; glazed if smooth and specular."""
    tone = np.kron(1 + 0.12 * rng.standard_normal((16, 32)), np.ones((32, 16)))
    albedo = tone * _rows(512, 32, 3, 0.45) * _rows(512, 16, 2, 0.25).T
    # Each second course is shifted by half a tile.
    for row in range(32, 512, 64):
        albedo[row : row + 32] = np.roll(albedo[row : row + 32], 8, axis=1)
    albedo *= 1 + 0.06 * noise(rng, 512, 512, 0.4) + 0.08 * noise(rng, 512, 512, 1.4)
    return Finish(coloured(albedo, rgb), (6.4, 5.12), constant(roughness), specular=specular)


def wall_tiles(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return glazed wall tiles 10 x 20 cm with pale joints."""
    tone = np.kron(1 + 0.06 * rng.standard_normal((32, 16)), np.ones((16, 32)))
    colour = coloured(tone, rgb)
    is_joint = np.zeros((512, 512), dtype=bool)
    is_joint[::16] = is_joint[:, ::32] = True
    colour[is_joint] = 0.45
    return Finish(colour, (3.2, 3.2), constant(0.15), specular=0.6)


def ashlar(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return dressed stone in courses of 40 cm with fine joints."""
    tone = np.kron(1 + 0.05 * rng.standard_normal((16, 8)), np.ones((32, 64)))
    for row in range(32, 512, 64):
        tone[row : row + 32] = np.roll(tone[row : row + 32], 32, axis=1)
    albedo = tone * _rows(512, 32, 1, 0.4) * _rows(512, 64, 1, 0.2).T
    albedo *= 1 + 0.05 * noise(rng, 512, 512, 0.4) + 0.09 * noise(rng, 512, 512, 1.5)
    return Finish(coloured(albedo, rgb), (6.4, 6.4), constant(0.75))


def lawn(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return mown grass with bare and dry patches."""
    albedo = 1 + 0.28 * noise(rng, 512, 512, 0.35) + 0.14 * noise(rng, 512, 512, 1.4)
    dry = np.clip(0.5 * noise(rng, 512, 512, 1.6), 0, 1)[..., None]
    colour = coloured(albedo, rgb) * (1 + dry * np.array([0.9, 0.35, 0.5]))
    return Finish(colour.astype(np.float32), (9.0, 9.0), constant(0.9), specular=0.2)


def blocks(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return paving blocks 10 x 20 cm with sandy joints."""
    tone = np.kron(1 + 0.14 * rng.standard_normal((32, 16)), np.ones((16, 32)))
    for row in range(16, 512, 32):
        tone[row : row + 16] = np.roll(tone[row : row + 16], 16, axis=1)
    albedo = tone * _rows(512, 16, 2, 0.35) * (1 + 0.1 * noise(rng, 512, 512, 0.7))
    return Finish(coloured(albedo, rgb), (3.2, 3.2), constant(0.8))


def matt(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return a matt surface with fine variation: bark, render, rubber or timber."""
    return speckled(rng, rgb, 0.14, 3.0, 0.85)


def gloss_paint(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return gloss paint on timber or metal."""
    return replace(speckled(rng, rgb, 0.06, 3.0, 0.18), specular=0.55)


def sheet(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return painted sheet metal with dust, rain streaks and some rust at the seams."""
    streaks = 0.06 * np.repeat(noise(rng, 8, 512, 0.6), 64, axis=0)
    albedo = 1 + streaks + 0.05 * noise(rng, 512, 512, 1.3)
    rust = np.clip(0.6 * noise(rng, 512, 512, 1.1) - 1.5, 0, 1)[..., None]
    colour = coloured(albedo, rgb) * (1 - rust) + rust * np.array([0.22, 0.09, 0.04])
    roughness = (0.3 + 0.5 * rust[..., 0]).astype(np.float32)
    return Finish(colour.astype(np.float32), (12.0, 12.0), roughness, 0.5, metallic=0.25)


def metal(rng: np.random.Generator, rgb: Rgb, roughness: float = 0.35) -> Finish:
    """Return bare metal: galvanised steel, zinc or a polished rail."""
    return replace(speckled(rng, rgb, 0.1, 2.0, roughness), specular=0.5, metallic=0.7)


def concrete(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return cast concrete in bays of 4 m with joints, stains and oil."""
    finish = slabs(rng, rgb, 256)
    stain = np.clip(0.5 * noise(rng, 512, 512, 1.5) - 0.3, 0, 0.6)[..., None]
    colour = np.clip(finish.base_colour * (1 - 0.6 * stain), 0.02, 0.88)
    return replace(finish, base_colour=colour.astype(np.float32))


def window(rng: np.random.Generator, rgb: Rgb) -> Finish:
    """Return window glass with curtains; the colour tints it."""
    finish = glass(rng, True)
    return replace(finish, base_colour=(finish.base_colour * np.asarray(rgb)).astype(np.float32))


glazed_roof_tiles = partial(tiles, roughness=0.2, specular=0.55)
polished_metal = partial(metal, roughness=0.15)
