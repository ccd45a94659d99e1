"""Data of the detector's experiment: synthetic streets with ground truth, or PandaSet's sequences.

Both have training logs, which are relit from their twins, and test logs under other lights.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol as Interface

from lightsim.core.sky_choice import SkyChoice
from lightsim.errors import InputError
from lightsim.progress import Progress
from lightsim.simulation.skies import parse_sky
from lightsim_lab.detect.labels import label_log, label_street
from lightsim_lab.studies.detector_options import TEST_LIGHTS, DetectorOptions
from lightsim_lab.studies.paper_pictures import CAMERA, logs_of
from lightsim_lab.studies.study import Study
from lightsim_lab.synthetic.plan import config_of

# Sequences of the paper's test, in a suburb; the others train (appendix, "Downstream Perception
# Training").
_TEST = (
    "080 084 085 086 088 089 090 091 092 093 094 095 097 098 099 100 101 102 103 104 105 106 109 "
    "110 112 113 115 116 117 119 120 122 123 124 158"
)
_TEST_SEQUENCES = frozenset(_TEST.split())


class DetectorData(Interface):
    """Logs of the experiment."""

    @property
    def train(self) -> Collection[str]:
        """Names of the training logs."""
        ...

    @property
    def test(self) -> Collection[str]:
        """Names of the test logs."""
        ...

    @property
    def lights(self) -> Sequence[str]:
        """Target lights of the training logs; `relight` names its folders after them."""
        ...

    @property
    def relight(self) -> Sequence[str]:
        """Options of `relight` that select the training pictures."""
        ...

    @property
    def true_lights(self) -> Sequence[str]:
        """Lights of the test of which true pictures exist, besides the recorded ones."""
        ...

    def make(self, study: Study) -> None:
        """Make the logs."""
        ...

    def log(self, name: str) -> Path:
        """Return the folder of a log, whose pictures are camera/<camera>/<frame>.jpg."""
        ...

    def skies(self, name: str) -> Sequence[str]:
        """Return the target skies of a training log, spelt as for --sky."""
        ...

    def true_pictures(self, name: str, light: str) -> Path:
        """Return the folder of the true pictures of a log; it need not exist."""
        ...

    def write_labels(self, name: str, path: Path, progress: Progress) -> None:
        """Label the views of a log, and write them to a file."""
        ...


def data_of(options: DetectorOptions) -> DetectorData:
    """Return the data that the options select.

    Raises:
        InputError: the folder lacks sequences of a side.
    """
    if options.pandaset is None:
        return _Streets(options)
    logs = {log.name: log for log in logs_of(options.pandaset)}
    if not logs.keys() & _TEST_SEQUENCES or not logs.keys() - _TEST_SEQUENCES:
        raise InputError(
            "the experiment needs sequences of the training and of the test",
            where=options.pandaset,
            got=", ".join(logs) or "no sequence",
            expected=f"tested: {', '.join(sorted(_TEST_SEQUENCES))}; trained: any others",
        )
    return _Sequences(options, logs)


@dataclass(frozen=True)
class _Streets(DetectorData):
    """Synthetic streets. Target skies and truth are path-traced."""

    options: DetectorOptions

    @property
    def train(self) -> Collection[str]:
        return self.options.protocol.train

    @property
    def test(self) -> Collection[str]:
        return self.options.protocol.test

    @property
    def lights(self) -> Sequence[str]:
        return self.options.protocol.lights

    @property
    def relight(self) -> Sequence[str]:
        stems = config_of(self.options.protocol.street).truth_stems
        first, last = min(stems), max(stems)
        step = max((last - first) // max(len(stems) - 1, 1), 1)
        return ("--frames", f"{first}:{last + 1}:{step}", "--sky-scale", "none")

    @property
    def true_lights(self) -> Sequence[str]:
        return TEST_LIGHTS[1:]

    def make(self, study: Study) -> None:
        protocol = self.options.protocol
        traced = ("--size", protocol.street, "--paths", str(protocol.paths), "--denoise")
        more = {True: ("--drawn-suns", str(protocol.suns)), False: ("--more-skies",)}
        study.run("synthesize", {
            name: ("--out", str(self.options.street(name)), "--style", style, "--seed", str(seed),
                   *traced, *more[name in protocol.train])
            for name, (style, seed) in protocol.streets.items()
        })  # fmt: skip

    def log(self, name: str) -> Path:
        return self.options.street(name) / "log"

    def skies(self, name: str) -> Sequence[str]:
        folder = self.options.street(name) / "truth" / "skies"
        return [str(folder / f"{light}.exr") for light in self.lights]

    def true_pictures(self, name: str, light: str) -> Path:
        return self.options.street(name) / "truth" / "relit" / light

    def write_labels(self, name: str, path: Path, progress: Progress) -> None:
        label_street(self.options.street(name), path, progress)


@dataclass(frozen=True)
class _Sequences(DetectorData):
    """PandaSet's sequences with their front pictures, as in the paper: relit pictures have no
    truth, and the test is under the lights of the test sequences' own recordings."""

    options: DetectorOptions
    logs: dict[str, Path]

    @property
    def train(self) -> Collection[str]:
        return [name for name in self.logs if name not in _TEST_SEQUENCES]

    @property
    def test(self) -> Collection[str]:
        return [name for name in self.logs if name in _TEST_SEQUENCES]

    @property
    def lights(self) -> Sequence[str]:
        return [parse_sky(SkyChoice(sky)).name for sky in self.options.skies]

    @property
    def relight(self) -> Sequence[str]:
        return ("--cameras", CAMERA, "--frames", f"::{self.options.protocol.every}")

    @property
    def true_lights(self) -> Sequence[str]:
        return ()

    def make(self, study: Study) -> None:
        """Do nothing: the sequences exist."""

    def log(self, name: str) -> Path:
        return self.logs[name]

    def skies(self, name: str) -> Sequence[str]:
        return self.options.skies

    def true_pictures(self, name: str, light: str) -> Path:
        return self.options.folder / "no-truth" / name / light

    def write_labels(self, name: str, path: Path, progress: Progress) -> None:
        label_log(self.logs[name], CAMERA, self.options.protocol.every, path, progress)
