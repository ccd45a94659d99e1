"""Multi-resolution hash grid: trained features of points, interpolated from a table of entries.

Three implementations yield equal features and gradients: plain torch (the readable one, and the
reference in the tests), compiled loops on the CPU (numba: no compiler required), Triton on CUDA.

References: Mueller et al., Instant neural graphics primitives (doi:10.1145/3528223.3530127),
section 3; used by UniSim (doi:10.1109/CVPR52729.2023.00140) and LightSim for the scene field.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any, Literal

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from lightsim.errors import InputError
from lightsim.reconstruct.field.hash_grid import cpu as hash_grid_cpu
from lightsim.reconstruct.field.hash_grid.sparse_gradient import (
    SparseGradient,
    new_sparse_gradient,
    sparse_gradient_of,
    zeros_on,
)
from lightsim.reconstruct.field.hash_grid.spec import PRIMES, SALT_PRIME, HashGridSpec

Implementation = Literal["auto", "torch", "numba", "triton"]


def make_table(
    spec: HashGridSpec, generator: torch.Generator, device: torch.device | str = "cpu"
) -> torch.nn.Parameter:
    """Make a table [levels * entries, features], uniform in +-1e-4 (Mueller et al., section 4).

    The generator is on the CPU, so that a seed yields one table on every device.
    """
    table = zeros_on("cpu", spec.table_shape())
    table.uniform_(-1e-4, 1e-4, generator=generator)
    return torch.nn.Parameter(table.to(device))


def hash_encode(
    points: Float[Tensor, "n 3"],
    table: Float[Tensor, "e f"],
    spec: HashGridSpec,
    *,
    salt: Int64[Tensor, "n"] | None = None,
    implementation: Implementation = "auto",
) -> Float[Tensor, "n d"]:
    """Return the features of points: trilinear means of the entries at the corners of their cells.

    Differentiable once, in the table and in the points. If `SparseAdam` manages the table, the
    compiled implementations add its gradient to `SparseAdam.gradient` and leave `table.grad` None;
    otherwise they write `table.grad` as usual.

    Args:
        points: float32, metres, any sign, up to 2^31 cells from the origin.
        table: float32, shape `spec.table_shape()`, level after level.
        spec: size of the grid.
        salt: number of each point's grid: several grids, such as those of actors, can use one
            table. None is 0 for all.
        implementation: "auto" is numba on the CPU and Triton on CUDA.

    Returns:
        float32 [n, levels * features], coarsest level first.

    Raises:
        InputError: wrong type, shape or device, or an implementation for another device.
        MissingDependencyError: CUDA tensors without Triton.
    """
    _check(points, table, spec, salt)
    if implementation == "auto":
        implementation = "triton" if points.is_cuda else "numba"
    if implementation == "torch":
        return encode_plainly(points, table, spec, salt=salt)
    if (implementation == "triton") != points.is_cuda:
        raise InputError(
            f"the {implementation} hash grid does not run on this device",
            got=points.device,
            expected="cuda" if implementation == "triton" else "cpu",
            remedy='Use implementation="auto".',
        )
    sparse = sparse_gradient_of(table)
    arguments = points.contiguous(), table.contiguous(), salt, spec, sparse
    return _Encode.apply(*arguments)  # pyright: ignore[reportReturnType]


def encode_plainly(
    points: Float[Tensor, "n 3"],
    table: Float[Tensor, "e f"],
    spec: HashGridSpec,
    *,
    salt: Int64[Tensor, "n"] | None = None,
) -> Float[Tensor, "n d"]:
    """Encode as `hash_encode`, in plain torch and any float type: the definition of the grid."""
    size = 2**spec.log2_entries
    corners = torch.tensor([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)], device=points.device)
    grids = table.reshape(spec.levels, size, spec.features).unbind()
    outputs = []
    for grid, cells_per_m in zip(grids, spec.cells_per_m().tolist(), strict=True):
        scaled = points * cells_per_m
        cell = torch.floor(scaled.detach())
        inside = scaled - cell
        total = points.new_zeros((len(points), spec.features))
        for corner in corners:
            weight = torch.where(corner.bool(), inside, 1.0 - inside).prod(dim=1, keepdim=True)
            entry = _hash(cell.long() + corner, salt) % size
            total = total + weight * grid.index_select(0, entry)
        outputs.append(total)
    return torch.cat(outputs, dim=1)


def _hash(corner: Int64[Tensor, "n 3"], salt: Int64[Tensor, "n"] | None) -> Int64[Tensor, "n"]:
    mixed = corner[:, 0] * PRIMES[0] ^ corner[:, 1] * PRIMES[1] ^ corner[:, 2] * PRIMES[2]
    return mixed if salt is None else mixed ^ salt * SALT_PRIME


class _Encode(torch.autograd.Function):
    """Autograd function of the compiled implementation on the device of contiguous tensors."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        table: Tensor,
        salt: Tensor | None,
        spec: HashGridSpec,
        sparse: SparseGradient | None,
    ) -> Tensor:
        """Return features [n, levels * features] of points [n, 3] in metres."""
        ctx.save_for_backward(points, table, salt)
        ctx.spec, ctx.sparse = spec, sparse
        return _backend(points).look_up(points, table, salt, spec)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] - decorated
        ctx: Any, *upstreams: Tensor
    ) -> tuple[Tensor | None, ...]:
        """Return the gradients of points and table; None for a table with a sparse gradient."""
        points, table, salt = ctx.saved_tensors
        upstream = upstreams[0].contiguous()
        backend = _backend(points)
        to_points = to_table = None
        if ctx.needs_input_grad[0]:
            to_points = backend.point_gradient(points, table, salt, ctx.spec, upstream)
        if ctx.needs_input_grad[1]:
            sparse = ctx.sparse
            if sparse is None:
                sparse = new_sparse_gradient(table)
                to_table = sparse.values
            backend.scatter(points, salt, ctx.spec, upstream, sparse)
        return to_points, to_table, None, None, None


def _backend(points: Tensor) -> ModuleType:
    """Module of compiled loops for a device: look_up, scatter, point_gradient."""
    if not points.is_cuda:
        return hash_grid_cpu
    from lightsim.reconstruct.field.hash_grid import triton_kernels

    return triton_kernels


def _check(points: Tensor, table: Tensor, spec: HashGridSpec, salt: Tensor | None) -> None:
    for name, tensor in (("points", points), ("table", table)):
        if tensor.dtype != torch.float32:
            raise InputError(
                f"the hash grid requires single precision {name}",
                got=tensor.dtype,
                expected="torch.float32",
                remedy=f"Convert with {name}.float().",
            )
    if tuple(table.shape) != spec.table_shape():
        raise InputError(
            "the hash table does not fit its settings",
            got=tuple(table.shape),
            expected=spec.table_shape(),
            remedy="Make it with make_table(spec, ...).",
        )
    others = [table] if salt is None else [table, salt]
    if any(tensor.device != points.device for tensor in others):
        raise InputError(
            "points, table and salt of the hash grid are on several devices",
            got=[str(tensor.device) for tensor in (points, *others)],
            expected="one device",
            remedy="Move them with .to(device).",
        )
