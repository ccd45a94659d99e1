"""One density over the sun's direction and over "clear sun or overcast" from all that is known.

Cues (`cues`) are taken as independent given the sun: their log likelihoods add up on a grid of
directions of equal solid angle, which is made finer around the mass until it resolves it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from lightsim.core.dome import disc_directions
from lightsim.core.solar import SolarPosition, angle_between_deg, azimuth_elevation
from lightsim.core.twin import Panorama
from lightsim.lighting.directions import count_for_spacing, fibonacci_hemisphere
from lightsim.lighting.sun.cues import Cue, EphemerisCue, ShadowCue, looked_up
from lightsim.lighting.sun.direction import SunDirection

_STD_PER_RADIUS_90 = 2.146
"""sqrt(-2 log 0.1): radius of the 90 % disc of a round normal density, in standard deviations."""
_LOWEST_SINE = np.sin(np.radians(0.5))


# None was measured alone.

# Of the first grid, over the hemisphere.
_SPACING_DEG = 2.0
# The grid is made finer until 99 % of the mass lie beyond this many spacings.
_RESOLVED = 8.0
# Spacings along the radius of a finer grid.
_FINER_STEPS = 25
# Finer grids at most.
_MAX_ROUNDS = 4
# Probability of a clear sun before anything was seen.
_SUNNY_PRIOR = 0.5


@dataclass(frozen=True, eq=False)
class SunPosterior:
    """Where the sun is.

    Args:
        grid_world: directions.
        mass: probability of each with a clear sun, and with an overcast sky; sums to 1.
        direction_world: the estimate: the direction with the least expected angle to the sun, or
            the mode where that was asked for.
        mode_world: the densest direction.
        region_90_deg: radius about `direction_world` that holds 90 % of the mass.
        sunny_probability: of a sun that casts shadows.
        visible_probability: that a clear sun stands in a part of the sky that was seen.
        heading_correction_deg: azimuth by ephemeris minus azimuth found, clockwise; None without
            place, time and heading.
        heading_deg: azimuth of world +x, clockwise from north; None without place and time.
        notes: each cue's own word.
    """

    grid_world: Float[np.ndarray, "n 3"]
    mass: Float64[np.ndarray, "n 2"]
    direction_world: Float[np.ndarray, "3"]
    mode_world: Float[np.ndarray, "3"]
    region_90_deg: float
    sunny_probability: float
    visible_probability: float
    heading_correction_deg: float | None
    heading_deg: float | None
    notes: tuple[str, ...]

    @property
    def uncertainty_deg(self) -> float:
        """One standard deviation of each of the two components of the direction's error: of the
        round normal density with the same 90 % disc."""
        return self.region_90_deg / _STD_PER_RADIUS_90

    def probability_within(self, direction_world: Float[np.ndarray, "3"]) -> float:
        """Mass of what lies nearer to the estimate than a direction: uniform in [0, 1] for true
        suns where the posterior is calibrated."""
        limit = float(self.direction_world @ direction_world)
        nearer = self.grid_world @ self.direction_world > limit
        return float(self.mass[nearer].sum())


def sun_posterior(
    cues: Sequence[Cue], panorama: Panorama | None, *, takes_mode: bool = False
) -> SunPosterior:
    """The density of the sun given cues; without any, that of a uniform hemisphere.

    Args:
        cues: independent given the sun.
        panorama: what was seen; None where nothing was.
        takes_mode: the estimate is the mode, else the direction with the least expected angle to
            the sun: that lies between several modes, but of one wide density it is pushed up by
            the horizon.
    """
    grid = fibonacci_hemisphere(count_for_spacing(_SPACING_DEG))
    spacing_deg = _SPACING_DEG
    mass = _mass(cues, grid, spacing_deg)
    for _ in range(_MAX_ROUNDS):
        centre = _median_direction(grid, mass)
        reach_deg = _radius_deg(grid, mass, centre, 0.99)
        if reach_deg > _RESOLVED * spacing_deg:
            break
        radius_deg = max(1.3 * reach_deg, 2.5 * spacing_deg)
        spacing_deg = radius_deg / _FINER_STEPS
        disc = disc_directions(centre, radius_deg, round(np.pi * _FINER_STEPS**2))
        grid = disc[disc[:, 2] > _LOWEST_SINE]
        mass = _mass(cues, grid, spacing_deg)
    mode = grid[int(mass.sum(axis=1).argmax())]
    centre = mode if takes_mode else _median_direction(grid, mass)
    correction_deg, heading_deg = _heading(cues, centre)
    visible = 0.0
    if panorama is not None:
        is_open = looked_up(panorama.is_sky & panorama.is_seen, grid)
        visible = float(mass[is_open, 0].sum())
    return SunPosterior(
        grid,
        mass,
        centre,
        mode,
        max(_radius_deg(grid, mass, centre, 0.9), 0.5 * spacing_deg),
        float(mass[:, 0].sum()),
        visible,
        correction_deg,
        heading_deg,
        _notes(cues, centre),
    )


def sun_direction(posterior: SunPosterior, position: SolarPosition | None) -> SunDirection:
    """The estimate in the form that the sky's fit takes; `position` where place and time are
    known."""
    found = azimuth_elevation(posterior.direction_world)
    is_known = position is not None and posterior.heading_correction_deg is not None
    origin = "gps+time" if is_known else ("image" if position is None else "time+image")
    summary = (
        f"sun: 90 % within {posterior.region_90_deg:.1f} degrees; clear with probability"
        f" {posterior.sunny_probability:.2f}, in the sky that was seen"
        f" {posterior.visible_probability:.2f}"
    )
    notes = [summary, *posterior.notes]
    if posterior.heading_correction_deg is not None:
        notes.append(f"heading corrected by {posterior.heading_correction_deg:+.2f} degrees")
    elif posterior.heading_deg is not None:
        notes.append(
            f"the heading was unknown: world +x points {posterior.heading_deg:.1f} degrees from"
            " north if the sun stands where it was found"
        )
    return SunDirection(
        posterior.direction_world,
        None if position is None else position.azimuth_deg,
        found.elevation_deg,
        origin,
        posterior.uncertainty_deg,
        tuple(notes),
        posterior.sunny_probability,
    )


def _mass(
    cues: Sequence[Cue],
    grid: Float[np.ndarray, "n 3"],
    spacing_deg: float,
) -> Float64[np.ndarray, "n 2"]:
    prior = np.log([_SUNNY_PRIOR, 1.0 - _SUNNY_PRIOR])
    log_mass = np.tile(prior, (len(grid), 1))
    for cue in cues:
        log_mass = log_mass + cue.log_likelihood(grid, 0.5 * spacing_deg)
    mass = np.exp(log_mass - log_mass.max())
    return mass / mass.sum()


def _median_direction(
    grid: Float[np.ndarray, "n 3"], mass: Float64[np.ndarray, "n 2"]
) -> Float[np.ndarray, "3"]:
    """Of the grid's directions, the one with the least expected angle (geometric median)."""
    total = mass.sum(axis=1)
    order = np.argsort(total)[::-1]
    # Candidates and weights in the long tail change nothing.
    heavy = order[: max(50, int((np.cumsum(total[order]) < 0.999).sum()) + 1)]
    candidates = heavy[:800]
    angles = np.arccos(np.clip(grid[candidates] @ grid[heavy].T, -1, 1))
    return grid[candidates[int((angles @ total[heavy]).argmin())]]


def _radius_deg(
    grid: Float[np.ndarray, "n 3"],
    mass: Float64[np.ndarray, "n 2"],
    centre: Float[np.ndarray, "3"],
    fraction: float,
) -> float:
    angle = np.degrees(np.arccos(np.clip(grid @ centre, -1, 1)))
    order = np.argsort(angle)
    reached = np.searchsorted(np.cumsum(mass.sum(axis=1)[order]), fraction)
    return float(angle[order[min(int(reached), len(order) - 1)]])


def _heading(
    cues: Sequence[Cue], direction_world: Float[np.ndarray, "3"]
) -> tuple[float | None, float | None]:
    """(correction of the log's heading, azimuth of world +x)."""
    for cue in cues:
        if isinstance(cue, EphemerisCue):
            in_world = azimuth_elevation(direction_world).azimuth_deg
            # Azimuths in world axes take +y for north; world +x then lies at 90 degrees.
            heading_deg = (90.0 + cue.position.azimuth_deg - in_world) % 360.0
            if cue.geo.enu_from_world is None:
                return None, heading_deg
            in_enu = azimuth_elevation(cue.geo.enu_from_world.rotate(direction_world))
            off = cue.position.azimuth_deg - in_enu.azimuth_deg
            return float((off + 180.0) % 360.0 - 180.0), heading_deg
    return None, None


def _notes(cues: Sequence[Cue], centre: Float[np.ndarray, "3"]) -> tuple[str, ...]:
    """What each cue alone would say."""
    notes: list[str] = []
    for cue in cues:
        grid = fibonacci_hemisphere(count_for_spacing(_SPACING_DEG))
        mass = _mass([cue], grid, _SPACING_DEG)
        alone = grid[int(mass.sum(axis=1).argmax())]
        radius_deg = _radius_deg(grid, mass, alone, 0.9)
        off_deg = angle_between_deg(alone, centre)
        predicted = (
            f"{cue.name}: 90 % within {radius_deg:.0f} degrees, {off_deg:.0f} from the result"
        )
        if isinstance(cue, ShadowCue):
            votes = cue.votes
            predicted += f"; {votes.pair_count} pairs in {votes.block_count} places, clear sun"
            predicted += f" {votes.sunny_probability:.2f}"
        notes.append(predicted)
    return tuple(notes)
