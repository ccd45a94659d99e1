"""Evidence of the sky matte per region: log-odds of small regions, and agreement of neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

# Numbers of this module were chosen on synthetic streets with known sky; tests/masks has the cases
# that must not fail. Sensitivity to each number is not measured.

# Largest log-odds of a region; neighbours cannot change the sign of a region at this limit.
LOG_ODDS_LIMIT = 8.0
# CIE Lab step over two pixels at which the agreement of two regions falls to 1/e.
_EDGE_CONTRAST = 4.0
# Weight of the agreement between neighbours against a region's own evidence.
_SMOOTHING = 1.5
# Cells of the colour histogram along L*, a* and b*, 5 units wide.
_HISTOGRAM_SHAPE = (20, 24, 24)
# Least elevation of pixels for the colours of surfaces: lower ones are not confused with sky.
_LOWEST_DEG = -10.0
# Fewest pixels of sky, and of surfaces, for statistics of their colours.
_LEAST_COLOURS = 200


@dataclass(frozen=True, eq=False)
class ImageEvidence:
    """Evidence of each pixel at working width.

    Args:
        lab: colour, CIE L*a*b* (D65).
        directions_world: unit vector of the pixel's ray.
        elevation_deg: angle of the ray above the horizontal.
        has_hit: True if a LiDAR return lies in the pixel.
        is_scanned: True below the certain upper limit of the LiDAR's field of view.
        is_silent: True inside the LiDAR's field of view without a return nearby.
        is_excluded: True for the ego vehicle, and below the horizon.
    """

    lab: Float32[np.ndarray, "h w 3"]
    directions_world: Float32[np.ndarray, "h w 3"]
    elevation_deg: Float32[np.ndarray, "h w"]
    has_hit: Bool[np.ndarray, "h w"]
    is_scanned: Bool[np.ndarray, "h w"]
    is_silent: Bool[np.ndarray, "h w"]
    is_excluded: Bool[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class RegionGraph:
    """Neighbouring regions (i < j), and the length of their common border without an edge."""

    area_px: Float[np.ndarray, " n"]
    i: Int[np.ndarray, " e"]
    j: Int[np.ndarray, " e"]
    agreement_px: Float[np.ndarray, " e"]


def region_graph(
    labels: Int[np.ndarray, "h w"],
    lab: Float32[np.ndarray, "h w 3"],
    expected_lab: Float32[np.ndarray, "h w 3"] | None = None,
) -> RegionGraph:
    """Return the adjacency of the regions, weighted by their agreement.

    Each border pixel counts exp(-(step / `_EDGE_CONTRAST`)^2) for a colour step across the border.
    The sum is multiplied by its mean along the border, so that a few gaps in an edge do not connect
    two regions, and decreases with the difference of the regions' mean colours.

    Args:
        labels: region of each pixel.
        lab: colour of each pixel.
        expected_lab: sky colour of each pixel's direction, NaN if unknown. Steps of the sky itself
            (outlines of clouds) are subtracted. A region must not contain known and unknown pixels.
    """
    known = np.full_like(lab, np.nan) if expected_lab is None else expected_lab
    count = int(labels.max()) + 1
    pairs, weights = [], []
    for axis in (0, 1):
        # Pixels at a distance of two, because the lens blurs an edge over more than one.
        a, b = _shifted(labels, axis)
        is_border = a != b
        before, after = _shifted(lab, axis)
        known_before, known_after = _shifted(known, axis)
        expected = np.nan_to_num(known_before[is_border] - known_after[is_border])
        step = np.linalg.norm(before[is_border] - after[is_border] - expected, axis=-1)
        pairs.append(np.stack([a[is_border], b[is_border]], axis=1))
        # Both pixels next to a border are found, hence the half.
        weights.append(0.5 * np.exp(-((step / _EDGE_CONTRAST) ** 2)))
    ordered = np.sort(np.concatenate(pairs), axis=1)
    keys, inverse = np.unique(ordered[:, 0] * count + ordered[:, 1], return_inverse=True)
    # Without any border, np.bincount would return integers.
    agreement = np.bincount(inverse, np.concatenate(weights), len(keys)).astype(np.float64)
    agreement *= agreement / (0.5 * np.bincount(inverse, minlength=len(keys)))
    i, j = keys // count, keys % count
    mean = RegionMean(labels)
    colour, own = (np.stack([mean(x[..., k]) for k in range(3)], axis=1) for x in (lab, known))
    difference = np.linalg.norm(colour[i] - colour[j] - np.nan_to_num(own[i] - own[j]), axis=1)
    agreement *= np.exp(-((difference / (4.0 * _EDGE_CONTRAST)) ** 2))
    area = np.bincount(labels.ravel(), minlength=count).astype(np.float64)
    return RegionGraph(area, i, j, agreement)


def _shifted(array: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    return (array[:-2], array[2:]) if axis == 0 else (array[:, :-2], array[:, 2:])


def region_log_odds(
    labels: Int[np.ndarray, "h w"], evidence: ImageEvidence
) -> Float[np.ndarray, " n"]:
    """Return the log-odds of sky of each region, from its own pixels only."""
    mean = RegionMean(labels)
    has_lidar = bool(evidence.has_hit.any())
    odds = np.clip(mean(_colour_log_odds(evidence)), -3.0, 4.0)
    odds -= np.clip((mean(_texture(evidence.lab)) - 2.0) / 2.0, -0.5, 2.0)
    elevation = mean(evidence.elevation_deg)
    odds += np.clip((elevation - 8.0) / 8.0, -1.0, 1.5)
    if has_lidar:
        odds -= np.minimum(LOG_ODDS_LIMIT, _hit_density(labels, evidence) / 0.01)
        odds += 3.5 * mean(evidence.is_silent)
        odds -= 2.5 * mean(_under_hits(evidence.has_hit))
    odds[mean(evidence.is_excluded) > 0.5] = -LOG_ODDS_LIMIT
    return np.clip(odds, -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT)


def _hit_density(
    labels: Int[np.ndarray, "h w"], evidence: ImageEvidence
) -> Float[np.ndarray, " n"]:
    """Return the LiDAR returns per scanned pixel of each region.

    The density is about 0.06 on a wall with a 64-beam LiDAR. It is relative to the scanned pixels,
    because walls extend above the LiDAR's field of view. Returns at a region's border may belong to
    a wire or roof beside it, so only the interior of a region counts if it is large enough.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    inside = np.asarray(maximum_filter(labels, 5) == minimum_filter(labels, 5))
    is_scanned = evidence.is_scanned | evidence.has_hit
    count = int(labels.max()) + 1
    inner = np.bincount(labels[inside], minlength=count)
    density = np.zeros((2, count))
    for row, part in enumerate((np.ones_like(inside), inside)):
        hits = np.bincount(labels[part & evidence.has_hit], minlength=count)
        scanned = np.bincount(labels[part & is_scanned], minlength=count)
        area = np.bincount(labels[part], minlength=count)
        density[row] = hits / np.maximum(np.maximum(scanned, 0.15 * area), 1)
    return np.where(inner >= 40, density[1], density[0])


def _colour_log_odds(evidence: ImageEvidence) -> Float[np.ndarray, "h w"]:
    """Return log-odds of sky by colour: brighter than the ground or blue, not green or brown."""
    lightness, green_red, blue_yellow = np.moveaxis(evidence.lab, -1, 0)
    is_ground = evidence.has_hit | (evidence.elevation_deg < 0.0)
    ground = lightness[is_ground]
    reference = float(np.percentile(ground, 75)) if ground.size > 100 else 45.0
    brightness = np.clip((lightness - np.clip(reference, 25.0, 75.0)) / 10.0, -1.5, 3.0)
    blueness = np.clip((-blue_yellow - 3.0) / 5.0, -0.5, 3.5)
    foliage = np.clip((np.maximum(blue_yellow, 0) - green_red - 12.0) / 6.0, 0.0, 3.0)
    chroma = np.hypot(green_red, np.maximum(blue_yellow, 0.0))
    # Colours of paint and soil count against sky, unless bright: a low sun turns clouds yellow.
    paint = np.clip((chroma - 15.0) / 6.0, 0.0, 3.0) * np.clip((92.0 - lightness) / 20.0, 0.0, 1.0)
    return brightness + blueness - np.maximum(foliage, paint)


def _texture(lab: Float32[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """Return the mean absolute lightness step of the neighbourhood, in L* per pixel."""
    from scipy.ndimage import uniform_filter

    rows = np.abs(np.diff(lab[..., 0], axis=0, append=lab[-1:, :, 0]))
    columns = np.abs(np.diff(lab[..., 0], axis=1, append=lab[:, -1:, 0]))
    return uniform_filter(rows + columns, size=5)


def _under_hits(has_hit: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return True for pixels below a surface with LiDAR returns: windows rather than sky.

    Four rows within a tenth of the image's height must have returns, which excludes wires.
    """
    from scipy.ndimage import maximum_filter1d

    rows = max(8, has_hit.shape[0] // 10)
    wide = maximum_filter1d(has_hit, size=5, axis=1)
    above = np.cumsum(wide, axis=0)
    recent = above - np.pad(above, ((rows, 0), (0, 0)))[: len(above)]
    return np.logical_or.accumulate(recent >= 4, axis=0)


@dataclass(frozen=True, eq=False)
class ColourCounts:
    """Colour histograms of pixels that are certainly sky, and of pixels that certainly are not."""

    sky: Float[np.ndarray, " c"]
    ground: Float[np.ndarray, " c"]

    @staticmethod
    def of(
        evidence: ImageEvidence, is_sky: Bool[np.ndarray, "h w"], is_ground: Bool[np.ndarray, "h w"]
    ) -> ColourCounts:
        """Count colours of one image: of sky pixels without a LiDAR return, and of ground pixels
        above `_LOWEST_DEG`."""
        bins = colour_bins(evidence.lab)
        is_sky = is_sky & ~evidence.has_hit
        is_ground = is_ground & (evidence.elevation_deg > _LOWEST_DEG)
        size = int(np.prod(_HISTOGRAM_SHAPE))
        sky, ground = (
            np.bincount(bins[chosen], minlength=size).astype(np.float64)
            for chosen in (is_sky, is_ground)
        )
        return ColourCounts(sky, ground)

    def __add__(self, other: ColourCounts) -> ColourCounts:
        return ColourCounts(self.sky + other.sky, self.ground + other.ground)

    @property
    def are_enough(self) -> bool:
        """True if both histograms have enough pixels."""
        return bool(min(self.sky.sum(), self.ground.sum()) >= _LEAST_COLOURS)

    def log_ratio(self) -> Float[np.ndarray, " c"]:
        """Return the log-likelihood ratio of sky against other surfaces, by colour."""
        sky, ground = (_density(counts) for counts in (self.sky, self.ground))
        return np.clip(np.log(sky / ground), -2.5, 2.5)


def with_colours(
    labels: Int[np.ndarray, "h w"],
    evidence: ImageEvidence,
    own: Float[np.ndarray, " n"],
    of_image: ColourCounts,
    of_log: ColourCounts | None,
    beside: Float[np.ndarray, "h w"] | float = 0.0,
) -> Float[np.ndarray, " n"]:
    """Return the log-odds `own` plus the evidence of the colours of sky and ground.

    Only the image's own sky is evidence for sky, since panes mirror the colours of the sky in other
    directions. Colours of the whole log, and of the certain sky nearby, are evidence against it.

    Args:
        labels: region of each pixel.
        evidence: evidence of each pixel.
        own: log-odds of each region without colour statistics.
        of_image: colours of this image.
        of_log: colours of the whole log.
        beside: log-likelihood ratio of each pixel from nearby certain sky, at most 0.
    """
    bins = colour_bins(evidence.lab)
    ratio = of_image.log_ratio()[bins] if of_image.are_enough else np.zeros(bins.shape)
    if of_log is not None and of_log.are_enough:
        against = of_log.log_ratio()[bins]
        ratio = np.where(against < 0, np.minimum(against, ratio), ratio)
    ratio = np.where(beside < 0, np.minimum(beside, ratio), ratio)
    odds = own + RegionMean(labels)(ratio)
    is_certain = own <= -LOG_ODDS_LIMIT + 1e-6
    return np.clip(np.where(is_certain, -LOG_ODDS_LIMIT, odds), -LOG_ODDS_LIMIT, LOG_ODDS_LIMIT)


def colour_bins(lab: Float32[np.ndarray, "h w 3"]) -> Int[np.ndarray, "h w"]:
    """Return the flat index of each pixel's cell in the colour histogram, 5 Lab units wide."""
    lightness = np.clip(lab[..., 0] / 5.0, 0, _HISTOGRAM_SHAPE[0] - 1).astype(np.int64)
    green_red = np.clip(lab[..., 1] / 5.0 + 12.0, 0, _HISTOGRAM_SHAPE[1] - 1).astype(np.int64)
    blue_yellow = np.clip(lab[..., 2] / 5.0 + 12.0, 0, _HISTOGRAM_SHAPE[2] - 1).astype(np.int64)
    return (lightness * _HISTOGRAM_SHAPE[1] + green_red) * _HISTOGRAM_SHAPE[2] + blue_yellow


def _density(counts: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
    """Return a smoothed density of colours, with a least value for unobserved ones."""
    from scipy.ndimage import gaussian_filter

    density = counts.reshape(_HISTOGRAM_SHAPE) / max(float(counts.sum()), 1.0)
    smooth = np.asarray(gaussian_filter(density, 1.0, mode="constant"))
    return smooth.ravel() + 1e-4


def smoothed_log_odds(graph: RegionGraph, own: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return log-odds smoothed over regions that agree (random walker with priors on regions,
    Grady 2006, doi:10.1109/TPAMI.2006.233).

    They minimise sum_i a_i (x_i - own_i)^2 + `_SMOOTHING` sum_ij b_ij (x_i - x_j)^2.
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import spsolve

    count = len(own)
    # The weight grows more slowly than the area, so that small regions with strong evidence (LiDAR
    # returns on a wall) can change large ones with weak evidence.
    weight = graph.area_px**0.75 * (0.2 + np.abs(own) / LOG_ODDS_LIMIT) ** 2
    rows = np.concatenate([graph.i, graph.j])
    columns = np.concatenate([graph.j, graph.i])
    agreement = np.tile(_SMOOTHING * graph.agreement_px, 2)
    links = coo_matrix((agreement, (rows, columns)), shape=(count, count))
    degree = np.asarray(links.sum(axis=1)).ravel()
    system = (diags(weight + degree) - links).tocsc()
    return np.asarray(spsolve(system, weight * own))


def keep_open_sky(
    labels: Int[np.ndarray, "h w"],
    log_odds: Float[np.ndarray, " n"],
    evidence: ImageEvidence,
    min_px: int,
) -> Float32[np.ndarray, "h w"]:
    """Return the probability of sky of each pixel; 0 in patches that are not open sky.

    A patch is open sky if 30 % of it has high log-odds and it touches the top of the image or has
    at least `min_px` pixels (a quarter of that at the top). This excludes small bright panes.
    """
    from skimage.measure import label

    odds = log_odds[labels]
    patches = np.asarray(label(odds > 0, connectivity=1))
    count = int(patches.max())
    index = np.arange(count + 1)
    size = np.bincount(patches.ravel(), minlength=count + 1)
    confident = np.bincount(patches.ravel(), (odds > 1.2).ravel(), minlength=count + 1)
    at_top = np.isin(index, patches[:2])
    is_kept = (confident > 0.3 * size) & ((at_top & (size >= min_px // 4)) | (size >= min_px))
    is_kept[0] = False
    probability = 1.0 / (1.0 + np.exp(-2.0 * odds))
    is_open = is_kept[patches] & ~evidence.is_excluded
    return np.where(is_open, probability, 0.0).astype(np.float32)


class RegionMean:
    """Function from pixel values to their means over the regions of one labelling."""

    def __init__(self, labels: Int[np.ndarray, "h w"]) -> None:
        self._flat = labels.ravel()
        self._area = np.maximum(np.bincount(self._flat), 1)

    def __call__(self, values: np.ndarray) -> Float[np.ndarray, " n"]:
        weights = values.ravel().astype(np.float64)
        return np.bincount(self._flat, weights, minlength=len(self._area)) / self._area
