"""LightSim from Python: the commands as functions on objects."""

from __future__ import annotations

from pathlib import Path

from lightsim.core.log import DrivingLog
from lightsim.core.twin import DigitalTwin
from lightsim.datasets.reader import read_log
from lightsim.datasets.scale import at_scale
from lightsim.masks.ego_vehicle import ego_vehicle_masks
from lightsim.pipeline import build as pipeline
from lightsim.pipeline.workspace import Workspace
from lightsim.progress import Progress, SilentProgress
from lightsim.simulate import relight as scenarios
from lightsim.simulate.skies import SkyChoice
from lightsim.store.log import LogReading


def load_log(
    source: Path | str,
    *,
    dataset: str = "auto",
    cameras: tuple[str, ...] = (),
    frames: str = "",
    heading_deg: float | None = None,
    image_scale: float = 1.0,
) -> DrivingLog:
    """A recorded log; images and sweeps are read when they are asked for.

    Raises:
        InputError: a file is missing or broken, or an option is wrong.
    """
    log = read_log(
        Path(source),
        dataset=dataset,
        cameras=cameras,
        frames=frames,
        heading_deg=heading_deg,
        find_ego_vehicle=ego_vehicle_masks,
    )
    return at_scale(log, image_scale)


def build_twin(
    reading: LogReading,
    work: Path | str,
    *,
    preset: str = "standard",
    seed: int = 0,
    neural_steps: int | None = None,
    device: str = "auto",
    progress: Progress | None = None,
) -> DigitalTwin:
    """Make what is missing or stale in the work folder, and load the twin.

    Args:
        neural_steps: of training the neural field; None is the preset's, 0 goes without.
        device: "auto", "cpu" or "cuda", for that training.
    """
    options = pipeline.BuildOptions(reading, preset, seed, neural_steps, device)
    return pipeline.build(Path(work), options, progress or SilentProgress()).twin


def load_twin(work: Path | str) -> DigitalTwin:
    """The twin of a finished build.

    Raises:
        ArtefactError: it has not been built.
    """
    return Workspace(Path(work)).twin


def relight(
    work: Path | str,
    sky: str,
    name: str,
    *,
    options: scenarios.RelightOptions | None = None,
    progress: Progress | None = None,
) -> Path:
    """Relight the log of a work folder under a sky; returns the folder of the result.

    `options`, where given, replaces `sky` and `name` too.
    """
    chosen = options or scenarios.RelightOptions(name, SkyChoice(sky))
    return scenarios.relight(Path(work), chosen, progress or SilentProgress())
