"""The neural field F: x -> (s, k_d): hash grids and small MLPs, one pair for the static background
and one for all actors, each actor in its own box frame (paper Sec. 3.1)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor, nn

from lightsim.reconstruct.field.config import NeuralConfig
from lightsim.reconstruct.field.hash_grid.grid import HashGridSpec, hash_encode, make_table
from lightsim.reconstruct.field.prior_torch import TorchPrior
from lightsim.reconstruct.field.tsdf_prior import TsdfPrior

# Signed distance where neither prior nor training says anything: free.
_OUTSIDE_M = 0.5
_RESIDUAL_SCALE = 0.1
# Fraction of the truncation by which the field may differ from the prior.
_RESIDUAL_REACH = 0.5
_FREE_REACH_M = 1e3
_POSITION_SCALE = {"background": 50.0, "actors": 3.0}
# The sRGB curve is close to this power: a gain on radiance is its root on pixel values.
_ENCODING_POWER = 2.2
_FIRST_BETA = 40.0


# Not measured alone; training as a whole is (docs/benchmarks/reconstruction.md).

# Width of the MLP heads.
_HIDDEN = 64
# Evidence at which the fused LiDAR counts half.
_PRIOR_HALF_WEIGHT = 0.5


class SceneField(nn.Module):
    """The compositional scene, with what is learned only for training: camera gains and a sky.

    Args:
        config: sizes and switches.
        actor_ids: in the order of the log's actors; their numbers salt the actors' grid.
        camera_names: in the order of the log's cameras.
        prior: fused LiDAR, None without.
        generator: of the initial values.
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
        self.log_beta = nn.Parameter(torch.log(torch.tensor(_FIRST_BETA)))
        grids = [prior.actor(actor_id) if prior else (0, 0) for actor_id in actor_ids]
        own = prior.background if prior else (0, 0)
        # The last row is the background's, reached by actor number -1.
        self._moved_prior: TorchPrior | None = None
        self._grid_ranges = np.array([*grids, own], dtype=np.int32).reshape(-1, 2)

    @property
    def tables(self) -> tuple[nn.Parameter, nn.Parameter]:
        """What the sparse optimiser trains."""
        return self.background_table, self.actor_table

    @property
    def dense_parameters(self) -> list[nn.Parameter]:
        """Everything else that is trained."""
        tables = {id(table) for table in self.tables}
        return [p for p in self.parameters() if id(p) not in tables]

    @property
    def beta(self) -> Float[Tensor, ""]:
        """Sharpness of surfaces, 1/m."""
        return torch.exp(self.log_beta)

    def forward(
        self, points: Float[Tensor, "n 3"], actor: Int[Tensor, " n"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Signed distance [m], colour, residual on the prior [m], and the prior's confidence.

        Args:
            points: metres, frame `world` for the background, else of each one's actor.
            actor: number of the actor, -1 for the background.
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
        # Bounded, so that space far from the prior's surface can never change sides by noise.
        residual = reach * torch.tanh(_RESIDUAL_SCALE * output[:, 0] / reach)
        return base + residual, torch.sigmoid(output[:, 1:]), residual, confidence

    def _base(
        self, points: Float[Tensor, "n 3"], actor: Int[Tensor, " n"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, " n"]]:
        """The prior's distance where it knows one, how sure it is of it (0 to 1), and how far the
        field may differ from it."""
        outside = torch.full_like(points[:, 0], _OUTSIDE_M)
        if self.prior is None:
            return outside, torch.zeros_like(outside), torch.full_like(outside, _FREE_REACH_M)
        # Constant as far as training is concerned; the look-up is compiled for the CPU.
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
        """What a camera makes of a colour: its gain, in the sRGB-encoded domain; mean gain 1."""
        if not self.config.has_camera_gains:
            return colour
        gains = self.log_gains - self.log_gains.mean(dim=0, keepdim=True)
        return colour * torch.exp(gains)[camera]

    def radiance_gains(self) -> dict[str, Float32[np.ndarray, "3"]]:
        """The learned gains as factors on linear radiance, by camera name."""
        logs = (self.log_gains - self.log_gains.mean(dim=0, keepdim=True)).detach().cpu().numpy()
        if not self.config.has_camera_gains:
            logs = np.zeros_like(logs)
        gains = np.exp(_ENCODING_POWER * logs).astype(np.float32)
        return {name: gains[i] for i, name in enumerate(self.camera_names)}

    def sky(self, direction: Float[Tensor, "r 3"]) -> Float[Tensor, "r 3"]:
        """Colour of the sky, for training only."""
        return torch.sigmoid(self.sky_head(_direction_features(direction)))


class SeparateHeads(nn.Module):
    """f_s and f_kd of the paper (Sec. 3.3): two MLPs that see the grid's features alone (appendix:
    "only grid features as input"), so that no surface depends on what it takes to colour it.

    Args:
        spec: of the grid.
        generator: of the initial values.
    """

    def __init__(self, spec: HashGridSpec, generator: torch.Generator) -> None:
        super().__init__()
        self.distance = mlp(spec.output_dim, _HIDDEN, 1, generator)
        self.colour = mlp(spec.output_dim, _HIDDEN, 3, generator)

    def forward(self, features: Float[Tensor, "n f"]) -> Float[Tensor, "n 4"]:
        """Signed distance and colour, neither scaled yet."""
        return torch.cat([self.distance(features), self.colour(features)], dim=1)


def _joint_head(spec: HashGridSpec, generator: torch.Generator) -> nn.Sequential:
    """Features and position to (residual, colour); starts at residual 0."""
    head = mlp(spec.output_dim + 3, _HIDDEN, 4, generator)
    last = head[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        last.weight[0].zero_()
        last.bias.zero_()
    return head


def mlp(inputs: int, hidden: int, outputs: int, generator: torch.Generator) -> nn.Sequential:
    """One hidden layer; He initialisation from the generator."""
    first, last = nn.Linear(inputs, hidden), nn.Linear(hidden, outputs)
    with torch.no_grad():
        for layer in (first, last):
            layer.weight.normal_(0.0, (2.0 / layer.in_features) ** 0.5, generator=generator)
            layer.bias.zero_()
    return nn.Sequential(first, nn.ReLU(inplace=True), last)


def _direction_features(direction: Float[Tensor, "r 3"]) -> Float[Tensor, "r 15"]:
    """Direction with sines and cosines of two frequencies."""
    waves = [f(k * direction) for k in (2.0, 6.0) for f in (torch.sin, torch.cos)]
    return torch.cat([direction, *waves], dim=1)
