"""Command `lightsim train prepare relight`: samples of synthetic streets, or of built logs."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Sequence

from lightsim.build.options import BuildOptions
from lightsim.build.pipeline import build
from lightsim.build.workspace import Workspace
from lightsim.core.reading import LogReading
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.render.denoise import check_installed
from lightsim.simulation.options import RelightOptions
from lightsim_lab.studies.benchmark_options import held_out_names
from lightsim_lab.studies.relight_samples import TargetDraws, write_samples, write_twin_samples
from lightsim_lab.synthetic import synthesize
from lightsim_lab.synthetic.generate import Variation
from lightsim_lab.synthetic.plan import street_name
from lightsim_lab.synthetic.skies import FurtherSkies
from lightsim_lab.training.hdr_skies import skies_of_side, some_of
from lightsim_lab.training.options import PrepareRelightOptions

_LOGGER = logging.getLogger(__name__)
STREETS = "streets"
# Training steps of the neural field, as on the benchmark's streets (docs/benchmarks/relighting.md).
_NEURAL_STEPS = 150
# Number of measured skies of a synthetic street, in addition to its three analytic ones.
_MEASURED = 2
# Number of measured skies of a log: ten in the paper, in addition to ten estimated ones ("Learning
# details").
_PUBLISHED = 10


def prepare_relight(options: PrepareRelightOptions, progress: Progress) -> None:
    """Write samples of synthetic streets, or of the given work folders.

    Finished streets and frames are skipped.

    Raises:
        InputError: a sky or work folder is wrong, or a street belongs to the benchmark.
        MissingDependencyError: streets require the extra `denoise`.
    """
    if options.works:
        _sample_works(options, progress)
    else:
        _make_streets(options, progress)


def _sample_works(options: PrepareRelightOptions, progress: Progress) -> None:
    """Sample the twins of work folders: OUT/<work folder>/<camera>_<frame>.npz.

    Target skies are those that the builds of the other logs estimated, and measured ones.
    """
    names = [work.absolute().name for work in options.works]
    _check_names(names)
    skies = [Workspace(work).need("sky") / "source.exr" for work in options.works]
    # A missing twin is reported before the first log is sampled.
    for work in options.works:
        Workspace(work).need("twin")
    measured = skies_of_side(options.hdri, options.split, "train")
    count = options.skies_per_street
    draws = TargetDraws(
        options.skies_per_frame, options.sky_offset_deg, options.every, options.seed
    )
    for number, (work, name) in enumerate(zip(options.works, names, strict=True)):
        began, seed = time.monotonic(), options.seed + number
        others = [path for path, own in zip(skies, names, strict=True) if own != name]
        chosen = some_of(others, seed, options.estimated_skies)
        chosen += some_of(measured, seed, _PUBLISHED if count is None else count)
        if not chosen:
            raise InputError(
                "the log has no target skies",
                where=work,
                expected="skies of other logs or measured skies",
                remedy="Give more --works, or --hdri with --split.",
            )
        frames = RelightOptions(
            name="samples",
            method="physical",
            sky=tuple(map(str, chosen)),
            cameras=options.cameras,
            image_scale=options.image_scale,
            allow_stale=options.allow_stale,
        )
        made = write_twin_samples(work, frames, draws, options.out / name, progress)
        _LOGGER.info(
            "log %s: %d frames, %d of %d skies each, %.0f s",
            name,
            made,
            min(options.skies_per_frame, len(chosen)),
            len(chosen),
            time.monotonic() - began,
        )


def _check_names(names: Sequence[str]) -> None:
    """Reject work folders of one name, and those named as streets that nothing may learn from."""
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            "two work folders have the same name, so their samples would be mixed",
            where="--works",
            got=", ".join(twice),
            remedy="Rename one of them.",
        )
    _check_held_out(set(names), "--works")


def _check_held_out(names: set[str], where: str) -> None:
    held_out = held_out_names() & names
    if held_out:
        raise InputError(
            "streets of the benchmark must not be used for training",
            where=where,
            got=", ".join(sorted(held_out)),
            remedy="Give other seeds." if where == "--streets" else "Give other logs.",
        )


def _make_streets(options: PrepareRelightOptions, progress: Progress) -> None:
    """Make, build and sample every requested street: OUT/<street>/<camera>_<frame>.npz.

    The files of a street in OUT/streets are removed after sampling.
    """
    names = {seed: street_name(seed, options.style) for seed in options.streets}
    _check_held_out(set(names.values()), "--streets")
    # Checked before the first street is made, which takes minutes.
    check_installed()
    skies = skies_of_side(options.hdri, options.split, "train")
    count = options.skies_per_street
    for seed in options.streets:
        done = options.out / names[seed]
        if done.is_dir():
            continue
        began, processor = time.monotonic(), time.process_time()
        street = options.out / STREETS / names[seed]
        chosen = some_of(skies, seed, _MEASURED if count is None else count)
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
        made = write_samples(street / "work", street / "truth", samples, progress)
        # The rename is atomic: a folder of this name is always complete.
        samples.rename(done)
        if not options.keep:
            shutil.rmtree(street)
        _LOGGER.info(
            "street %s: %d frames under %d skies, %.0f s, %.0f processor seconds, %.0f MB",
            names[seed],
            made,
            3 + options.drawn_suns + len(chosen),
            time.monotonic() - began,
            time.process_time() - processor,
            sum(p.stat().st_size for p in done.iterdir()) / 1e6,
        )
