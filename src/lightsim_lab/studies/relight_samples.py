"""Training samples of relighting networks: twins' relighting inputs with true relit pictures.

Twins are built from the logs of synthetic streets by the product's pipeline, so that networks see
its errors.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import build
from lightsim.build.workspace import Workspace
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.reading import LogReading
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.relighting.network.channels import scene_planes, target_planes
from lightsim.relighting.physical.ratio import (
    Circumstances,
    RatioConfig,
    RelightInputs,
    relight_physical,
)
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import replayed
from lightsim.simulation.relighter import RelightConfig, Relighter, RelitFrame
from lightsim.simulation.skies import resolve_sky
from lightsim.store.images import read_srgb8
from lightsim_lab.studies.against_truth import as_truth
from lightsim_lab.studies.benchmark_options import held_out_names
from lightsim_lab.synthetic import synthesize
from lightsim_lab.synthetic.generate import Variation
from lightsim_lab.synthetic.plan import street_name
from lightsim_lab.synthetic.skies import FurtherSkies
from lightsim_lab.training.hdr_skies import Side, SplitEntry, read_split
from lightsim_lab.training.options import PrepareRelightOptions
from lightsim_lab.training.relight_cache import RelightSample, RelightTargetSample, write_sample

_LOGGER = logging.getLogger(__name__)
STREETS = "streets"
# Smallest 8-bit value of a clipped pixel, as in the relighting of recorded pictures.
_CLIPPED = 254
# True pictures of a frame that also become sources; each adds a file of some 50 MB.
_SOURCES = 2
# Training steps of the neural field, as on the benchmark's streets (docs/benchmarks/relighting.md).
_NEURAL_STEPS = 150


def prepare_relight(options: PrepareRelightOptions, progress: Progress) -> None:
    """Make, build and sample every requested street: OUT/<street>/<camera>_<frame>.npz.

    Finished streets are skipped. The files of a street in OUT/streets are removed after sampling.

    Raises:
        InputError: a sky is wrong, or a street belongs to the benchmark.
    """
    names = {seed: street_name(seed, options.style) for seed in options.streets}
    held_out = held_out_names() & set(names.values())
    if held_out:
        raise InputError(
            "streets of the benchmark must not be used for training",
            where="--streets",
            got=", ".join(sorted(held_out)),
            remedy="Give other seeds.",
        )
    skies = skies_of_side(options.hdri, options.split, "train")
    for seed in options.streets:
        done = options.out / names[seed]
        if done.is_dir():
            continue
        began, processor = time.monotonic(), time.process_time()
        street = options.out / STREETS / names[seed]
        chosen = some_of(skies, seed, options.skies_per_street)
        synthesize(
            street,
            seed=seed,
            size=options.size,
            progress=progress,
            is_denoised=True,
            variation=Variation(options.paths, style=options.style),
            further=FurtherSkies(drawn_suns=options.drawn_suns, panoramas=tuple(chosen)),
        )
        reading = LogReading(source=str(street / "log"), image_scale=1.0, hold_out=5)
        build(street / "work", BuildOptions(reading=reading, neural_steps=_NEURAL_STEPS), progress)
        samples = street / "samples"
        count = write_samples(street / "work", street / "truth", samples, progress)
        # The rename is atomic: a folder of this name is always complete.
        samples.rename(done)
        if not options.keep:
            shutil.rmtree(street)
        _LOGGER.info(
            "street %s: %d frames under %d skies, %.0f s, %.0f processor seconds, %.0f MB",
            names[seed],
            count,
            3 + options.drawn_suns + len(chosen),
            time.monotonic() - began,
            time.process_time() - processor,
            sum(p.stat().st_size for p in done.iterdir()) / 1e6,
        )


def skies_of_side(hdri: Path | None, split: Path | None, side: Side) -> list[Path]:
    """Return the complete measured skies of a side, ordered by name; empty without a folder.

    Raises:
        InputError: the split is missing or wrong, or the folder has no sky of the side.
    """
    if hdri is None:
        return []
    if split is None:
        raise InputError(
            "no train/test split is given for the skies",
            where="--hdri",
            remedy="Give --split, which keeps training, validation and test skies apart.",
        )
    entries = read_split(split)
    files = sorted(p for p in hdri.iterdir() if p.suffix.lower() in (".hdr", ".exr"))
    found = [p for p in files if p.stem in entries and _is_open(entries[p.stem], side)]
    if not found:
        raise InputError(
            f"the folder contains no sky of the {side} side",
            where=hdri,
            expected=f".hdr or .exr files of this side in {split}",
        )
    return found


def _is_open(entry: SplitEntry, side: Side) -> bool:
    """Return whether a sky is on a side, its sun is not clipped, and trees do not cover it."""
    return entry.split == side and entry.tier != "C" and entry.scene != "canopy"


def some_of(skies: Sequence[Path], seed: int, count: int) -> list[Path]:
    """Draw skies for a street, independently of which other streets are made."""
    # The second number separates this stream from others of the same seed.
    order = np.random.default_rng([seed, 17]).permutation(len(skies))
    return [skies[k] for k in order[:count]]


@dataclass(frozen=True, eq=False)
class _Frame:
    """Inputs, physical result and true picture of a frame relit to one sky."""

    inputs: RelightInputs
    radiance: Float32[np.ndarray, "h w 3"]
    truth_srgb8: UInt8[np.ndarray, "h w 3"]

    @property
    def circumstances(self) -> Circumstances:
        """Camera and skies."""
        assert self.inputs.circumstances is not None
        return self.inputs.circumstances


def write_samples(
    work: Path, truth: Path, out: Path, progress: Progress, *, true_sources: int = _SOURCES
) -> int:
    """Write the samples of all frames of a twin that have true relit pictures.

    The source is the recorded picture (OUT/<camera>_<stem>.npz), or a true picture under one of the
    skies (OUT/<camera>_<stem>_under_<sky>.npz); the latter skies alternate from frame to frame.
    Existing samples are not rewritten.

    Args:
        truth: folder `truth` of a synthetic log.
        true_sources: number of true pictures per frame that also become sources.

    Returns:
        The number of samples in the folder.
    """
    skies = sorted(p.name for p in (truth / "relit").iterdir() if p.is_dir())
    options = as_truth(truth, skies, RelightOptions(name="truth", method="physical"))
    workspace = Workspace(work, is_stale_allowed=True)
    scenario = replayed(workspace, options)
    relighter = Relighter(workspace, workspace.log_at(1.0), RelightConfig(), options)
    choices = options.sky_by_name.values()
    targets = [relighter.target(resolve_sky(choice, workspace)) for choice in choices]
    out.mkdir(parents=True, exist_ok=True)
    for number, frame in enumerate(progress.track(list(scenario.frames), "samples")):
        name = f"{frame.camera_name}_{frame.stem}"
        files = [truth / "relit" / sky / frame.camera_name / f"{frame.stem}.jpg" for sky in skies]
        # The sample of the recorded picture is written last and marks a complete frame.
        if (out / f"{name}.npz").exists() or not all(file.is_file() for file in files):
            continue
        made = {
            sky: _frame(relit, file)
            for sky, relit, file in zip(
                skies, relighter.relit(frame, scenario, targets), files, strict=True
            )
        }
        ego = relighter.log.ego_vehicle_masks.get(frame.camera_name)
        for sky in _in_turn(skies, number, true_sources) if len(skies) > 1 else ():
            sample = _sample(_under(made, sky), ego)
            write_sample(out / f"{name}_under_{sky}.npz", sample)
        write_sample(out / f"{name}.npz", _sample(made, ego))
    return len(list(out.glob("*.npz")))


def _in_turn(skies: Sequence[str], number: int, count: int) -> set[str]:
    """Return the skies under which the true picture of a frame becomes a source."""
    first = number * count
    return {skies[k % len(skies)] for k in range(first, first + count)}


def _frame(relit: RelitFrame, truth: Path) -> _Frame:
    """Combine a frame that was really relit, not copied, with its true picture."""
    assert relit.inputs is not None
    return _Frame(relit.inputs, relit.radiance, read_srgb8(truth))


def _under(made: Mapping[str, _Frame], sky: str) -> dict[str, _Frame]:
    """Return the frame as if recorded under one of the skies, relit to the others."""
    source = made[sky]
    picture = source.truth_srgb8
    frames = {}
    for name, frame in made.items():
        if name == sky:
            continue
        inputs = replace(
            frame.inputs,
            radiance=(linear_from_srgb8(picture) / frame.circumstances.gain).astype(np.float32),
            is_clipped=np.any(picture >= _CLIPPED, axis=-1),
            source=source.inputs.target,
            source_sun=source.inputs.target_sun,
            # The twin's estimate belongs to the recorded picture, not to this source.
            found_visibility=None,
            circumstances=replace(frame.circumstances, source_sky=source.circumstances.target_sky),
        )
        frames[name] = _Frame(inputs, relight_physical(inputs, RatioConfig()), frame.truth_srgb8)
    return frames


def _sample(made: Mapping[str, _Frame], ego: Bool[np.ndarray, "h w"] | None) -> RelightSample:
    targets = {
        sky: RelightTargetSample(
            target_planes(frame.inputs, frame.circumstances, frame.radiance),
            np.ascontiguousarray(np.moveaxis(frame.truth_srgb8, -1, 0)),
        )
        for sky, frame in made.items()
    }
    any_frame = next(iter(made.values()))
    scene = scene_planes(any_frame.inputs, any_frame.circumstances)
    valid = np.ones(any_frame.inputs.sky_matte.shape) if ego is None else ~ego
    return RelightSample({**scene, "valid": valid[None].astype(np.float32)}, targets)
