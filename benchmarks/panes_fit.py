"""Trains the network that tells panes of glass, on synthetic streets and their twins.

    python benchmarks/panes_fit.py OUT STREET ... [--held-out STREET ...] [--steps 3000]

STREET: a folder with log, truth and work (`lightsim train prepare relight` leaves them, or
`synthesize` and `build`); works at least up to the stage `neural`, by this code. What views and
beams tell of each wall is kept in OUT/NAME.npz; an interrupted training goes on. Writes
OUT/panes-small.safetensors, and how well cells of the held-out streets are told (they chose no
step): area under the curve, and precision and recall where glass is the likelier; Markdown.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_closing
from scipy.stats import rankdata
from torch.nn.functional import binary_cross_entropy_with_logits
from true_materials import material_names

from lightsim.build.stages.context import Context
from lightsim.build.stages.geometry import facades_of
from lightsim.build.workspace import Workspace
from lightsim.core.buildings import Wall
from lightsim.core.version import __version__
from lightsim.geometry.completion.facade_cells import CELL_M, FEATURES, FacadeCells, mean_around
from lightsim.geometry.completion.shipped_glass import PANE_WEIGHTS
from lightsim.networks.loop import Learner, LoopConfig, Loss, Session, run_training
from lightsim.networks.panes import KIND, PaneNetwork, PaneNetworkConfig
from lightsim.networks.stored import stored_tensors
from lightsim.progress import LineProgress
from lightsim.render.casters.embree import make_embree_caster
from lightsim.store.arrays import save_arrays
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim.store.weights import WeightsRecord, write_weights
from lightsim_lab.synthetic.reader import read_true_meshes

_CROP, _BATCH, _RATE = 96, 4, 3e-3
# Panes lie behind this much before a wall's plane and this much behind it.
_FRONT_M, _BEHIND_M = 0.05, 0.6
# Bars of panes are as good as glass: this wide, in cells.
_BAR = 3
_SHADE, _COLOUR, _BEAMS = slice(0, 3), slice(3, 5), slice(6, 8)
# Spread of other logs' contrast, and how often one has no beams on its walls.
_CONTRAST, _WITHOUT_BEAMS = 0.25, 0.15
# What a crop gets that is no glass: rectangles and shadows in the mean, how wide rectangles and
# bands of shadow are in cells, how much darker and brighter they are (log), the spread of their
# colour, and how many returns at most come from where none should be missing.
_DECOYS, _SHADOWS, _CELLS, _SHADE_BY, _TINT, _HIDDEN = 3, 1, (3, 30), (-2.0, 1.0), 0.15, 0.4
# Half of the wall around with which cells are compared.
_AROUND_M = 1.5


@dataclass(frozen=True, eq=False)
class _Example:
    """One wall: planes, where something is known, and where glass is."""

    planes: np.ndarray
    is_known: np.ndarray
    is_glass: np.ndarray


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("streets", type=Path, nargs="+")
    parser.add_argument("--held-out", type=Path, nargs="+", default=())
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    (options.out / "checkpoint").mkdir(parents=True, exist_ok=True)
    examples = [one for street in options.streets for one in _examples(options.out, street)]
    held_out = {street.name: _examples(options.out, street) for street in options.held_out}
    torch.manual_seed(options.seed)
    config = PaneNetworkConfig()
    network = PaneNetwork(config)
    optimiser = torch.optim.AdamW(network.parameters(), _RATE, weight_decay=1e-3)
    run_training(
        {KIND: Learner(network, (optimiser,), is_averaged=True)},
        lambda _, draw: _losses(network, examples, np.random.default_rng([options.seed, draw])),
        LoopConfig(steps=options.steps, average_decay=0.99),
        Session(FolderCheckpointer(options.out / "checkpoint"), LineProgress()),
    )
    network.eval()
    table = {name: _scores(network, own) for name, own in held_out.items()}
    record = WeightsRecord(
        description="glass in the cells of facades",
        command=_command(options),
        training_data="synthetic streets and their twins",
        split_hash="unknown",
        seed=options.seed,
        steps=options.steps,
        scores=table,
        licence="Apache-2.0",
        version=__version__,
        streets={
            "training": [street.name for street in options.streets],
            "validation": [street.name for street in options.held_out],
        },
    )
    tensors = stored_tensors(network, config, KIND)
    write_weights(options.out / f"{PANE_WEIGHTS}.safetensors", tensors, record)
    sys.stdout.write("| street | " + " | ".join(next(iter(table.values()), ())) + " |\n")
    for name, scores in table.items():
        sys.stdout.write(f"| {name} | " + " | ".join(f"{v:.3f}" for v in scores.values()) + " |\n")


def _command(options: argparse.Namespace) -> str:
    """Streets by name: folders are nobody's business."""
    taught, held_out = (" ".join(s.name for s in k) for k in (options.streets, options.held_out))
    return (
        f"python benchmarks/panes_fit.py OUT {taught} --held-out {held_out} "
        f"--steps {options.steps} --seed {options.seed}"
    )


def _examples(out: Path, street: Path) -> list[_Example]:
    """Of a street's walls, kept in a file."""
    path = out / f"{street.name}.npz"
    if not path.is_file():
        context = Context(LineProgress(), 0, "standard")
        facades = facades_of(Workspace(street / "work"), context)
        labels = _labels(facades, street / "truth")
        arrays: dict[str, np.ndarray] = {}
        for k, (facade, is_glass) in enumerate(zip(facades, labels, strict=True)):
            values = (facade.features, facade.is_known, is_glass)
            arrays |= {f"{name}-{k}": v for name, v in zip("pkg", values, strict=True)}
        save_arrays(path, arrays)
    kept = np.load(path)
    count = len(kept.files) // 3
    examples = [_Example(*(kept[f"{name}-{k}"] for name in "pkg")) for k in range(count)]
    return [one for one in examples if one.is_known.any()]


def _labels(facades: Sequence[FacadeCells], truth: Path) -> Iterator[np.ndarray]:
    """Where glass truly is."""
    background = read_true_meshes(truth / "scene.npz")["background"]
    is_glass = np.char.startswith(material_names(background, truth), "glass")
    caster = make_embree_caster([background])
    for facade in facades:
        wall: Wall = facade.wall
        shape = facade.offset_m.shape
        start = wall.at(*wall.grid(CELL_M, shape), _FRONT_M).reshape(-1, 3)
        hits = caster.intersect(start, np.broadcast_to(-wall.normal, start.shape).copy())
        is_near = hits.is_hit & (hits.distance_m < _FRONT_M + _BEHIND_M)
        found = np.where(is_near, is_glass[hits.face_index], False).reshape(shape)
        padded = np.pad(found, _BAR)
        closed = binary_closing(padded, np.ones((_BAR, _BAR), dtype=bool))
        yield np.asarray(closed)[_BAR:-_BAR, _BAR:-_BAR]


def _losses(
    network: PaneNetwork, examples: Sequence[_Example], rng: np.random.Generator
) -> Iterator[Loss]:
    crops = [_crop(_drawn(examples, rng), rng) for _ in range(_BATCH)]
    planes, is_known, is_glass = (
        torch.from_numpy(np.stack([getattr(c, name) for c in crops]).astype(np.float32))
        for name in ("planes", "is_known", "is_glass")
    )
    loss = binary_cross_entropy_with_logits(network(planes), is_glass, reduction="none")
    yield KIND, (loss * is_known).sum() / is_known.sum().clamp(min=1), {}


def _drawn(examples: Sequence[_Example], rng: np.random.Generator) -> _Example:
    """One wall, larger ones more often."""
    known = np.array([one.is_known.sum() for one in examples], dtype=np.float64)
    return examples[rng.choice(len(examples), p=known / known.sum())]


def _crop(one: _Example, rng: np.random.Generator) -> _Example:
    """A square of a wall around a cell that is known, as another log might tell of it."""
    s, z = one.is_known.shape
    half = _CROP // 2
    i, j = np.argwhere(one.is_known)[rng.integers(one.is_known.sum())] + rng.integers(-16, 17, 2)
    i, j = int(np.clip(i, 0, s - 1)), int(np.clip(j, 0, z - 1))
    size = slice(i, i + _CROP), slice(j, j + _CROP)
    planes = np.pad(one.planes, ((0, 0), (half, half), (half, half)))[:, *size]
    is_known, is_glass = (np.pad(v, half)[size] for v in (one.is_known, one.is_glass))
    planes[_SHADE] *= np.exp(rng.normal(0.0, _CONTRAST))
    planes[_COLOUR] *= np.exp(rng.normal(0.0, _CONTRAST))
    if rng.random() < _WITHOUT_BEAMS:
        planes[_BEAMS] = 0.0
    if rng.random() < 0.5:
        planes, is_known, is_glass = planes[:, ::-1], is_known[::-1], is_glass[::-1]
    return _Example(_with_decoys(planes, is_glass, rng), is_known, is_glass)


def _with_decoys(planes: np.ndarray, is_glass: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What the streets that teach have none of: painted rectangles that beams come back from, and
    plain wall that something hid from beams."""
    planes, paint = planes.copy(), np.zeros(is_glass.shape)
    for _ in range(rng.poisson(_DECOYS)):
        size = rng.integers(*_CELLS, 2)
        i, j = rng.integers(0, _CROP - size)
        box = slice(i, i + size[0]), slice(j, j + size[1])
        if is_glass[box].any():
            continue
        if rng.random() < 0.5:
            planes[6][box] *= rng.uniform(0.0, _HIDDEN)
        elif (planes[7][box] > 0).all():
            paint[box] += rng.uniform(*_SHADE_BY)
            planes[_COLOUR, *box] += rng.normal(0.0, _TINT, (2, 1, 1))
    for _ in range(rng.poisson(_SHADOWS)):
        paint += _shadow(rng)
    planes[_SHADE] += (paint - mean_around(paint, _AROUND_M)) * planes[5]
    return planes


def _shadow(rng: np.random.Generator) -> np.ndarray:
    """Of a roof's edge or of a pole, slanting over wall and glass."""
    slope = rng.uniform(0.0, 2 * np.pi)
    s, z = np.meshgrid(*2 * (np.arange(_CROP) - _CROP / 2,), indexing="ij")
    across = s * np.cos(slope) + z * np.sin(slope) - rng.uniform(-_CROP / 3, _CROP / 3)
    is_pole = rng.random() < 0.5
    width = rng.integers(*_CELLS) if is_pole else np.inf
    return np.where((across > 0) & (across < width), rng.uniform(_SHADE_BY[0], 0.0), 0.0)


def _scores(network: PaneNetwork, examples: Sequence[_Example]) -> dict[str, float]:
    told = [
        (network.log_odds(one.planes)[one.is_known], one.is_glass[one.is_known]) for one in examples
    ]
    log_odds, is_glass = (np.concatenate(parts) for parts in zip(*told, strict=True))
    ranks, count = rankdata(log_odds)[is_glass], int(is_glass.sum())
    area = (ranks.sum() - count * (count + 1) / 2) / (count * (len(log_odds) - count))
    both = float((is_glass & (log_odds > 0)).sum())
    return {
        "area under curve": float(area),
        "precision": both / max(int((log_odds > 0).sum()), 1),
        "recall": both / count,
    }


if __name__ == "__main__":
    assert len(FEATURES) == PaneNetworkConfig().planes
    main()
