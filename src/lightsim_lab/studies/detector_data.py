"""Data of the detector's experiment: synthetic streets with ground truth, or PandaSet's sequences.

Both have training logs, which are relit from their twins, and test logs under other lights.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.simulation.options import FrameOptions
from lightsim.simulation.skies import parse_sky
from lightsim_lab.detect.labels import View, label_log, label_street
from lightsim_lab.studies.detector_options import RECORDED, TEST_LIGHTS, DetectorOptions
from lightsim_lab.studies.paper_pictures import CAMERA, logs_of
from lightsim_lab.synthetic.plan import config_of

# Sequences of the paper's test, in a suburb; the others train (appendix, "Downstream Perception
# Training").
_TEST = (
    "080 084 085 086 088 089 090 091 092 093 094 095 097 098 099 100 101 102 103 104 105 106 109 "
    "110 112 113 115 116 117 119 120 122 123 124 158"
)
_TEST_SEQUENCES = frozenset(_TEST.split())
# Numbers of training and of test sequences in the paper.
_OF_PAPER = (68, 35)


@dataclass(frozen=True, eq=False)
class DetectorData:
    """Logs of the experiment.

    Args:
        train, test: names of the training and of the test logs.
        logs: folder of each log; its pictures are camera/<camera>/<frame>.jpg.
        lights: target lights of the training logs; `relight` names its folders after them.
        skies: target skies of each training log, spelt as for --sky.
        true_lights: lights of the test of which true pictures exist, besides the recorded ones.
        relit_stems: numbers of the frames that are relit and have true pictures; empty: all.
        relight: options of `relight` that select these frames.
        synthesize: line of `synthesize` for each log that has to be made.
        write_labels: labels the views of a log's folder, and writes them to a file.
        notes: departures from the paper.
    """

    train: tuple[str, ...]
    test: tuple[str, ...]
    logs: Mapping[str, Path]
    lights: tuple[str, ...]
    skies: Mapping[str, tuple[str, ...]]
    true_lights: tuple[str, ...]
    relit_stems: Collection[int]
    relight: tuple[str, ...]
    synthesize: Mapping[str, tuple[str, ...]]
    write_labels: Callable[[Path, Path, Progress], None]
    notes: tuple[str, ...] = ()

    def true_pictures(self, name: str, light: str) -> Path:
        """Return the folder of the true pictures of a log, which are the recorded ones under the
        recorded light; it need not exist."""
        if light == RECORDED:
            return self.logs[name] / "camera"
        return self.logs[name].parent / "truth" / "relit" / light

    def is_relit(self, view: View) -> bool:
        """Return whether the frame of a view is relit, and has true pictures if there are any."""
        return not self.relit_stems or int(Path(view.name).name) in self.relit_stems


def data_of(options: DetectorOptions) -> DetectorData:
    """Return the data that the options select.

    Raises:
        InputError: the folder of PandaSet lacks sequences of a side, or a sky is malformed or has
            the name of another.
    """
    return _streets(options) if options.pandaset is None else _sequences(options, options.pandaset)


def _streets(options: DetectorOptions) -> DetectorData:
    """Synthetic streets. Target skies and truth are path-traced."""
    protocol = options.protocol
    logs = {name: options.street(name) / "log" for name in protocol.streets}
    stems = config_of(protocol.street).truth_stems
    first, last = min(stems), max(stems)
    step = max((last - first) // max(len(stems) - 1, 1), 1)
    traced = ("--size", protocol.street, "--paths", str(protocol.paths), "--denoise")
    more = {True: ("--drawn-suns", str(protocol.suns)), False: ("--more-skies",)}
    return DetectorData(
        train=tuple(protocol.train),
        test=tuple(protocol.test),
        logs=logs,
        lights=protocol.lights,
        skies={
            name: tuple(
                str(options.street(name) / "truth" / "skies" / f"{light}.exr")
                for light in protocol.lights
            )
            for name in protocol.train
        },
        true_lights=TEST_LIGHTS[1:],
        relit_stems=stems,
        relight=("--frames", f"{first}:{last + 1}:{step}", "--sky-scale", "none"),
        synthesize={
            name: ("--out", str(options.street(name)), "--style", style, "--seed", str(seed),
                   *traced, *more[name in protocol.train])
            for name, (style, seed) in protocol.streets.items()
        },
        write_labels=lambda log, path, progress: label_street(log.parent, path, progress),
    )  # fmt: skip


def _sequences(options: DetectorOptions, pandaset: Path) -> DetectorData:
    """PandaSet's sequences with their front pictures, as in the paper: relit pictures have no
    truth, and the test is under the lights of the test sequences' own recordings."""
    logs = {log.name: log for log in logs_of(pandaset)}
    train = tuple(name for name in logs if name not in _TEST_SEQUENCES)
    test = tuple(name for name in logs if name in _TEST_SEQUENCES)
    if not train or not test:
        raise InputError(
            "the experiment needs front pictures of sequences of the training and of the test",
            where=pandaset,
            got=", ".join(logs) or "no sequence",
            expected=f"tested: {', '.join(sorted(_TEST_SEQUENCES))}; trained: any others",
        )
    found = f"{len(train)} sequences train and {len(test)} test"
    every = options.protocol.every
    return DetectorData(
        train=train,
        test=test,
        logs=logs,
        lights=tuple(FrameOptions(sky=options.skies).sky_by_name),
        skies=dict.fromkeys(train, options.skies),
        true_lights=(),
        relit_stems=(),
        relight=("--cameras", CAMERA, "--frames", f"::{every}"),
        synthesize={},
        write_labels=lambda log, path, progress: label_log(log, CAMERA, every, path, progress),
        notes=() if (len(train), len(test)) == _OF_PAPER else (
            f"{found}; the paper has {_OF_PAPER[0]} and {_OF_PAPER[1]}. Sequences without"
            f" camera/{CAMERA} in {pandaset} are left out.",
        ),
    )  # fmt: skip


def check_skies(skies: tuple[str, ...]) -> None:
    """Check that the files of skies exist.

    Raises:
        InputError: a file is missing.
    """
    for choice in FrameOptions(sky=skies).sky_by_name.values():
        parse_sky(choice).require_file()
