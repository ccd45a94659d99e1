"""Benchmark of relighting and edits: `lightsim evaluate benchmark`.

Streets with true relit and edited pictures are made from seeds, twins are built from the logs
alone, and every method relights them. A leaderboard summarises the scores.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.render.denoise import check_installed
from lightsim.render.reference.blender import find_bpy
from lightsim.store.artefact import write_text
from lightsim.store.weights import read_record
from lightsim_lab.baselines.methods import ALL_METHODS, FIELD_METHOD
from lightsim_lab.metrics.options import OURS
from lightsim_lab.studies.benchmark_options import (
    REFERENCE,
    BenchmarkOptions,
    BenchmarkSize,
)
from lightsim_lab.studies.benchmark_page import write_page
from lightsim_lab.studies.leaderboard import Leaderboard, make_leaderboard
from lightsim_lab.studies.study import Study
from lightsim_lab.synthetic.checksum import street_checksum
from lightsim_lab.synthetic.plan import Size, plan_street, street_name
from lightsim_lab.synthetic.skies import more_sky_specs, sky_specs
from lightsim_lab.training.hdr_skies import skies_of_side, some_of

_STREET_SIZE: dict[BenchmarkSize, Size] = {"small": "benchmark", "full": "full"}
_BUILD: dict[BenchmarkSize, tuple[str, ...]] = {
    # Equal to the builds of training streets of this size.
    "small": ("--image-scale", "1", "--hold-out", "5", "--neural-steps", "150"),
    "full": ("--image-scale", "1", "--hold-out", "8"),
}
# Measured skies per street, if a folder of panoramas is given; as many as analytic skies otherwise.
_MEASURED_SKIES = 3


@dataclass(frozen=True)
class Benchmark:
    """Leaderboard of relighting, and of edits if their truth exists."""

    relighting: Leaderboard
    edits: Leaderboard | None

    @property
    def boards(self) -> tuple[Leaderboard, ...]:
        """The existing leaderboards."""
        return (self.relighting,) if self.edits is None else (self.relighting, self.edits)

    def to_table(self) -> str:
        """Return the report as Markdown."""
        return "\n\n".join(board.to_table() for board in self.boards)

    def to_json(self) -> str:
        """Return the leaderboards as JSON."""
        return json.dumps([json.loads(board.to_json()) for board in self.boards], indent=2)


def benchmark(options: BenchmarkOptions, progress: Progress) -> Benchmark:
    """Make, build, relight and score the streets of a side, and write the leaderboard.

    Each step of a street is a separate process. Finished steps are not repeated. A failed street is
    reported at the end and does not stop the others.

    Raises:
        InputError: a network was trained on a street of the side or its training streets are not
            recorded, the generator makes other streets than the committed ones, an option is
            wrong, or no street was finished.
        ArtefactError: weights are damaged or have no record.
        MissingDependencyError: streets require the extra `denoise`, and Cycles an interpreter
            with bpy.
    """
    check_installed()
    if options.renderer == "cycles":
        find_bpy(options.blender_python)
    seeds = options.seeds or tuple(options.checksums)
    weights = options.weights_by_method
    requested: Sequence[str] = options.methods or tuple(ALL_METHODS)
    usable, notes = usable_methods(requested, weights, is_required=bool(options.methods))
    # Removes duplicates and keeps the order.
    methods = list(dict.fromkeys([REFERENCE, *usable]))
    for seed in seeds:
        _check_street(seed, options)
    # Checked before the hours of building and relighting.
    for method in methods:
        _check_unseen(method, options)
    notes += _run(options, seeds, methods, progress)
    result = _leaderboards(options, notes)
    write_text(options.root / "leaderboard.json", result.to_json() + "\n")
    write_page(options, result.boards)
    return result


def usable_methods(
    requested: Sequence[str], weights: Mapping[str, Path], *, is_required: bool
) -> tuple[list[str], list[str]]:
    """Return the methods that have weights, and notes on the others.

    Raises:
        InputError: a method has no weights, and all are required.
    """
    from lightsim.relighting.methods import relight_by

    found: list[str] = []
    notes: list[str] = []
    for method in requested:
        if method == FIELD_METHOD:
            # The weights of this method do not exist yet, because it is trained on each street.
            found.append(method)
            continue
        try:
            relight_by(method, weights.get(method))
        except InputError as error:
            if is_required:
                raise
            notes.append(f"Left out: {method}: {error.what}.")
            continue
        found.append(method)
    return found, notes


def _check_street(seed: int, options: BenchmarkOptions) -> None:
    """Check that the generator makes the committed street; otherwise scores are not comparable."""
    found, expected = street_checksum(seed, options.style), options.checksums[seed]
    if found != expected:
        raise InputError(
            "the generated street differs from the street of the leaderboard",
            where=f"street {street_name(seed, options.style)}",
            got=found,
            expected=expected,
            remedy="Use the version of LightSim that the leaderboard names.",
        )


def _check_unseen(method: str, options: BenchmarkOptions) -> None:
    """Check that a network was not trained on a street of the set and, unless the set is for
    validation, not selected by scores on it."""
    names = {street_name(seed, options.style) for seed in options.checksums}
    path, may_select = options.weights_by_method.get(method), options.what == "validation"
    check_unseen(method, path, names, f"{options.what} side", may_select=may_select)


def check_unseen(
    method: str,
    weights: Path | None,
    names: Collection[str],
    what: str,
    *,
    may_select: bool = False,
) -> None:
    """Check that a network was not trained on some streets.

    Args:
        weights: weights file; None: the shipped one.
        what: what the streets belong to, for the message.
        may_select: the network may have been selected by scores on the streets.

    Raises:
        InputError: the network was trained on a street, or its streets are not recorded.
    """
    path = ALL_METHODS[method].shipped_file() if weights is None else weights
    if path is None:
        return
    streets = read_record(path).streets
    if isinstance(streets, str):
        raise InputError(
            "the weights do not record their training streets",
            where=path,
            got=streets,
            remedy="Train again, or record the streets with tools/name_streets.py.",
        )
    used = {*streets["training"], *(() if may_select else streets["validation"])} & set(names)
    if used:
        raise InputError(
            f"the network was trained on streets of the {what}",
            where=path,
            got=", ".join(sorted(used)),
            expected="weights trained on none of them",
        )


def _run(
    options: BenchmarkOptions, seeds: Sequence[int], methods: Sequence[str], progress: Progress
) -> list[str]:
    """Run all steps of all streets; return notes on failures.

    Streets are processed in groups as large as the number of processes, so that an interrupted run
    leaves complete streets.
    """
    study = Study(options.root / "logs", options.jobs, progress)
    for first in range(0, len(seeds), options.jobs):
        _run_streets(options, seeds[first : first + options.jobs], methods, study)
    return [f"Failed: street {f.row}: {f.last_line} ({f.log})" for f in study.failures]


def _run_streets(
    options: BenchmarkOptions, seeds: Sequence[int], methods: Sequence[str], study: Study
) -> None:
    """Run all steps of some streets; streets without log or twin are not relit."""
    work, build = options.work, _BUILD[options.size]
    made = study.run("synthesize", {seed: _synthesize(options, seed) for seed in seeds})
    logs = {seed: str(options.street(seed) / "log") for seed in made}
    built = study.run(
        "build", {seed: (log, "--work", str(work(seed)), *build) for seed, log in logs.items()}
    )
    if FIELD_METHOD in methods:
        study.run("train", {seed: (FIELD_METHOD, str(work(seed))) for seed in built})
    # One process per method measures its own cost. One process for all scores follows, because half
    # of the time of scoring is spent on the truth.
    relit_by: dict[int, list[str]] = {seed: [] for seed in built}
    for method in methods:
        name = ("--name", f"{options.scenarios}-{method}", "--no-scores")
        lines = {seed: (*_relight(options, seed, [method]), *name) for seed in built}
        for seed in study.run("evaluate", lines):
            relit_by[seed].append(method)
    scores = {seed: _score(options, seed, relit) for seed, relit in relit_by.items() if relit}
    study.run("evaluate", scores)
    study.run("evaluate", {seed: _score_edits(options, seed) for seed in built})


def _synthesize(options: BenchmarkOptions, seed: int) -> tuple[str, ...]:
    size = _STREET_SIZE[options.size]
    words = ("--out", str(options.street(seed)), "--seed", str(seed), "--size", size)
    skies = skies_of_side(options.hdri, options.split, options.side)
    if skies:
        more = ("--sky", *map(str, some_of(skies, seed, _MEASURED_SKIES)))
    else:
        more = ("--more-skies",)
    words += ("--style", options.style, "--denoise", "--edits", *more)
    if options.renderer != "mitsuba":
        words += ("--renderer", options.renderer)
    if options.blender_python is not None:
        words += ("--blender-python", str(options.blender_python))
    return words


def _relight(options: BenchmarkOptions, seed: int, methods: Sequence[str]) -> tuple[str, ...]:
    truth = options.street(seed) / "truth"
    words = ["relight", str(options.work(seed)), "--truth", str(truth)]
    words += ["--method", ",".join(methods)]
    files = options.weights_by_method
    chosen = [f"{method}={files[method]}" for method in methods if method in files]
    words += ["--weights", *chosen] if chosen else []
    if options.source_sky == "true":
        words += ["--source-sky", str(truth / "skies" / "source.exr")]
    return tuple(words)


def _score(options: BenchmarkOptions, seed: int, methods: Sequence[str]) -> tuple[str, ...]:
    """Return the arguments that score the methods that have relit a street."""
    name = options.scenarios if len(methods) > 1 else f"{options.scenarios}-{methods[0]}"
    out = options.scores("relighting") / f"{seed}.json"
    return (*_relight(options, seed, methods), "--name", name, "--out", str(out))


def _score_edits(options: BenchmarkOptions, seed: int) -> tuple[str, ...]:
    truth, out = options.street(seed) / "truth", options.scores("edits") / f"{seed}.json"
    return ("edits", str(options.work(seed)), "--truth", str(truth), "--out", str(out))


def _leaderboards(options: BenchmarkOptions, notes: Sequence[str]) -> Benchmark:
    """Make leaderboards of all finished streets, including those of other runs."""
    relit, edits = options.scores("relighting"), options.scores("edits")
    if not any(relit.glob("*.json")):
        raise InputError(
            "no street was finished", where=options.root, got="; ".join(notes) or None,
            remedy="Read the logs; the same command continues.",
        )  # fmt: skip
    plan = plan_street(0)
    # The first sky is that of the recording.
    own = [spec.name for spec in (*sky_specs(plan)[1:], *more_sky_specs(plan))]
    title = f"{options.what}, {options.size}, {options.style}, source sky {options.source_sky}"
    streets = [str(seed) for seed in options.checksums]
    relighting = make_leaderboard(f"Relighting ({title})", relit, REFERENCE, own, streets, notes)
    if not any(edits.glob("*.json")):
        return Benchmark(relighting, None)
    names = ("remove-parked", "move-parked", "remove-moving", "move-moving", "insert", "ego-shift")
    return Benchmark(relighting, make_leaderboard(f"Edits ({title})", edits, OURS, names, streets))
