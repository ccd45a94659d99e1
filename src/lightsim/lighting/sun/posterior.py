"""Joint posterior of the sun's direction and of "clear sun or overcast", from all cues.

Cues (`cues`) are taken as independent given the sun: their log likelihoods are added on a grid of
directions of equal solid angle. The grid is refined around the mass until it resolves the mass.
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
from lightsim.lighting.sun.cues import Cue, EphemerisCue, ShadowCue, mask_at
from lightsim.lighting.sun.direction import SunDirection

# Sensitivity to the following constants was not measured.


# Spacing of the first grid, over the hemisphere, in degrees.
_SPACING_DEG = 2.0
# The grid is refined until the disc with 99 % of the mass has a radius above this many spacings.
_RESOLVED = 8.0
# Spacings along the radius of a refined grid.
_FINER_STEPS = 25
# Largest number of refinements.
_MAX_ROUNDS = 4
# Prior probability of a clear sun.
_SUNNY_PRIOR = 0.5


@dataclass(frozen=True, eq=False)
class SunPosterior:
    """Posterior of the sun's direction, with the estimate and its uncertainty.

    Args:
        grid_world: directions.
        mass: probability of each direction with a clear sun, and with an overcast sky; sums to 1.
        direction_world: the estimate: the direction of least expected angle to the sun, or the mode
            if requested.
        region_90_deg: radius about `direction_world` that contains 90 % of the mass.
        sunny_probability: probability of a sun that casts shadows.
        visible_probability: probability of a clear sun in an observed part of the sky.
        heading_correction_deg: azimuth by ephemeris minus estimated azimuth, clockwise; None
            without place, time and heading.
        heading_deg: azimuth of world +x, clockwise from north; None without place and time.
        notes: result of each cue alone.
    """

    grid_world: Float[np.ndarray, "n 3"]
    mass: Float64[np.ndarray, "n 2"]
    direction_world: Float[np.ndarray, "3"]
    region_90_deg: float
    sunny_probability: float
    visible_probability: float
    heading_correction_deg: float | None
    heading_deg: float | None
    notes: tuple[str, ...]

    @property
    def uncertainty_deg(self) -> float:
        """Standard deviation of each component of the direction's error, in degrees: of the
        isotropic normal density with the same 90 % disc."""
        # sqrt(-2 log 0.1) standard deviations: the radius of the 90 % disc.
        return self.region_90_deg / 2.146

    def probability_within(self, direction_world: Float[np.ndarray, "3"]) -> float:
        """Return the probability of directions nearer to the estimate than a given one. For true
        suns it is uniform in [0, 1] if the posterior is calibrated."""
        limit = float(self.direction_world @ direction_world)
        nearer = self.grid_world @ self.direction_world > limit
        return float(self.mass[nearer].sum())


def sun_posterior(
    cues: Sequence[Cue], panorama: Panorama | None, *, takes_mode: bool = False
) -> SunPosterior:
    """Return the posterior of the sun given cues; without cues, that of a uniform hemisphere.

    Args:
        cues: independent given the sun.
        panorama: observed sky, for `visible_probability`; None without one.
        takes_mode: the estimate is the mode; otherwise, the direction of least expected angle to
            the sun. The latter lies between several modes, and the horizon biases it upwards for a
            wide density.
    """
    grid = fibonacci_hemisphere(count_for_spacing(_SPACING_DEG))
    spacing_deg = _SPACING_DEG
    mass = _mass(cues, grid, spacing_deg)
    for _ in range(_MAX_ROUNDS):
        centre = _median_direction(grid, mass)
        # 99 % of the mass, with a margin of 30 %, so that the refined disc does not cut it off.
        reach_deg = _radius_deg(grid, mass, centre, 0.99)
        if reach_deg > _RESOLVED * spacing_deg:
            break
        radius_deg = max(1.3 * reach_deg, 2.5 * spacing_deg)
        spacing_deg = radius_deg / _FINER_STEPS
        disc = disc_directions(centre, radius_deg, round(np.pi * _FINER_STEPS**2))
        # Suns below 0.5 degrees of elevation contribute no light.
        grid = disc[disc[:, 2] > np.sin(np.radians(0.5))]
        mass = _mass(cues, grid, spacing_deg)
    mode = grid[int(mass.sum(axis=1).argmax())]
    centre = mode if takes_mode else _median_direction(grid, mass)
    correction_deg, heading_deg = _heading(cues, centre)
    visible = 0.0
    if panorama is not None:
        is_open = mask_at(panorama.is_sky & panorama.is_seen, grid)
        visible = float(mass[is_open, 0].sum())
    return SunPosterior(
        grid,
        mass,
        centre,
        max(_radius_deg(grid, mass, centre, 0.9), 0.5 * spacing_deg),
        float(mass[:, 0].sum()),
        visible,
        correction_deg,
        heading_deg,
        _notes(cues, centre),
    )


def sun_direction(posterior: SunPosterior, position: SolarPosition | None) -> SunDirection:
    """Return the estimate as a SunDirection; `position` is given if place and time are known."""
    found = azimuth_elevation(posterior.direction_world)
    is_known = position is not None and posterior.heading_correction_deg is not None
    origin = "gps+time" if is_known else ("image" if position is None else "time+image")
    summary = (
        f"sun: 90 % within {posterior.region_90_deg:.1f} degrees; clear with probability"
        f" {posterior.sunny_probability:.2f}, in the observed sky"
        f" {posterior.visible_probability:.2f}"
    )
    notes = [summary, *posterior.notes]
    if posterior.heading_correction_deg is not None:
        notes.append(f"heading corrected by {posterior.heading_correction_deg:+.2f} degrees")
    elif posterior.heading_deg is not None:
        notes.append(
            f"the heading is unknown: the estimated sun implies that world +x points"
            f" {posterior.heading_deg:.1f} degrees clockwise from north"
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
    """Normalised posterior mass of each direction, with a clear sun and with an overcast sky."""
    prior = np.log([_SUNNY_PRIOR, 1.0 - _SUNNY_PRIOR])
    log_mass = np.tile(prior, (len(grid), 1))
    for cue in cues:
        log_mass = log_mass + cue.log_likelihood(grid, 0.5 * spacing_deg)
    # The maximum is subtracted first, so that the exponentials do not overflow.
    mass = np.exp(log_mass - log_mass.max())
    return mass / mass.sum()


def _median_direction(
    grid: Float[np.ndarray, "n 3"], mass: Float64[np.ndarray, "n 2"]
) -> Float[np.ndarray, "3"]:
    """Direction of the grid with the least expected angle to the sun (geometric median)."""
    total = mass.sum(axis=1)
    order = np.argsort(total)[::-1]
    # Directions in the tail of the mass do not change the result; leaving them out saves time.
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
    """Radius around `centre` that contains a fraction of the mass, in degrees."""
    angle = np.degrees(np.arccos(np.clip(grid @ centre, -1, 1)))
    order = np.argsort(angle)
    reached = np.searchsorted(np.cumsum(mass.sum(axis=1)[order]), fraction)
    return float(angle[order[min(int(reached), len(order) - 1)]])


def _heading(
    cues: Sequence[Cue], direction_world: Float[np.ndarray, "3"]
) -> tuple[float | None, float | None]:
    """Return the correction of the log's heading, and the azimuth of world +x."""
    for cue in cues:
        if isinstance(cue, EphemerisCue):
            in_world = azimuth_elevation(direction_world).azimuth_deg
            # Azimuths in world axes take +y as north, so that world +x is at 90 degrees.
            heading_deg = (90.0 + cue.position.azimuth_deg - in_world) % 360.0
            if cue.geo.enu_from_world is None:
                return None, heading_deg
            in_enu = azimuth_elevation(cue.geo.enu_from_world.rotate(direction_world))
            off = cue.position.azimuth_deg - in_enu.azimuth_deg
            return float((off + 180.0) % 360.0 - 180.0), heading_deg
    return None, None


def _notes(cues: Sequence[Cue], centre: Float[np.ndarray, "3"]) -> tuple[str, ...]:
    """Notes on the result of each cue alone, relative to the joint estimate."""
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
            shadows = cue.likelihood
            predicted += (
                f"; {shadows.pair_count} pairs in {shadows.block_count} blocks, probability of a"
            )
            predicted += f" clear sun {shadows.sunny_probability:.2f}"
        notes.append(predicted)
    return tuple(notes)
