"""Python interface of LightSim: the main commands as functions."""

from __future__ import annotations

from pathlib import Path

from lightsim.build import pipeline as pipeline
from lightsim.build.options import BuildOptions
from lightsim.build.workspace import Workspace
from lightsim.core.log import DrivingLog
from lightsim.core.reading import LogReading
from lightsim.core.twin import DigitalTwin
from lightsim.datasets.reader import read_log
from lightsim.datasets.scale import at_scale
from lightsim.masks.ego_body import with_ego_body
from lightsim.masks.ego_vehicle import ego_vehicle_masks
from lightsim.progress import Progress, SilentProgress
from lightsim.simulation import relight as scenarios
from lightsim.simulation.edited import simulate as simulate_scenario
from lightsim.simulation.options import RelightOptions, SimulateOptions


def load_log(reading: LogReading) -> DrivingLog:
    """Return a recorded log; images and sweeps are read at their first use.

    Raises:
        InputError: a file is missing or broken, or an option is wrong.
    """
    return at_scale(with_ego_body(read_log(reading, ego_vehicle_masks)), reading.image_scale)


def build_twin(
    work: Path | str, options: BuildOptions, *, progress: Progress | None = None
) -> DigitalTwin:
    """Make the missing and stale stages of a work folder and return the twin.

    Raises:
        InputError: the log or an option is wrong.
        ArtefactError: another process works in the folder.
    """
    return pipeline.build(Path(work), options, progress or SilentProgress()).twin


def load_twin(work: Path | str) -> DigitalTwin:
    """Return the twin of a finished build.

    Raises:
        ArtefactError: it has not been built.
    """
    return Workspace(Path(work)).twin


def relight(
    work: Path | str, options: RelightOptions, *, progress: Progress | None = None
) -> list[Path]:
    """Relight the log of a work folder and return the folder of the result under each sky.

    Raises:
        ArtefactError, InputError: as `lightsim.simulation.relight.relight`.
    """
    return scenarios.relight(Path(work), options, progress or SilentProgress())


def simulate(
    work: Path | str,
    scenario: Path | str,
    options: SimulateOptions | None = None,
    *,
    progress: Progress | None = None,
) -> list[Path]:
    """Simulate a SCENARIO.json and return the folder of the result under each sky.

    Raises:
        ArtefactError, InputError: as `lightsim.simulation.edited.simulate`.
    """
    asked = options or SimulateOptions()
    return simulate_scenario(Path(work), Path(scenario), asked, progress or SilentProgress())
