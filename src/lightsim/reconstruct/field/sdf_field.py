"""Neural field F: x -> (s, k_d) of hash grids and small MLPs (paper Sec. 3.1).

One grid and MLP represents the static background, another all actors, each in its box frame.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor, nn

from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.reconstruct.field.hash_grid.grid import HashGridSpec, hash_encode, make_table
from lightsim.reconstruct.field.prior_torch import TorchPrior
from lightsim.reconstruct.field.tsdf_prior import TsdfPrior

# The values below were not measured alone; training as a whole is
# (docs/benchmarks/reconstruction.md).

# Signed distance in metres outside the prior's observed space: free.
_OUTSIDE_M = 0.5
# Metres per unit of the head's first output: initial residuals are small.
_RESIDUAL_SCALE = 0.1
# Greatest difference from the prior, as a fraction of the truncation.
_RESIDUAL_REACH = 0.5

# Metres per unit of the position input of the heads: typical extents of a street and a vehicle.
_POSITION_SCALE = {"background": 50.0, "actors": 3.0}
# Exponent that approximates the sRGB curve: a gain on pixel values to this power is a gain on
# radiance.
_ENCODING_POWER = 2.2

# Width of the MLP heads.
_HIDDEN = 64
# Weight of the fused LiDAR at which the prior's confidence is 0.5.
_PRIOR_HALF_WEIGHT = 0.5


class SceneField(nn.Module):
    """Field of the background and all actors, with the camera gains and the sky of training.

    Args:
        config: sizes and switches.
        actor_ids: in the order of the log's actors; their numbers are the salts of the actors'
            grid.
        camera_names: in the order of the log's cameras.
        prior: fused LiDAR; None: no prior.
        generator: random numbers for the initial values.
    """

    def __init__(
        self,
        config: NeuralConfig,
        actor_ids: tuple[str, ...],
        camera_names: tuple[str, ...],
        prior: TsdfPrior | None,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.config = config
        self.actor_ids = actor_ids
        self.camera_names = camera_names
        self.prior = prior
        self.background_table = make_table(config.background_grid, generator)
        self.actor_table = make_table(config.actor_grid, generator)
        make_head = SeparateHeads if prior is None else _joint_head
        self.background_head = make_head(config.background_grid, generator)
        self.actor_head = make_head(config.actor_grid, generator)
        self.sky_head = mlp(15, 32, 3, generator)
        self.log_gains = nn.Parameter(torch.zeros(max(len(camera_names), 1), 3))
        # Initial sharpness 40/m: surfaces of a few centimetres.
        self.log_beta = nn.Parameter(torch.log(torch.tensor(40.0)))
        grids = [prior.actor(actor_id) if prior else (0, 0) for actor_id in actor_ids]
        own = prior.background if prior else (0, 0)
        # The last row is the background's, reached by actor number -1.
        self._moved_prior: TorchPrior | None = None
        self._grid_ranges = np.array([*grids, own], dtype=np.int32).reshape(-1, 2)

    @property
    def tables(self) -> tuple[nn.Parameter, nn.Parameter]:
        """Return the hash tables, which the sparse optimiser trains."""
        return self.background_table, self.actor_table

    @property
    def dense_parameters(self) -> list[nn.Parameter]:
        """Return all other trained parameters."""
        tables = {id(table) for table in self.tables}
        return [p for p in self.parameters() if id(p) not in tables]

    @property
    def beta(self) -> Float[Tensor, ""]:
        """Return the sharpness of surfaces, 1/m."""
        return torch.exp(self.log_beta)

    def forward(
        self, points: Float[Tensor, "n 3"], actor: Int[Tensor, " n"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Return signed distance [m], colour, residual on the prior [m], and prior confidence.

        Args:
            points: metres, frame `world` for the background, else the frame of their actor.
            actor: number of the actor of each point, -1 for the background.
        """
        output = points.new_zeros((len(points), 4))
        is_actor = actor >= 0
        for rows, table, head, spec, name in (
            (
                ~is_actor,
                self.background_table,
                self.background_head,
                self.config.background_grid,
                "background",
            ),
            (is_actor, self.actor_table, self.actor_head, self.config.actor_grid, "actors"),
        ):
            index = torch.nonzero(rows).squeeze(1)
            if len(index) == 0:
                continue
            own = points if len(index) == len(points) else points[index]
            salt = None if name == "background" else actor[index].to(torch.int64) + 1
            features = hash_encode(own, table, spec, salt=salt)
            if self.prior is not None:
                features = torch.cat([features, own / _POSITION_SCALE[name]], dim=1)
            found = head(features)
            output = found if len(index) == len(points) else output.index_copy(0, index, found)
        base, confidence, reach = self._base(points, actor)
        # Bounded, so that noise cannot change the sign far from the prior's surface.
        residual = reach * torch.tanh(_RESIDUAL_SCALE * output[:, 0] / reach)
        return base + residual, torch.sigmoid(output[:, 1:]), residual, confidence

    def _base(
        self, points: Float[Tensor, "n 3"], actor: Int[Tensor, " n"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Prior distance [m], its confidence in [0, 1], and the greatest residual [m]."""
        outside = torch.full_like(points[:, 0], _OUTSIDE_M)
        if self.prior is None:
            # A reach of 1 km does not limit the field.
            return outside, torch.zeros_like(outside), torch.full_like(outside, 1e3)
        # The prior is constant in training; on the CPU its look-up is compiled.
        if points.device.type == "cpu":
            ranges = self._grid_ranges[actor.numpy()]
            found = torch.from_numpy(self.prior.look_up(points.detach().numpy(), ranges))
        else:
            ranges = torch.from_numpy(self._grid_ranges).to(points.device)[actor]
            found = self._prior_on(points.device).look_up(points.detach(), ranges)
        sdf, weight, truncation = found.unbind(dim=1)
        confidence = weight / (weight + _PRIOR_HALF_WEIGHT)
        is_known = weight > 0
        reach = torch.where(is_known, _RESIDUAL_REACH * truncation, outside)
        return torch.where(is_known, sdf, outside), confidence, reach

    def _prior_on(self, device: torch.device) -> TorchPrior:
        if self._moved_prior is None:
            assert self.prior is not None
            self._moved_prior = TorchPrior(self.prior.stack, device)
        return self._moved_prior

    def pixel_colour(
        self, colour: Float[Tensor, "r 3"], camera: Int[Tensor, " r"]
    ) -> Float[Tensor, "r 3"]:
        """Apply each camera's gain to sRGB colours; the mean log gain is 0."""
        if not self.config.has_camera_gains:
            return colour
        gains = self.log_gains - self.log_gains.mean(dim=0, keepdim=True)
        return colour * torch.exp(gains)[camera]

    def radiance_gains(self) -> dict[str, Float32[np.ndarray, "3"]]:
        """Return the estimated gains as factors on linear radiance, by camera name."""
        logs = (self.log_gains - self.log_gains.mean(dim=0, keepdim=True)).detach().cpu().numpy()
        if not self.config.has_camera_gains:
            logs = np.zeros_like(logs)
        gains = np.exp(_ENCODING_POWER * logs).astype(np.float32)
        return {name: gains[i] for i, name in enumerate(self.camera_names)}

    def sky(self, direction: Float[Tensor, "r 3"]) -> Float[Tensor, "r 3"]:
        """Return the sRGB colour of the sky by direction, for training only."""
        return torch.sigmoid(self.sky_head(_direction_features(direction)))


class SeparateHeads(nn.Module):
    """Heads f_s and f_kd of the paper (Sec. 3.3): two MLPs of grid features.

    The appendix names "only grid features as input". Separate MLPs make the surface independent of
    the colour.

    Args:
        spec: size of the grid.
        generator: random numbers for the initial values.
    """

    def __init__(self, spec: HashGridSpec, generator: torch.Generator) -> None:
        super().__init__()
        self.distance = mlp(spec.output_dim, _HIDDEN, 1, generator)
        self.colour = mlp(spec.output_dim, _HIDDEN, 3, generator)

    def forward(self, features: Float[Tensor, "n f"]) -> Float[Tensor, "n 4"]:
        """Return unscaled signed distance and colour."""
        return torch.cat([self.distance(features), self.colour(features)], dim=1)


def _joint_head(spec: HashGridSpec, generator: torch.Generator) -> nn.Sequential:
    """MLP from features and position to (residual, colour), with initial residual 0."""
    head = mlp(spec.output_dim + 3, _HIDDEN, 4, generator)
    last = head[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight[0].zero_()
        last.bias.zero_()
    return head


def mlp(inputs: int, hidden: int, outputs: int, generator: torch.Generator) -> nn.Sequential:
    """Make an MLP of one hidden layer with He initialisation."""
    first, last = nn.Linear(inputs, hidden), nn.Linear(hidden, outputs)
    with torch.no_grad():
        for layer in (first, last):
            layer.weight.normal_(0.0, (2.0 / layer.in_features) ** 0.5, generator=generator)
            layer.bias.zero_()
    return nn.Sequential(first, nn.ReLU(inplace=True), last)


def _direction_features(direction: Float[Tensor, "r 3"]) -> Float[Tensor, "r 15"]:
    """Directions with their sines and cosines at two frequencies."""
    waves = [f(k * direction) for k in (2.0, 6.0) for f in (torch.sin, torch.cos)]
    return torch.cat([direction, *waves], dim=1)
