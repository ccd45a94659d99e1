"""The command line: one file a command, one frozen dataclass of options with its `run`.

Heavy packages are imported inside `run`, so that `lightsim --help` answers at once.
"""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Annotated

import tyro

from lightsim.cli.actors import Actors
from lightsim.cli.assets import AssetsGroup
from lightsim.cli.batch import Batch
from lightsim.cli.build import Build
from lightsim.cli.demo import Demo
from lightsim.cli.doctor import Doctor
from lightsim.cli.evaluate import EvaluateGroup
from lightsim.cli.relight import Relight
from lightsim.cli.render import Render
from lightsim.cli.scenario import ScenarioGroup
from lightsim.cli.simulate import Simulate
from lightsim.cli.sky import SkyGroup
from lightsim.cli.status import Status
from lightsim.cli.synthesize import Synthesize
from lightsim.cli.train import PrepareGroup, TrainGroup
from lightsim.errors import LightSimError


def _command(name: str) -> object:
    return tyro.conf.subcommand(name)


Command = (
    Annotated[Build, _command("build")]
    | Annotated[Relight, _command("relight")]
    | Annotated[Simulate, _command("simulate")]
    | Annotated[ScenarioGroup, _command("scenario")]
    | Annotated[Actors, _command("actors")]
    | Annotated[AssetsGroup, _command("assets")]
    | Annotated[Render, _command("render")]
    | Annotated[SkyGroup, _command("sky")]
    | Annotated[EvaluateGroup, _command("evaluate")]
    | Annotated[Batch, _command("batch")]
    | Annotated[TrainGroup, _command("train")]
    | Annotated[Synthesize, _command("synthesize")]
    | Annotated[Demo, _command("demo")]
    | Annotated[Doctor, _command("doctor")]
    | Annotated[Status, _command("status")]
)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point. Exit codes: 0 done, 1 our error, 2 wrong usage, 130 interrupted."""
    words = sys.argv[1:] if argv is None else argv
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        # Options check their ranges where they are made: while the command line is read.
        command = tyro.cli(
            Command,
            prog="lightsim",
            description="An open lighting simulator for driving logs.",
            args=words,
            config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes),
        )
        if isinstance(command, EvaluateGroup):
            command = command.measure
        elif isinstance(command, SkyGroup):
            command = command.do
        elif isinstance(command, ScenarioGroup):
            command = command.scene
        elif isinstance(command, AssetsGroup):
            command = command.do
        elif isinstance(command, TrainGroup):
            command = command.what
            if isinstance(command, PrepareGroup):
                command = command.data
        with _stopped_like_ctrl_c():
            command.run()
    except KeyboardInterrupt:
        sys.exit(_say_interrupted())
    except Exception as error:
        if _is_interruption(error):
            sys.exit(_say_interrupted())
        if {"-v", "--verbose"} & set(words):
            raise
        sys.exit(_complain(error))


@contextmanager
def _stopped_like_ctrl_c() -> Generator[None]:
    """SIGTERM, by which schedulers stop a job, ends a command as cleanly as Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Only the main thread may handle signals.
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _say_interrupted() -> int:
    sys.stderr.write("lightsim: interrupted; run the same command again to go on\n")
    return 130


def _is_interruption(error: BaseException | None) -> bool:
    """Whether an interruption is the cause: Dr.Jit wraps it in an error of its own."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def _complain(error: Exception) -> int:
    """One line: ours as it is, the system's by its name, and a request for a report of what
    should not happen."""
    kind = f"{type(error).__name__}: {error}"
    if isinstance(error, LightSimError):
        message = f"{error}"
    elif isinstance(error, OSError):
        message = f"{kind}. Use -v for the trace."
    elif isinstance(error, MemoryError):
        message = "the memory does not suffice. Try a smaller --image-scale or fewer --frames."
    else:
        message = f"this is a fault of LightSim: {kind}. Please report it with the trace of -v."
    sys.stderr.write(f"lightsim: error: {' '.join(message.split())}\n")
    return 1
