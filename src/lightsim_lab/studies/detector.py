"""The detector's experiment: logs, relit pictures and labels, then trainings and detections.

A detector is trained on recorded pictures and a second source, such as relit pictures, and tested
under lights that no training picture has (tables 2 and A3 of the paper, with controls).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lightsim.core.version import __version__
from lightsim.errors import InputError
from lightsim.networks.loop import Session
from lightsim.progress import Progress, SilentProgress
from lightsim.render.denoise import check_installed
from lightsim.store.arrays import save_arrays
from lightsim.store.artefact import read_json, write_json
from lightsim.store.checkpoint import FolderCheckpointer
from lightsim_lab.detect.boxes import Matches, match
from lightsim_lab.detect.config import DetectorConfig, config_of
from lightsim_lab.detect.labels import View, read_views
from lightsim_lab.detect.model import Detector
from lightsim_lab.detect.pictures import Picture, Sample, prepared_samples
from lightsim_lab.detect.train import detect, make_detector, seconds_per_step, train_detector
from lightsim_lab.detect.trunk import find_trunk_weights
from lightsim_lab.studies.benchmark import check_unseen, usable_methods
from lightsim_lab.studies.benchmark_options import weights_by_method
from lightsim_lab.studies.detector_data import DetectorData, check_skies, data_of
from lightsim_lab.studies.detector_options import (
    METHODS,
    ORACLE,
    RECORDED,
    ROWS,
    DetectorPrepareOptions,
    DetectorRunOptions,
    Row,
)
from lightsim_lab.studies.study import Study

_LOGGER = logging.getLogger(__name__)
# Random changes of each recorded picture's colours.
_DRAWS = 4
_PREPARE = "Run lightsim evaluate detector prepare with the same options; it makes what is missing."


def prepare_detector(options: DetectorPrepareOptions, progress: Progress) -> None:
    """Make, label, build and relight the logs; what is left out is logged first.

    Each step of a log is a separate process, and finished steps are not repeated.

    Raises:
        InputError: a step failed, a network was trained on a log of the experiment, PandaSet lacks
            sequences, or a sky is missing or differs from those of the folder.
        ArtefactError: weights are damaged or have no record.
        MissingDependencyError: streets require the extra `denoise`.
    """
    data = data_of(options)
    if options.pandaset is None:
        check_installed()
    else:
        check_skies(options.skies)
        _record_skies(options)
    weights, protocol = weights_by_method(options.weights), options.protocol
    names = [*data.train, *data.test]
    wanted = [method for method in METHODS if method in options.asked]
    methods, notes = usable_methods(wanted, weights, is_required=bool(options.rows))
    for note in (*data.notes, *notes):
        _LOGGER.warning(note)
    for method in methods:
        check_unseen(method, weights.get(method), names, "experiment")
    study = Study(options.folder / "batch", options.jobs, progress)
    study.run("synthesize", data.synthesize)
    _require(study)
    # Before the builds, which take hours: a recording that cannot be read is found here.
    for name in names:
        if not options.labels(name).is_file():
            data.write_labels(data.logs[name], options.labels(name), progress)
    build = protocol.build if options.pandaset is None else ()
    study.run("build", {
        name: (str(data.logs[name]), "--work", str(options.work(name)), *build)
        for name in data.train
    })  # fmt: skip
    _require(study)
    study.run("relight", {
        (name, method): (
            str(options.work(name)), "--name", f"detector-{method}", "--method", method,
            *data.relight, "--overwrite",
            *(("--weights", str(weights[method])) if method in weights else ()),
            "--sky", *data.skies[name],
        )
        for name in data.train
        for method in methods
    })  # fmt: skip
    _require(study)


def _record_skies(options: DetectorPrepareOptions) -> None:
    """Write the target skies into the folder; relit pictures, inputs and trainings belong to them.

    Raises:
        InputError: the folder has other target skies.
    """
    path, skies = options.folder / "skies.json", list(options.skies)
    if path.is_file() and (found := read_json(path)) != skies:
        raise InputError(
            "the folder belongs to other target skies",
            where=path,
            got=" ".join(skies),
            expected=" ".join(found),
            remedy="Give the same --skies, or another --out.",
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, skies)


def _require(study: Study) -> None:
    if study.failures:
        raise InputError(
            "a step of the experiment failed",
            where=study.failures[0].log,
            got=study.failures[0].last_line,
            remedy="Read the log; the same command continues.",
        )


def run_detector(options: DetectorRunOptions, progress: Progress) -> None:
    """Train and test the unfinished rows and seeds; departures are logged first.

    Raises:
        InputError: pictures or labels are missing, or the weights of the trunk are wrong.
    """
    experiment = Experiment.of(options, progress)
    rows = [name for name in options.asked if options.rows or experiment.has(ROWS[name])]
    for name in options.asked:
        if name not in rows:
            _LOGGER.warning("Left out: %s: no pictures.", name)
    if experiment.trunk is None:
        _LOGGER.warning(
            "The trunk has random weights, and figures are not comparable: install the extra"
            " lightsim-lab[detect], or give --trunk."
        )
    pending = [
        (name, seed)
        for seed in options.seeds or range(options.protocol.seeds)
        for name in rows
        if not (options.run_folder(name, seed) / "run.json").is_file()
    ]
    if not pending:
        return
    recorded, tested = experiment.recorded(), experiment.tested()
    step_s = seconds_per_step(experiment.network(0), recorded)
    steps = sum(ROWS[name].steps for name, _ in pending) * options.protocol.steps
    _LOGGER.info(
        "%d trainings of %.2f s a step: %.1f hours, and tests on %d pictures each",
        len(pending), step_s, steps * step_s / 3600, len(tested),
    )  # fmt: skip
    for name, seed in progress.track(pending, "trainings", len(pending)):
        second = experiment.second(ROWS[name], recorded)
        experiment.train(name, seed, (recorded, second), tested)


@dataclass(frozen=True, eq=False)
class Experiment:
    """Prepared pictures and labels, and the trainings on them.

    Args:
        trunk: weights of the trunk; None: random.
    """

    options: DetectorRunOptions
    data: DetectorData
    config: DetectorConfig
    trunk: Path | None
    progress: Progress

    @staticmethod
    def of(options: DetectorRunOptions, progress: Progress) -> Experiment:
        """Return the experiment of a size and detector."""
        protocol = options.protocol
        config = config_of(protocol.preset if options.detector == "size" else options.detector)
        config = replace(config, loop=replace(config.loop, steps=protocol.steps))
        trunk = find_trunk_weights(options.trunk)
        return Experiment(options, data_of(options), config, trunk, progress)

    def network(self, seed: int) -> Detector:
        """Return an untrained detector."""
        return make_detector(self.config, seed, self.trunk, self.options.device)

    def has(self, row: Row) -> bool:
        """Return whether the pictures of a row exist for some training log."""
        folders = (self._folder(name, row, self.data.lights[0]) for name in self.data.train)
        return not row.method or any(folder.is_dir() for folder in folders)

    def recorded(self) -> list[Sample]:
        """Return the recorded samples of all frames of the training logs.

        Raises:
            InputError: labels or pictures of a log are missing.
        """
        logs = self.data.train
        return [s for n in logs for s in self._samples(n, Row(), (RECORDED,), self._views(n))]

    def second(self, row: Row, recorded: Sequence[Sample]) -> list[Sample]:
        """Return the samples of a row's second source; raises as `recorded`.

        They show the frames that are relit, in all rows: rows differ in light and colour only.
        """
        if row.source == RECORDED:
            return [s for s in recorded if self.data.is_relit(s.view)]
        lights = self.data.lights if row.method else (RECORDED,)
        return [s for n in self.data.train for s in self._samples(n, row, lights, self._relit(n))]

    def tested(self) -> list[Sample]:
        """Return the recorded and true pictures of the test logs, of equal frames under all lights;
        raises as `recorded`."""
        sources = ((Row(), (RECORDED,)), (Row(ORACLE), self.data.true_lights))
        return [
            s
            for name in self.data.test
            for row, lights in sources
            if lights
            for s in self._samples(name, row, lights, self._relit(name))
        ]

    def _relit(self, name: str) -> list[View]:
        return [view for view in self._views(name) if self.data.is_relit(view)]

    def _views(self, name: str) -> list[View]:
        """Return the labelled views of a log."""
        labels = self.options.labels(name)
        if not labels.is_file():
            raise InputError(f"the labels of the log {name} are missing", where=labels,
                             remedy=_PREPARE)  # fmt: skip
        return read_views(labels)

    def _samples(
        self, name: str, row: Row, lights: Sequence[str], views: Sequence[View]
    ) -> list[Sample]:
        """Return the samples of views of a log under some lights."""
        suffix = "png" if row.method in METHODS else "jpg"
        pictures = [
            Picture(
                view, light, self._folder(name, row, light) / f"{view.name}.{suffix}",
                row.change, draw,
            )
            for light in lights
            for view in views
            for draw in range(1 if row.change == "none" else _DRAWS)
        ]  # fmt: skip
        missing = [picture.path for picture in pictures if not picture.path.is_file()]
        if missing:
            raise InputError(
                f"{len(missing)} of {len(pictures)} pictures ({row.source}) of the log {name} are"
                " missing",
                where=missing[0],
                remedy=_PREPARE,
            )
        path = self.options.results / "inputs" / f"{name}-{row.source}.npz"
        return prepared_samples(name, pictures, path, self.network(0), self.progress)

    def _folder(self, name: str, row: Row, light: str) -> Path:
        """Return the folder of a log's pictures."""
        if row.method not in METHODS:
            return self.data.true_pictures(name, light)
        scenario = self.options.work(name) / "scenarios" / f"detector-{row.method}"
        # One sky has no folder of its own.
        is_alone = len(self.data.lights) == 1
        return (scenario if is_alone else scenario / light) / "frames"

    def train(
        self,
        name: str,
        seed: int,
        sources: tuple[Sequence[Sample], Sequence[Sample]],
        tested: Sequence[Sample],
    ) -> None:
        """Train one row with one seed, and write its detections and their matches."""
        folder, loop = self.options.run_folder(name, seed), self.config.loop
        folder.mkdir(parents=True, exist_ok=True)
        loop = replace(loop, steps=round(loop.steps * ROWS[name].steps))
        config = replace(self.config, loop=loop)
        network = make_detector(config, seed, self.trunk, self.options.device)
        checkpointer = FolderCheckpointer(folder)
        session = Session(checkpointer, self.progress, device=self.options.device)
        train_detector(network, sources, seed, session, f"{name}, seed {seed}")
        found = detect(network, tested, SilentProgress())
        matches = [
            match(one, s.view.boxes, s.view.ignored) for one, s in zip(found, tested, strict=True)
        ]
        save_arrays(folder / "matches.npz", _arrays(tested, matches))
        # Written last: it marks the training as finished.
        write_json(folder / "run.json", {
            "row": name, "seed": seed, "steps": loop.steps,
            "trunk": "random" if self.trunk is None else self.trunk.name,
            "pictures": {"recorded": len(sources[0]), "second": len(sources[1]),
                         "test": len(tested)},
            "version": __version__,
        })  # fmt: skip
        checkpointer.finish()


def _arrays(tested: Sequence[Sample], matches: Sequence[Matches]) -> dict[str, np.ndarray]:
    """Return the matches of all pictures as arrays, with the picture of every detection and box."""
    number = np.arange(len(tested))
    names = ("boxes", "scores", "is_true", "is_counted", "distance_m", "truth_distance_m")
    return {
        "street": np.array([s.street for s in tested]),
        "light": np.array([s.light for s in tested]),
        "view": np.array([s.view.name for s in tested]),
        "picture": np.repeat(number, [len(m.scores) for m in matches]),
        "truth_picture": np.repeat(number, [len(m.truth_distance_m) for m in matches]),
        **{name: np.concatenate([getattr(m, name) for m in matches]) for name in names},
    }
