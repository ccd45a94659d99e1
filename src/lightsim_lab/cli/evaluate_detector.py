"""Commands of `lightsim evaluate detector`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from lightsim.cli.options import Verbose, print_line, show
from lightsim.progress import terminal_progress
from lightsim_lab.studies.detector_options import (
    DetectorPrepareOptions,
    DetectorRunOptions,
    DetectorTableOptions,
)


@dataclass(frozen=True)
class DetectorPrepare(DetectorPrepareOptions):
    """Make the twins, relit pictures and labels of the experiment, and its synthetic streets."""

    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Run the unfinished steps."""
        from lightsim_lab.studies.detector import prepare_detector

        prepare_detector(self, terminal_progress())


@dataclass(frozen=True)
class DetectorRun(DetectorRunOptions):
    """Train and test the detector for each row and seed."""

    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Run the unfinished trainings."""
        from lightsim_lab.studies.detector import run_detector

        run_detector(self, terminal_progress())


@dataclass(frozen=True)
class DetectorTable(DetectorTableOptions):
    """Print average precision by row, with intervals over test logs and seeds."""

    json: Path | None = None
    """JSON file to write the table to."""
    pictures: Path | None = None
    """Folder for the test pictures in which --compared detects most more and most fewer vehicles
    than --reference."""
    verbose: Verbose = False
    """Show the stack trace of an error."""

    def run(self) -> None:
        """Print the table of the finished trainings, and write the pictures."""
        from lightsim_lab.studies.detector_pictures import write_pictures
        from lightsim_lab.studies.detector_table import detector_table

        show(detector_table(self), self.json)
        if self.pictures is not None:
            for path in write_pictures(self, self.pictures):
                print_line(f"picture: {path}")


_Detector = (
    Annotated[DetectorPrepare, tyro.conf.subcommand("prepare")]
    | Annotated[DetectorRun, tyro.conf.subcommand("run")]
    | Annotated[DetectorTable, tyro.conf.subcommand("table")]
)


@dataclass(frozen=True)
class EvaluateDetector:
    """Measure what relit pictures add to the training of a vehicle detector: tables 2 and A3 of the
    paper, with controls."""

    step: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[_Detector]]

    def run(self) -> None:
        """Run the chosen step."""
        self.step.run()
