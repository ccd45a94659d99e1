"""FID and KID: distances between the feature distributions of two unpaired sets of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from lightsim.build.quality.frames import FrameTask
from lightsim.errors import InputError
from lightsim.progress import Progress, SilentProgress
from lightsim_lab.metrics.inception import Inception

# Number of KID subsets, as usual since Binkowski et al. 2018 and in torchmetrics.
_KID_SUBSETS = 100
ALL = "all conditions"


@dataclass(frozen=True)
class SetRow:
    """Distances of one set of pictures from a reference set.

    Args:
        count, reference_count: numbers of pictures.
        kid, kid_std: mean and standard deviation over the subsets, not times 1000.
        kid_subset_size: pictures per subset; `kid_std` depends on it.
    """

    condition: str
    method: str
    count: int
    reference_count: int
    fid: float
    kid: float
    kid_std: float
    kid_subset_size: int

    @property
    def kid_text(self) -> str:
        """KID times 1000, as papers print it; without ± if a subset contains all pictures."""
        is_whole = self.kid_subset_size == self.count == self.reference_count
        std = "" if is_whole else f" ± {1000 * self.kid_std:.1f}"
        return f"{1000 * self.kid:.1f}{std} (subsets of {self.kid_subset_size})"


def compare_sets(
    names: tuple[str, str],
    features: Float64[np.ndarray, "n d"],
    reference: Float64[np.ndarray, "m d"],
    kid_subset_size: int,
) -> SetRow:
    """Compute FID and KID of one set, with KID subsets no larger than either set.

    Args:
        names: condition and method.
    """
    size = min(kid_subset_size, len(features), len(reference))
    # A fixed seed: the same pictures always give the same KID.
    mean, std = kid(reference, features, size, torch.Generator().manual_seed(0))
    distance = fid(features, reference)
    return SetRow(*names, len(features), len(reference), distance, mean, std, size)


def fid(features: Float64[np.ndarray, "n d"], reference: Float64[np.ndarray, "m d"]) -> float:
    """Return the Frechet inception distance (Heusel et al. 2017, arXiv:1706.08500, eq. 6).

    tr sqrt(S1 S2) is the sum of the singular values of A B^T for any factors S1 = A^T A and
    S2 = B^T B. This avoids the root of a singular matrix, so there may be fewer pictures than
    features. The measure is biased upwards for few pictures (a few thousand are usual).

    Raises:
        InputError: a set has fewer than two pictures.
    """
    _need_two(len(features), len(reference))
    shift = features.mean(axis=0) - reference.mean(axis=0)
    # Factors have at most as many rows as features, which bounds the time of the SVD.
    factors = [_covariance_factor(each) for each in (features, reference)]
    traces = sum(float(np.square(factor).sum()) for factor in factors)
    cross = np.linalg.svd(factors[0] @ factors[1].T, compute_uv=False).sum()
    return float(shift @ shift + traces - 2.0 * cross)


def _covariance_factor(features: Float64[np.ndarray, "n d"]) -> Float64[np.ndarray, "k d"]:
    """Return A with the fewest rows such that A^T A is the unbiased covariance."""
    centred = (features - features.mean(axis=0)) / np.sqrt(len(features) - 1)
    return centred if len(centred) <= centred.shape[1] else np.asarray(np.linalg.qr(centred, "r"))


def kid(
    reference: Float64[np.ndarray, "m d"],
    features: Float64[np.ndarray, "n d"],
    subset_size: int,
    generator: torch.Generator,
) -> tuple[float, float]:
    """Return mean and standard deviation of the kernel inception distance over random subsets.

    Unbiased squared MMD with the kernel (x y / d + 1)^3 (Binkowski et al. 2018, arXiv:1801.01401).

    Raises:
        InputError: a set has fewer than two pictures, or fewer than a subset.
    """
    _need_two(len(features), len(reference))
    if not 2 <= subset_size <= min(len(features), len(reference)):
        raise InputError(
            "the KID subsets do not fit the sets of pictures",
            where=f"--kid-subset-size {subset_size}",
            expected=f"2 to {min(len(features), len(reference))}",
        )
    values = []
    for _ in range(_KID_SUBSETS):
        chosen = [
            each[torch.randperm(len(each), generator=generator)[:subset_size].numpy()]
            for each in (reference, features)
        ]
        values.append(_squared_mmd(*chosen))
    return float(np.mean(values)), float(np.std(values))


def _squared_mmd(x: Float64[np.ndarray, "n d"], y: Float64[np.ndarray, "n d"]) -> float:
    n = len(x)
    xx, yy, xy = (np.power(a @ b.T / a.shape[1] + 1.0, 3) for a, b in ((x, x), (y, y), (x, y)))
    # Without the diagonal, which makes the estimate unbiased.
    within = xx.sum() - np.trace(xx) + yy.sum() - np.trace(yy)
    return float(within / (n * (n - 1)) - 2.0 * xy.mean())


def _need_two(*counts: int) -> None:
    if min(counts) < 2:
        raise InputError(
            "FID and KID need sets of pictures",
            got=f"{min(counts)} pictures",
            expected="2 or more each",
        )


def score_sets(
    tasks: Sequence[FrameTask],
    network: Inception,
    kid_subset_size: int,
    progress: Progress | None = None,
) -> tuple[SetRow, ...]:
    """Compare each method's frames with the true ones, by condition and over all conditions."""
    truths: dict[str, list[np.ndarray]] = {}
    made: dict[tuple[str, str], list[np.ndarray]] = {}
    for task in (progress or SilentProgress()).track(tasks, "features for FID", len(tasks)):
        methods = task.load_prediction_by_method
        pictures = [task.load_truth(), *(load() for load in methods.values())]
        # Truth and predictions of a frame form one batch: fewer, larger calls of the network.
        first, *others = network.features(pictures)
        for condition in (task.condition, ALL):
            truths.setdefault(condition, []).append(first)
            for method, features in zip(methods, others, strict=True):
                made.setdefault((condition, method), []).append(features)
    names = sorted(made, key=lambda name: (name[0] == ALL, name[0]))
    if len(truths) == 2:  # A single condition equals all conditions.
        names = [name for name in names if name[0] != ALL]
    return tuple(
        compare_sets(name, np.array(made[name]), np.array(truths[name[0]]), kid_subset_size)
        for name in names
        if len(made[name]) > 1
    )
