"""The compiled hash grid and its optimiser against plain torch."""

from __future__ import annotations

import math

import pytest
import torch

from lightsim.errors import InputError
from lightsim.reconstruct.field.hash_grid.grid import (
    HashGridSpec,
    Implementation,
    encode_plainly,
    hash_encode,
    make_table,
)
from lightsim.reconstruct.field.hash_grid.sparse_adam import SparseAdam

SPEC = HashGridSpec(levels=5, features=2, log2_entries=10, coarsest_m=4.0, finest_m=0.1)


def _batch(spec: HashGridSpec, count: int = 700) -> tuple[torch.Tensor, torch.nn.Parameter]:
    generator = torch.Generator().manual_seed(1)
    points = torch.rand((count, 3), generator=generator) * 60.0 - 30.0
    table = make_table(spec, generator)
    return points, torch.nn.Parameter(table.detach() * 1e4)


def _gradients(
    implementation: Implementation,
    points: torch.Tensor,
    table: torch.Tensor,
    spec: HashGridSpec,
    salt: torch.Tensor | None,
) -> list[torch.Tensor]:
    points, table = points.clone().requires_grad_(), table.detach().clone().requires_grad_()
    features = hash_encode(points, table, spec, salt=salt, implementation=implementation)
    upstream = torch.randn(features.shape, generator=torch.Generator().manual_seed(2))
    features.backward(upstream.to(features.device))
    gradients = [tensor.grad for tensor in (points, table) if tensor.grad is not None]
    return [features.detach(), *gradients]


def _assert_close(got: torch.Tensor, expected: torch.Tensor, relative: float = 1e-4) -> None:
    assert (got - expected).abs().max() <= relative * expected.abs().max()


@pytest.mark.parametrize("features", [1, 2, 4])
@pytest.mark.parametrize("has_salt", [False, True])
def test_compiled_features_and_gradients_are_those_of_plain_torch(features: int, has_salt: bool):
    spec = HashGridSpec(levels=5, features=features, log2_entries=10)
    points, table = _batch(spec)
    salt = torch.arange(len(points)) % 5 if has_salt else None
    for got, expected in zip(
        _gradients("numba", points, table, spec, salt),
        _gradients("torch", points, table, spec, salt),
        strict=True,
    ):
        _assert_close(got, expected)


def test_slopes_are_those_of_finite_differences():
    spec = HashGridSpec(levels=2, features=2, log2_entries=4, coarsest_m=2.0, finest_m=0.3)
    points, table = _batch(spec, 6)
    doubled = points.double().requires_grad_(), table.detach().double().requires_grad_()
    assert torch.autograd.gradcheck(lambda p, t: encode_plainly(p, t, spec), doubled)


def test_each_salt_has_its_own_grid():
    points, table = _batch(SPEC, 50)
    none, zero, one = (
        hash_encode(points, table, SPEC, salt=salt)
        for salt in (None, torch.zeros(50, dtype=torch.int64), torch.ones(50, dtype=torch.int64))
    )
    assert torch.equal(none, zero)
    assert ((one - zero).abs().amax(dim=1) > 1e-3).all()


def test_features_join_at_cell_borders_and_reproduce_the_entry_at_corners():
    spec = HashGridSpec(levels=1, features=2, log2_entries=10, coarsest_m=0.5, finest_m=0.5)
    _, table = _batch(spec)
    at_origin = hash_encode(torch.zeros((1, 3)), table, spec)
    assert torch.equal(at_origin[0], table[0])
    below = hash_encode(torch.full((1, 3), -1e-7), table, spec)
    _assert_close(below, at_origin, 1e-5)


@pytest.mark.parametrize("implementation", ["torch", "numba"])
def test_two_calls_before_a_step_add_up(implementation: Implementation):
    points, table = _batch(SPEC)
    together, apart = table.clone().detach(), table.clone().detach()
    for values, parts in ((together, [points]), (apart, [points[:300], points[300:]])):
        parameter = torch.nn.Parameter(values)
        optimiser = SparseAdam(parameter, learning_rate=0.1)
        for part in parts:
            hash_encode(
                part, parameter, SPEC, implementation=implementation
            ).square().sum().backward()
        optimiser.step()
        values.copy_(parameter.detach())
    assert not torch.equal(together, table)
    _assert_close(apart, together)


@pytest.mark.parametrize("implementation", ["torch", "numba"])
def test_sparse_adam_is_adam_where_every_value_has_a_gradient(implementation: Implementation):
    spec = HashGridSpec(levels=2, features=2, log2_entries=4)
    points, table = _batch(spec, 2000)
    reference = torch.nn.Parameter(table.detach().clone())
    adam = torch.optim.Adam([reference], lr=0.01, betas=(0.9, 0.99), eps=1e-15)
    optimiser = SparseAdam(table, learning_rate=0.5, betas=(0.9, 0.99))
    for step in range(5):
        target = math.sin(step)
        (
            hash_encode(points, table, spec, implementation=implementation) - target
        ).square().sum().backward()
        optimiser.param_groups[0]["lr"] = 0.01
        optimiser.step()
        adam.zero_grad()
        (encode_plainly(points, reference, spec) - target).square().sum().backward()
        adam.step()
    _assert_close(table.detach(), reference.detach())
    assert table.grad is None


def test_untouched_entries_and_their_moments_stay():
    points, table = _batch(SPEC, 5)
    before = table.detach().clone()
    optimiser = SparseAdam(table, learning_rate=0.1)
    hash_encode(points, table, SPEC).sum().backward()
    is_touched = optimiser.gradient.values != 0
    optimiser.step()
    assert torch.equal(table.detach() != before, is_touched)
    assert 0 < is_touched.sum() <= 5 * 8 * SPEC.levels * SPEC.features
    moved, first = table.detach().clone(), optimiser.first_moment.clone()
    assert not optimiser.gradient.values.any()
    optimiser.step()
    assert torch.equal(table.detach(), moved)
    assert torch.equal(optimiser.first_moment, first)


def _train(threads: int, resume_at: int | None = None) -> torch.Tensor:
    points, table = _batch(SPEC)
    optimiser = SparseAdam(table, learning_rate=0.05)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    for step in range(6):
        if step == resume_at:
            state = {
                k: v.clone() if torch.is_tensor(v) else v for k, v in optimiser.state_dict().items()
            }
            table = torch.nn.Parameter(table.detach().clone())
            optimiser = SparseAdam(table, learning_rate=1.0)
            optimiser.load_state_dict(state)
        hash_encode(points, table, SPEC).cos().sum().backward()
        optimiser.step()
    torch.set_num_threads(before)
    return table.detach()


def test_the_result_depends_neither_on_threads_nor_on_resuming():
    assert torch.equal(_train(1), _train(1))
    assert torch.equal(_train(1), _train(3))
    assert torch.equal(_train(2), _train(2, resume_at=3))


def test_state_of_another_table_is_refused():
    optimiser = SparseAdam(_batch(SPEC)[1], learning_rate=0.1)
    other = SparseAdam(_batch(HashGridSpec(levels=2, log2_entries=4))[1], learning_rate=0.1)
    with pytest.raises(InputError, match="does not fit the table"):
        optimiser.load_state_dict(other.state_dict())


def test_no_points_give_no_features():
    _, table = _batch(SPEC)
    points = torch.zeros((0, 3), requires_grad=True)
    features = hash_encode(points, table, SPEC)
    features.sum().backward()
    assert features.shape == (0, SPEC.output_dim)
    assert points.grad is not None
    assert points.grad.shape == (0, 3)


def test_wrong_input_is_refused_in_one_sentence():
    points, table = _batch(SPEC)
    with pytest.raises(InputError, match=r"points, got torch.float64.*points.float\(\)"):
        hash_encode(points.double(), table, SPEC)
    with pytest.raises(InputError, match="does not fit its settings"):
        hash_encode(points, table, HashGridSpec())
    with pytest.raises(InputError, match="does not run on this device"):
        hash_encode(points, table, SPEC, implementation="triton")
    with pytest.raises(InputError, match="impossible size"):
        HashGridSpec(finest_m=-1.0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("features", [2, 3])
def test_triton_gives_what_plain_torch_gives(features: int):
    spec = HashGridSpec(levels=5, features=features, log2_entries=10)
    points, table = (tensor.detach().cuda() for tensor in _batch(spec))
    salt = torch.arange(len(points), device="cuda") % 5
    for got, expected in zip(
        _gradients("triton", points, table, spec, salt),
        _gradients("torch", points, table, spec, salt),
        strict=True,
    ):
        _assert_close(got, expected)
    stepped = []
    for implementation in ("triton", "torch"):
        parameter = torch.nn.Parameter(table.clone())
        optimiser = SparseAdam(parameter, learning_rate=0.1)
        for _ in range(2):
            features_of = hash_encode(points, parameter, spec, implementation=implementation)
            features_of.square().sum().backward()
            optimiser.step()
        stepped.append(parameter.detach())
    _assert_close(stepped[0], stepped[1], 1e-3)
