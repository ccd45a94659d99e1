"""Training of the baselines of relighting, on the frames that our own networks learn from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from lightsim.networks.devices import choose_device
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session, run_training
from lightsim.relighting.network.features import srgb_of
from lightsim_lab.baselines.epe import EpeConfig, EpeNet, PatchDiscriminator
from lightsim_lab.baselines.self_osr import SelfOsrConfig, SelfOsrNet
from lightsim_lab.training.ahead import Ahead
from lightsim_lab.training.inpaint_losses import discriminator_loss, generator_loss
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_losses import Perceptual, colour_loss, picture_terms, shown
from lightsim_lab.training.relight_pairs import RelightBatch

Baseline = SelfOsrNet | EpeNet
_CLIPPED = 254 / 255
_EXPLAINED_PX = 2
"""Pictures are explained at every second row and column."""


@dataclass(frozen=True)
class BaselineTrainConfig:
    """How a baseline is trained: loop, rate, batches and the losses of pictures are those of
    `--method network`."""

    network: SelfOsrConfig | EpeConfig
    """Which, and its size."""
    loop: LoopConfig = field(
        default_factory=lambda: LoopConfig(
            steps=20000, warm_up_steps=300, average_decay=0.999, is_mixed_on_cpu=True
        )
    )
    """Steps and averages."""
    rate: float = 1e-3
    """Highest learning rate (AdamW)."""
    weight_decay: float = 1e-2
    """Of AdamW."""
    perception: float = 0.1
    """Weight of LPIPS beside that of colour, which is 1."""
    edges: float = 0.5
    """Weight of the edges' difference."""
    perception_crops: int = 1
    """Crops of a step that LPIPS looks at: a VGG-16 costs as much as four crops of a baseline."""
    adversarial: float = 0.01
    """Weight of EPE's discriminator."""
    discriminator_rate: float = 2e-4
    """Its highest learning rate (Adam)."""
    seed: int = 0
    """Of first weights and batches."""
    workers: int = 0
    """Threads that make batches ahead of their use."""
    data: RelightDataConfig = field(default_factory=RelightDataConfig)
    """How frames are shown."""


def full(config: BaselineTrainConfig) -> BaselineTrainConfig:
    """For a GPU, as `train relight --preset full`."""
    loop = LoopConfig(60000, warm_up_steps=500, average_decay=0.9995, mixed_precision=True)
    wide = (48, 96, 160, 224)
    return replace(
        config,
        network=replace(config.network, widths=wide),
        loop=loop,
        perception_crops=8,
        workers=8,
        data=RelightDataConfig(batch=32, crop_px=(192, 192)),
    )


def train_baseline(
    config: BaselineTrainConfig, data: RelightData, session: Session
) -> tuple[Baseline, int]:
    """The network, and the number of steps done.

    Raises:
        ArtefactError: the checkpoint belongs to another network.
    """
    device = choose_device(session.device)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        if isinstance(config.network, EpeConfig):
            network, discriminator = EpeNet(config.network), PatchDiscriminator()
        else:
            network, discriminator = SelfOsrNet(config.network), None
    learners = {"network": _learner(network.to(device), config)}
    if discriminator is not None:
        adam = torch.optim.Adam(
            discriminator.to(device).parameters(), config.discriminator_rate, (0.5, 0.99)
        )
        learners["discriminator"] = Learner(discriminator, (adam,))
    perceptual = Perceptual().to(device)
    count = session.processes.count

    def losses(step: int, draw: int) -> Iterator[Loss]:
        batch = batches.get(draw).on(device)
        if isinstance(network, EpeNet):
            assert discriminator is not None
            yield from _epe_losses(network, discriminator, batch, perceptual, config)
        else:
            total, terms = self_osr_loss(network, batch, perceptual, config)
            yield "network", total, terms

    data = data.on(device)
    with Ahead(
        lambda draw: data.batch(draw, config.seed),
        config.workers if data.device.type == "cpu" else 0,
        count,
        count * config.loop.steps,
    ) as batches:
        done = run_training(learners, losses, config.loop, session, "train the baseline")
    return network, done


def _learner(network: Baseline, config: BaselineTrainConfig) -> Learner:
    moved = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    adam = torch.optim.AdamW(moved.parameters(), config.rate, weight_decay=config.weight_decay)
    return Learner(moved, (adam,), is_averaged=True)


def self_osr_loss(
    network: SelfOsrNet, batch: RelightBatch, perceptual: nn.Module, config: BaselineTrainConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Both pictures of a pair are decomposed: each must be explained by its parts, the albedo is
    one, normals are the twin's (theirs: multi-view stereo's); the source relit is the target, by
    image formation alone, too; and predicted shadows are those found in the target."""
    planes, count = batch.planes, len(batch.truth)
    # Of half of the pairs: what the target's parts say changes little from pair to pair.
    pairs = (count + 1) // 2
    both = torch.cat([planes["source"], batch.truth[:pairs]])
    land = batch.weight * (1 - planes["matte"])
    matte, own = (torch.cat([x, x[:pairs]]) for x in (planes["matte"], land))
    seen = network.decompose(both, matte)
    source, target = seen.part(slice(count)), seen.part(slice(count, None))
    relit = network.relit(planes, source)
    known = own * (both.amax(1, keepdim=True) < _CLIPPED)
    thin = seen.part(slice(None), _EXPLAINED_PX)
    explained = shown(srgb_of(thin.under(thin.light, thin.shadow)))
    thinned = (..., slice(None, None, _EXPLAINED_PX), slice(None, None, _EXPLAINED_PX))
    closeness = (source.normal * planes["normal"]).sum(1, keepdim=True)
    solid = land * planes["surface"]
    lambert = shown(srgb_of(relit.lambert))
    picture, terms = _picture_loss(relit.picture, batch, perceptual, config)
    terms |= {
        "explained": colour_loss(explained, both[thinned], known[thinned]),
        "albedo": colour_loss(source.albedo[:pairs].sqrt(), target.albedo.sqrt(), land[:pairs]),
        "normals": (solid * (1 - closeness)).sum() / (solid.sum() + 1),
        "lambert": colour_loss(lambert, batch.truth, land),
        "shadows": colour_loss(relit.shadow[:pairs], target.shadow.detach(), land[:pairs]),
    }
    total = picture + terms["explained"] + 0.5 * terms["albedo"] + 0.2 * terms["normals"]
    return total + 0.5 * terms["lambert"] + 0.2 * terms["shadows"], terms


def _epe_losses(
    network: EpeNet,
    discriminator: PatchDiscriminator,
    batch: RelightBatch,
    perceptual: nn.Module,
    config: BaselineTrainConfig,
) -> Iterator[Loss]:
    """Of the discriminator, then of the network."""
    made = network(batch.planes)
    # What does not count looks like the truth.
    filled = (batch.weight * made + (1 - batch.weight) * batch.truth).clamp(0, 1)
    discriminator.requires_grad_(True)
    of_truth, of_made = discriminator(torch.cat([batch.truth, filled.detach()])).float().chunk(2)
    judged = discriminator_loss(of_truth, of_made)
    yield "discriminator", judged, {"discriminator": judged}
    discriminator.requires_grad_(False)
    total, terms = _picture_loss(made, batch, perceptual, config)
    terms["adversarial"] = generator_loss(discriminator(filled).float())
    yield "network", total + config.adversarial * terms["adversarial"], terms


def _picture_loss(
    made: Tensor, batch: RelightBatch, perceptual: nn.Module, config: BaselineTrainConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Colour, edges and perception, as `--method network` minimises them."""
    crops = config.perception_crops
    terms = picture_terms(shown(made), batch.truth, batch.weight, perceptual, crops)
    total = terms["colour"] + config.edges * terms["edges"] + config.perception * terms["lpips"]
    return total, terms
