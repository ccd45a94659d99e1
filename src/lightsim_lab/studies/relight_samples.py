"""Training samples of relighting networks: relighting inputs of a twin's frames under target skies.

Twins are built by the normal pipeline, so that training includes its errors. Twins of synthetic
streets also have true pictures under the target skies; twins of other logs have only renderings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from lightsim.build.workspace import Workspace
from lightsim.core.colour import linear_from_srgb8
from lightsim.core.scenario import ScenarioFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.progress import Progress
from lightsim.relighting.network.channels import scene_planes, target_planes
from lightsim.relighting.physical.ratio import (
    CameraAndSkies,
    RatioConfig,
    RelightInputs,
    relight_physical,
)
from lightsim.simulation.claims import image_scale_of
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relight import replayed
from lightsim.simulation.relighter import RelightConfig, Relighter, RelightTarget
from lightsim.simulation.skies import resolve_sky
from lightsim.simulation.target_sky import TargetSky
from lightsim.store.images import read_srgb8
from lightsim_lab.studies.against_truth import options_of_truth
from lightsim_lab.training.relight_cache import RelightSample, RelightTargetSample, write_sample

# Smallest 8-bit value of a clipped pixel, as in the relighting of recorded pictures.
_CLIPPED = 254
# True pictures of a frame that also become sources; each adds a file of some 50 MB.
_SOURCES = 2


@dataclass(frozen=True)
class TargetDraws:
    """Choice of frames, and random draw of the target skies of each.

    Args:
        count: skies of a frame.
        offset_deg: largest turn of a sky about the vertical axis, in degrees.
        every: each n-th frame of the log is sampled.
        seed: seed of the draws.
    """

    count: int
    offset_deg: float
    every: int
    seed: int


@dataclass(frozen=True, eq=False)
class _Frame:
    """Inputs, physical result and, where it is known, true picture of a frame relit to one sky."""

    inputs: RelightInputs
    radiance: Float32[np.ndarray, "h w 3"]
    truth_srgb8: UInt8[np.ndarray, "h w 3"] | None

    @property
    def camera_and_skies(self) -> CameraAndSkies:
        """Camera and skies."""
        assert self.inputs.camera_and_skies is not None
        return self.inputs.camera_and_skies


class _Twin:
    """A twin whose recorded frames are relit physically, each traced once for all skies."""

    def __init__(self, workspace: Workspace, options: RelightOptions) -> None:
        self.scenario = replayed(workspace, options)
        log = workspace.log_at(image_scale_of(workspace, options))
        self._workspace = workspace
        self._relighter = Relighter(workspace, log, RelightConfig(), options)

    @property
    def frames(self) -> list[ScenarioFrame]:
        """The selected frames."""
        return list(self.scenario.frames)

    def sky(self, choice: SkyChoice) -> TargetSky:
        """Return a sky in scene units."""
        return resolve_sky(choice, self._workspace)

    def target(self, sky: TargetSky) -> RelightTarget:
        """Prepare a sky."""
        return self._relighter.target(sky)

    def relit(
        self,
        frame: ScenarioFrame,
        targets: Mapping[str, RelightTarget],
        truths: Mapping[str, Path] | None = None,
    ) -> dict[str, _Frame]:
        """Return a frame under each target sky, with its true pictures if their files are given."""
        made = self._relighter.relit(frame, self.scenario, list(targets.values()))
        frames = {}
        for name, relit in zip(targets, made, strict=True):
            # None only under the unchanged source sky, which is no target.
            assert relit.inputs is not None
            truth = None if truths is None else read_srgb8(truths[name])
            frames[name] = _Frame(relit.inputs, relit.radiance, truth)
        return frames

    def sample(self, frame: ScenarioFrame, made: Mapping[str, _Frame]) -> RelightSample:
        """Return the sample of a frame; pixels of the ego vehicle do not count."""
        return _sample(made, self._relighter.log.ego_vehicle_masks.get(frame.camera_name))


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
    options = options_of_truth(truth, skies, RelightOptions(name="truth", method="physical"))
    twin = _Twin(Workspace(work, is_stale_allowed=True), options)
    choices = options.sky_by_name.values()
    targets = {k: twin.target(twin.sky(one)) for k, one in zip(skies, choices, strict=True)}
    out.mkdir(parents=True, exist_ok=True)
    for number, frame in enumerate(progress.track(twin.frames, "samples")):
        name = f"{frame.camera_name}_{frame.stem}"
        files = {
            sky: truth / "relit" / sky / frame.camera_name / f"{frame.stem}.jpg" for sky in skies
        }
        # The sample of the recorded picture is written last and marks a complete frame.
        if (out / f"{name}.npz").exists() or not all(file.is_file() for file in files.values()):
            continue
        made = twin.relit(frame, targets, files)
        for sky in _source_skies(skies, number, true_sources) if len(skies) > 1 else ():
            sample = twin.sample(frame, _recorded_under(made, sky))
            write_sample(out / f"{name}_under_{sky}.npz", sample)
        write_sample(out / f"{name}.npz", twin.sample(frame, made))
    return len(list(out.glob("*.npz")))


def write_twin_samples(
    work: Path, options: RelightOptions, draws: TargetDraws, out: Path, progress: Progress
) -> int:
    """Write a sample without true pictures for each selected frame of a twin.

    Each frame has its own draw of the target skies, each turned by a random angle (the paper's
    random offset). Existing samples are not rewritten.

    Args:
        options: target skies and cameras.

    Returns:
        The number of samples in the folder.
    """
    twin = _Twin(Workspace(work, is_stale_allowed=options.allow_stale), options)
    skies = {name: twin.sky(choice) for name, choice in options.sky_by_name.items()}
    names = list(skies)
    stems = sorted({frame.stem for frame in twin.frames})[:: draws.every]
    frames = [frame for frame in twin.frames if frame.stem in stems]
    out.mkdir(parents=True, exist_ok=True)
    for number, frame in enumerate(progress.track(frames, f"samples of {work.name}")):
        path = out / f"{frame.camera_name}_{frame.stem}.npz"
        if path.exists():
            continue
        # The draw depends on the frame alone, so that a resumed command repeats it.
        rng = np.random.default_rng([draws.seed, number])
        drawn = rng.permutation(len(names))[: draws.count]
        turns_deg = rng.uniform(-draws.offset_deg, draws.offset_deg, len(drawn))
        targets = {
            names[k]: twin.target(_turned(skies[names[k]], float(turn_deg)))
            for k, turn_deg in zip(drawn, turns_deg, strict=True)
        }
        write_sample(path, twin.sample(frame, twin.relit(frame, targets)))
    return len(list(out.glob("*.npz")))


def _turned(sky: TargetSky, yaw_deg: float) -> TargetSky:
    """Return a sky turned about the vertical axis, counter-clockwise from above."""
    behind = None if sky.behind is None else sky.behind.rotated(yaw_deg)
    return replace(sky, dome=sky.dome.rotated(yaw_deg), behind=behind)


def _source_skies(skies: Sequence[str], number: int, count: int) -> set[str]:
    """Return the skies under which the true picture of a frame becomes a source."""
    first = number * count
    return {skies[k % len(skies)] for k in range(first, first + count)}


def _recorded_under(made: Mapping[str, _Frame], sky: str) -> dict[str, _Frame]:
    """Return the frame as if recorded under one of the skies, relit to the others."""
    source = made[sky]
    picture, frames = source.truth_srgb8, {}
    assert picture is not None
    for name, frame in made.items():
        if name == sky:
            continue
        inputs = replace(
            frame.inputs,
            radiance=(linear_from_srgb8(picture) / frame.camera_and_skies.gain).astype(np.float32),
            is_clipped=np.any(picture >= _CLIPPED, axis=-1),
            source=source.inputs.target,
            source_sun=source.inputs.target_sun,
            # The twin's estimate belongs to the recorded picture, not to this source.
            found_visibility=None,
            camera_and_skies=replace(
                frame.camera_and_skies, source_sky=source.camera_and_skies.target_sky
            ),
        )
        frames[name] = _Frame(inputs, relight_physical(inputs, RatioConfig()), frame.truth_srgb8)
    return frames


def _sample(made: Mapping[str, _Frame], ego: Bool[np.ndarray, "h w"] | None) -> RelightSample:
    targets = {
        sky: RelightTargetSample(
            target_planes(frame.inputs, frame.camera_and_skies, frame.radiance),
            None
            if frame.truth_srgb8 is None
            else np.ascontiguousarray(np.moveaxis(frame.truth_srgb8, -1, 0)),
        )
        for sky, frame in made.items()
    }
    any_frame = next(iter(made.values()))
    scene = scene_planes(any_frame.inputs, any_frame.camera_and_skies)
    valid = np.ones(any_frame.inputs.sky_matte.shape) if ego is None else ~ego
    return RelightSample({**scene, "valid": valid[None].astype(np.float32)}, targets)
