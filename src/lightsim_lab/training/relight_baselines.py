"""Training of the relighting baselines Self-OSR and EPE, on the frames that train RelitNet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from lightsim.networks.devices import choose_device
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session
from lightsim.relighting.network.features import srgb_of
from lightsim_lab.baselines.epe import EpeConfig, EpeNet, PatchDiscriminator
from lightsim_lab.baselines.self_osr import SelfOsrConfig, SelfOsrNet
from lightsim_lab.training.inpaint_losses import discriminator_loss, generator_loss
from lightsim_lab.training.relight_data import RelightData, RelightDataConfig
from lightsim_lab.training.relight_loop import FrameTrainConfig, learner_of, train_on_frames
from lightsim_lab.training.relight_losses import Perceptual, colour_loss, picture_terms, shown
from lightsim_lab.training.relight_pairs import CLIPPED, RelightBatch

Baseline = SelfOsrNet | EpeNet
# Stride of the pixels at which the decomposed pictures are re-rendered and compared: a quarter of
# the pixels is a sufficient sample, and rendering them is the costly part. Not measured.
_RERENDER_STRIDE_PX = 2


@dataclass(frozen=True, kw_only=True)
class BaselineTrainConfig(FrameTrainConfig):
    """Settings of the training of a baseline; loop, rate and batches are those of RelitNet."""

    network: SelfOsrConfig | EpeConfig
    """Kind and size of the network."""
    perception: float = 0.1
    """Weight of LPIPS; the weight of the colour loss is 1."""
    perception_crops: int = 1
    """Number of crops per step that LPIPS is evaluated on: its VGG-16 costs as much as four crops
    of a baseline."""
    adversarial: float = 0.01
    """Weight of the adversarial loss of EPE."""
    discriminator_rate: float = 2e-4
    """Highest learning rate of EPE's discriminator (Adam)."""


def full(config: BaselineTrainConfig) -> BaselineTrainConfig:
    """Return the settings for a GPU, those of `train relight --preset full`."""
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
    """Train a baseline; return it and the number of steps done.

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
    learners = {"network": learner_of(network, config, device)}
    if discriminator is not None:
        adam = torch.optim.Adam(
            discriminator.to(device).parameters(), config.discriminator_rate, (0.5, 0.99)
        )
        learners["discriminator"] = Learner(discriminator, (adam,))
    perceptual = Perceptual().to(device)

    def losses(batch: RelightBatch, _: int) -> Iterator[Loss]:
        if isinstance(network, EpeNet):
            assert discriminator is not None
            yield from _epe_losses(network, discriminator, batch, perceptual, config)
        else:
            yield "network", *self_osr_loss(network, batch, perceptual, config)

    label = "train the baseline"
    return network, train_on_frames(learners, losses, data, config, session, label)


def self_osr_loss(
    network: SelfOsrNet, batch: RelightBatch, perceptual: nn.Module, config: BaselineTrainConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the loss of Self-OSR on a batch, and its terms.

    Source and target picture of a pair are decomposed. Re-rendering the parts reproduces each
    picture, both albedos agree, and normals are those of the twin (the original uses multi-view
    stereo). The relit source equals the target, also by the image formation model alone, and the
    predicted shadows equal those estimated in the target.
    """
    planes, count = batch.planes, len(batch.truth)
    # The targets of half of the pairs suffice: their loss terms vary little from pair to pair.
    pairs = (count + 1) // 2
    both = torch.cat([planes["source"], batch.truth[:pairs]])
    land = batch.weight * (1 - planes["matte"])
    matte, own = (torch.cat([x, x[:pairs]]) for x in (planes["matte"], land))
    seen = network.decompose(both, matte)
    source, target = seen.part(slice(count)), seen.part(slice(count, None))
    relit = network.relit(planes, source)
    # Clipped pixels have no known radiance and are not explained.
    known = own * (both.amax(1, keepdim=True) < CLIPPED)
    thin = seen.part(slice(None), _RERENDER_STRIDE_PX)
    explained = shown(srgb_of(thin.under(thin.light, thin.shadow)))
    thinned = (..., slice(None, None, _RERENDER_STRIDE_PX), slice(None, None, _RERENDER_STRIDE_PX))
    # Cosine between the estimated and the twin's normal.
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
    """Yield the loss of the discriminator, then that of the network."""
    made = network(batch.planes)
    # Pixels of weight 0 are replaced by the truth, so that the discriminator ignores them.
    filled = (batch.weight * made + (1 - batch.weight) * batch.truth).clamp(0, 1)
    discriminator.requires_grad_(True)
    of_truth, of_made = discriminator(torch.cat([batch.truth, filled.detach()])).float().chunk(2)
    judged = discriminator_loss(of_truth, of_made)
    yield "discriminator", judged, {"discriminator": judged}
    # The network's loss must not add gradients to the discriminator.
    discriminator.requires_grad_(False)
    total, terms = _picture_loss(made, batch, perceptual, config)
    terms["adversarial"] = generator_loss(discriminator(filled).float())
    yield "network", total + config.adversarial * terms["adversarial"], terms


def _picture_loss(
    made: Tensor, batch: RelightBatch, perceptual: nn.Module, config: BaselineTrainConfig
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the weighted sum of colour, edge and LPIPS loss of RelitNet, and its terms."""
    crops = config.perception_crops
    terms = picture_terms(shown(made), batch.truth, batch.weight, perceptual, crops)
    total = terms["colour"] + config.edges * terms["edges"] + config.perception * terms["lpips"]
    return total, terms
