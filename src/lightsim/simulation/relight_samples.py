"""What relighting networks learn from: streets with true relit pictures, beside what the twins say
that were built from their logs by the product's own pipeline, errors and all."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightsim.core.reading import LogReading
from lightsim.errors import InputError
from lightsim.pipeline.build import build
from lightsim.pipeline.options import BuildOptions
from lightsim.pipeline.workspace import Workspace
from lightsim.progress import Progress
from lightsim.relighting.network.channels import scene_planes, target_planes
from lightsim.relighting.physical.ratio import Circumstances, RelightInputs
from lightsim.simulation.against_truth import as_truth
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import replayed
from lightsim.simulation.relighter import RelightConfig, Relighter, RelitFrame
from lightsim.simulation.skies import resolve_sky
from lightsim.store.images import read_srgb8
from lightsim.synthetic import synthesize
from lightsim.training.hdr_skies import SplitEntry, read_split
from lightsim.training.options import PrepareRelightOptions
from lightsim.training.relight_cache import RelightSample, RelightTargetSample, write_sample

_LOGGER = logging.getLogger(__name__)
STREETS = "streets"
_NEURAL_STEPS = 150
"""As the streets are built that relighting is measured on (docs/benchmarks/relighting.md)."""


def prepare_relight(options: PrepareRelightOptions, progress: Progress) -> None:
    """Make, build and sample every street that is asked for: OUT/<seed>/<camera>_<frame>.npz. What
    is finished stays; a street's own files, in OUT/streets, go once it is.

    Raises:
        InputError: a file of skies is wrong, or nothing is asked for.
    """
    skies = _training_skies(options)
    for seed in options.streets:
        done = options.out / str(seed)
        if done.is_dir():
            continue
        began, processor = time.monotonic(), time.process_time()
        street = options.out / STREETS / str(seed)
        chosen = _some_of(skies, seed, options.skies_per_street)
        synthesize(
            street,
            seed=seed,
            size=options.size,
            progress=progress,
            is_denoised=True,
            target_skies=chosen,
        )
        reading = LogReading(source=str(street / "log"), image_scale=1.0, hold_out=5)
        build(street / "work", BuildOptions(reading=reading, neural_steps=_NEURAL_STEPS), progress)
        samples = street / "samples"
        count = write_samples(street / "work", street / "truth", samples, progress)
        samples.rename(done)
        if not options.keep:
            shutil.rmtree(street)
        _LOGGER.info(
            "street %d: %d frames under %d skies, %.0f s, %.0f processor seconds, %.0f MB",
            seed,
            count,
            3 + len(chosen),
            time.monotonic() - began,
            time.process_time() - processor,
            sum(p.stat().st_size for p in done.iterdir()) / 1e6,
        )


def _training_skies(options: PrepareRelightOptions) -> list[Path]:
    """Measured skies of the training side that show a sky of their own, in the order of names."""
    if options.hdri is None:
        return []
    if options.split is None:
        raise InputError(
            "nobody tells which skies may train",
            where="--hdri",
            remedy="Give --split, too: skies of the validation and test side stay unseen.",
        )
    entries = read_split(options.split)
    files = sorted(p for p in options.hdri.iterdir() if p.suffix.lower() in (".hdr", ".exr"))
    found = [p for p in files if p.stem in entries and _is_open(entries[p.stem])]
    if not found:
        raise InputError(
            "no sky of the training side is there",
            where=options.hdri,
            expected=f".hdr or .exr files that {options.split} names for training",
        )
    return found


def _is_open(entry: SplitEntry) -> bool:
    """Whether a sky is on the training side and whole: its sun not clipped, no roof of trees."""
    return entry.split == "train" and entry.tier != "C" and entry.scene != "canopy"


def _some_of(skies: Sequence[Path], seed: int, count: int) -> list[Path]:
    """Of a street; the same whatever other streets are made."""
    order = np.random.default_rng([seed, 17]).permutation(len(skies))
    return [skies[k] for k in order[:count]]


def write_samples(work: Path, truth: Path, out: Path, progress: Progress) -> int:
    """Every frame of a twin that has true relit pictures, as OUT/<camera>_<stem>.npz; those that
    are there stay.

    Args:
        truth: folder `truth` of a synthetic log.

    Returns:
        How many there are.
    """
    skies = sorted(p.name for p in (truth / "relit").iterdir() if p.is_dir())
    options = as_truth(truth, skies, RelightOptions(name="truth"))
    workspace = Workspace(work, is_stale_allowed=True)
    scenario = replayed(workspace, options)
    relighter = Relighter(workspace, workspace.log_at(1.0), RelightConfig(), options)
    choices = options.sky_by_name.values()
    targets = [relighter.target(resolve_sky(choice, workspace)) for choice in choices]
    out.mkdir(parents=True, exist_ok=True)
    frames = list(scenario.frames)
    for frame in progress.track(frames, "samples"):
        path = out / f"{frame.camera_name}_{frame.stem}.npz"
        files = [truth / "relit" / sky / frame.camera_name / f"{frame.stem}.jpg" for sky in skies]
        if path.exists() or not all(file.is_file() for file in files):
            continue
        made = list(relighter.relit(frame, scenario, targets))
        write_sample(path, _sample(made, dict(zip(skies, files, strict=True)), relighter))
    return len(list(out.glob("*.npz")))


def _sample(
    made: Sequence[RelitFrame], files: dict[str, Path], relighter: Relighter
) -> RelightSample:
    targets = {}
    for relit, (sky, file) in zip(made, files.items(), strict=True):
        inputs, seen = _inputs(relit)
        planes = target_planes(inputs, seen, relit.radiance)
        truth = np.ascontiguousarray(np.moveaxis(read_srgb8(file), -1, 0))
        targets[sky] = RelightTargetSample(planes, truth)
    inputs, seen = _inputs(made[0])
    ego = relighter.log.ego_vehicle_masks.get(made[0].frame.camera_name)
    valid = np.ones(inputs.sky_matte.shape) if ego is None else ~ego
    scene = scene_planes(inputs, seen)
    return RelightSample({**scene, "valid": valid[None].astype(np.float32)}, targets)


def _inputs(relit: RelitFrame) -> tuple[RelightInputs, Circumstances]:
    """Of a frame that was relit, and not taken as it was."""
    assert relit.inputs is not None
    assert relit.inputs.circumstances is not None
    return relit.inputs, relit.inputs.circumstances
