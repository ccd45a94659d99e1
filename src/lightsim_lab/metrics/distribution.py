"""FID and KID: how far the features of two sets of pictures lie apart, without pairing them."""

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

KID_SUBSETS = 100
ALL = "all conditions"


@dataclass(frozen=True)
class SetRow:
    """One set of pictures against a reference set.

    Args:
        count, reference_count: pictures of both.
        kid, kid_std: mean and standard deviation over the subsets, not times 1000.
        kid_subset_size: pictures of a subset: figures of different sizes have different spreads.
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
        """KID times 1000, as papers print it; without ± where a subset is all there is."""
        is_whole = self.kid_subset_size == self.count == self.reference_count
        spread = "" if is_whole else f" ± {1000 * self.kid_std:.1f}"
        return f"{1000 * self.kid:.1f}{spread} (subsets of {self.kid_subset_size})"


def compare_sets(
    names: tuple[str, str],
    features: Float64[np.ndarray, "n d"],
    reference: Float64[np.ndarray, "m d"],
    kid_subset_size: int,
) -> SetRow:
    """Both measures of one set, in a subset size that both sets can fill.

    Args:
        names: condition and method.
    """
    size = min(kid_subset_size, len(features), len(reference))
    mean, std = kid(reference, features, size, torch.Generator().manual_seed(0))
    distance = fid(features, reference)
    return SetRow(*names, len(features), len(reference), distance, mean, std, size)


def fid(features: Float64[np.ndarray, "n d"], reference: Float64[np.ndarray, "m d"]) -> float:
    """Frechet inception distance (Heusel et al. 2017, arXiv:1706.08500, eq. 6).

    tr sqrt(S1 S2) is the sum of the singular values of A B^T for any factors S1 = A^T A and
    S2 = B^T B: no root of a singular matrix is taken, so fewer pictures than features do no harm.
    The measure itself is biased upwards for few pictures (a few thousand are usual).

    Raises:
        InputError: a set has fewer than two pictures.
    """
    _need_two(len(features), len(reference))
    shift = features.mean(axis=0) - reference.mean(axis=0)
    factors = [_covariance_factor(each) for each in (features, reference)]
    traces = sum(float(np.square(factor).sum()) for factor in factors)
    cross = np.linalg.svd(factors[0] @ factors[1].T, compute_uv=False).sum()
    return float(shift @ shift + traces - 2.0 * cross)


def _covariance_factor(features: Float64[np.ndarray, "n d"]) -> Float64[np.ndarray, "k d"]:
    """A with A^T A the unbiased covariance, of as few rows as hold it."""
    centred = (features - features.mean(axis=0)) / np.sqrt(len(features) - 1)
    return centred if len(centred) <= centred.shape[1] else np.asarray(np.linalg.qr(centred, "r"))


def kid(
    reference: Float64[np.ndarray, "m d"],
    features: Float64[np.ndarray, "n d"],
    subset_size: int,
    generator: torch.Generator,
    subsets: int = KID_SUBSETS,
) -> tuple[float, float]:
    """Kernel inception distance, mean and standard deviation over random subsets (Binkowski et al.
    2018, arXiv:1801.01401): unbiased squared MMD with the kernel (x y / d + 1)^3.

    Raises:
        InputError: a set has fewer than two pictures, or fewer than a subset.
    """
    _need_two(len(features), len(reference))
    if not 2 <= subset_size <= min(len(features), len(reference)):
        raise InputError(
            "KID's subsets do not fit the sets of pictures",
            where=f"--kid-subset-size {subset_size}",
            expected=f"2 to {min(len(features), len(reference))}",
        )
    values = []
    for _ in range(subsets):
        chosen = [
            each[torch.randperm(len(each), generator=generator)[:subset_size].numpy()]
            for each in (reference, features)
        ]
        values.append(_squared_mmd(*chosen))
    return float(np.mean(values)), float(np.std(values))


def _squared_mmd(x: Float64[np.ndarray, "n d"], y: Float64[np.ndarray, "n d"]) -> float:
    n = len(x)
    xx, yy, xy = (np.power(a @ b.T / a.shape[1] + 1.0, 3) for a, b in ((x, x), (y, y), (x, y)))
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
    """Each method's frames against the true ones, under each condition and under all together."""
    truths: dict[str, list[np.ndarray]] = {}
    made: dict[tuple[str, str], list[np.ndarray]] = {}
    for task in (progress or SilentProgress()).track(tasks, "features for FID", len(tasks)):
        methods = task.load_prediction_by_method
        pictures = [task.load_truth(), *(load() for load in methods.values())]
        first, *others = network.features(pictures)
        for condition in (task.condition, ALL):
            truths.setdefault(condition, []).append(first)
            for method, features in zip(methods, others, strict=True):
                made.setdefault((condition, method), []).append(features)
    names = sorted(made, key=lambda name: (name[0] == ALL, name[0]))
    if len(truths) == 2:  # One condition is all conditions.
        names = [name for name in names if name[0] != ALL]
    return tuple(
        compare_sets(name, np.array(made[name]), np.array(truths[name[0]]), kid_subset_size)
        for name in names
        if len(made[name]) > 1
    )
