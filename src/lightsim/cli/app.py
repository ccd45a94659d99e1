"""Command line: each command is a frozen dataclass of options with a method `run`, in its own file.

Other packages add commands through entry points of the group `lightsim.commands`.

Heavy packages are imported inside `run`, so that `lightsim --help` is fast.
"""

from __future__ import annotations

import logging
import signal
import sys
import threading
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import Annotated, Any, Union

import tyro

from lightsim.cli.actors import Actors
from lightsim.cli.assets import AssetsGroup
from lightsim.cli.batch import BatchGroup
from lightsim.cli.build import Build
from lightsim.cli.check import Check
from lightsim.cli.doctor import Doctor
from lightsim.cli.export import Export
from lightsim.cli.options import print_line
from lightsim.cli.relight import Relight
from lightsim.cli.render import Render
from lightsim.cli.scenario import ScenarioGroup
from lightsim.cli.simulate import Simulate
from lightsim.cli.sky import SkyGroup
from lightsim.cli.status import Status
from lightsim.cli.view import View
from lightsim.core.extensions import COMMANDS, LABORATORY, load_extension, registered
from lightsim.core.version import __version__
from lightsim.errors import InputError, LightSimError
from lightsim.fleet.staging import shown, staged
from lightsim.profiling import profile_text, profiled

OWN_COMMANDS: Mapping[str, type[Any]] = MappingProxyType(
    {
        "check": Check,
        "build": Build,
        "relight": Relight,
        "simulate": Simulate,
        "scenario": ScenarioGroup,
        "actors": Actors,
        "assets": AssetsGroup,
        "view": View,
        "render": Render,
        "sky": SkyGroup,
        "export": Export,
        "batch": BatchGroup,
        "doctor": Doctor,
        "status": Status,
    }
)
# Commands of the laboratory package; listed here for the error message if it is not installed.
LABORATORY_COMMANDS = ("demo", "synthesize", "evaluate", "train")


def commands() -> dict[str, type[Any]]:
    """Return the class of every command by name: LightSim's commands, then registered ones.

    Raises:
        InputError: a registered command cannot be imported, or has the name of another command.
    """
    # Extensions may add commands but not replace those of LightSim.
    others = registered(COMMANDS)
    for name in others:
        if name in OWN_COMMANDS:
            raise InputError(
                f"an extension registers the command '{name}', which LightSim has",
                where=others[name].value,
                expected="another name",
                remedy="Uninstall the package, or rename its command.",
            )
    return {**OWN_COMMANDS, **{name: load_extension(COMMANDS, name) for name in others}}


def parse_command(words: Sequence[str]) -> Any:
    """Return the command of a command line with its options.

    Raises:
        InputError: an option is out of range, or the command belongs to a missing package.
    """
    known = commands()
    # Without this check the message would be that the command is unknown.
    if words and words[0] in LABORATORY_COMMANDS and words[0] not in known:
        raise InputError(
            f"the command '{words[0]}' belongs to the laboratory, which is not installed",
            where="lightsim",
            expected=f"one of {', '.join(known)}",
            remedy=f"pip install {LABORATORY}",
        )
    # tyro expects sub-commands as a union of annotated types.
    named = tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in known.items())
    return tyro.cli(
        Union[named],  # type: ignore[arg-type]  # noqa: UP007
        prog="lightsim",
        description=f"LightSim {__version__}, an open lighting simulator for driving logs.",
        args=words,
        # Without DisallowNone, help and errors offer the word None as the value of many options.
        config=(
            tyro.conf.FlagCreatePairsOff,
            tyro.conf.OmitArgPrefixes,
            tyro.conf.DisallowNone,
        ),
    )


def main(argv: Sequence[str] | None = None) -> None:
    """Run a command line and exit.

    Exit codes: 0 success, 1 error, 2 wrong usage, 130 interrupted.
    """
    words = sys.argv[1:] if argv is None else list(argv)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if words == ["--version"]:
        print_line(f"lightsim {__version__}")
        sys.exit(0)
    try:
        # Dataclasses of options check their ranges on construction, so this may raise InputError.
        command = parse_command(words)
        with _stopped_like_ctrl_c(), staged(words) as local_words:
            # Parsed before its URLs are downloaded, and again with paths.
            _run(command if local_words == words else parse_command(local_words))
    except KeyboardInterrupt:
        sys.exit(_print_interrupted())
    except Exception as error:
        if _is_interruption(error):
            sys.exit(_print_interrupted())
        # The words are inspected, since parsing may have failed.
        if {"-v", "--verbose"} & set(words):
            raise
        sys.exit(_print_error(error))


def _run(command: Any) -> None:
    """Run a command; with `--profile` print afterwards where its time went."""
    if not getattr(command, "profile", False):
        command.run()
        return
    with profiled() as profiler:
        command.run()
    print_line(profile_text(profiler.rows()))


@contextmanager
def _stopped_like_ctrl_c() -> Generator[None]:
    """Handle SIGTERM, which schedulers send to stop a job, like Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Python permits signal handlers in the main thread only.
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _print_interrupted() -> int:
    sys.stderr.write("lightsim: interrupted; run the same command again to continue\n")
    return 130


def _is_interruption(error: BaseException | None) -> bool:
    """Return True if an interruption is the cause: Dr.Jit wraps it in another exception."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__
    return error is not None


def _print_error(error: Exception) -> int:
    """Print an error in one line and return the exit code.

    Errors of LightSim are printed unchanged, system errors with their type, and unexpected
    errors with a request for a report.
    """
    kind = f"{type(error).__name__}: {error}"
    if isinstance(error, LightSimError):
        message = f"{error}"
    elif isinstance(error, OSError):
        message = f"{kind}. Use -v for the stack trace."
    elif isinstance(error, MemoryError):
        message = "out of memory. Use a smaller --image-scale or fewer --frames."
    else:
        message = f"this is a bug in LightSim: {kind}. Please report it with the stack trace of -v."
    # One line, so that logs of many runs can be searched.
    sys.stderr.write(f"lightsim: error: {shown(' '.join(message.split()))}\n")
    return 1
