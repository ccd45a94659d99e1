"""Extension points: names that other installed packages register through Python entry points.

Three groups exist: `lightsim.readers` (data sets), `lightsim.methods` (relighting methods) and
`lightsim.commands` (subcommands). Reference: packaging.python.org, "Entry points specification".
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from lightsim.errors import InputError

READERS, METHODS, COMMANDS = "lightsim.readers", "lightsim.methods", "lightsim.commands"
LABORATORY = "lightsim-lab"
"""Name of the package with training, evaluation, synthetic streets and the compared methods."""


@cache
def registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name; nothing is imported.

    Raises:
        InputError: two installed packages register one name.
    """
    found: dict[str, EntryPoint] = {}
    for entry in sorted(entry_points(group=group), key=lambda one: (one.name, one.value)):
        # An editable installation beside a wheel lists the same object twice.
        if found.setdefault(entry.name, entry).value != entry.value:
            raise InputError(
                f"two packages register '{entry.name}'",
                where=f"entry points of {group}",
                got=f"{found[entry.name].value} and {entry.value}",
                expected="one of them",
                remedy="Uninstall one of the packages.",
            )
    return found


def load_extension(group: str, name: str) -> Any:
    """Import and return the object that is registered under a name.

    Raises:
        InputError: the object cannot be imported.
    """
    entry = registered(group)[name]
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"the extension '{name}' cannot be imported",
            where=f"{entry.value} ({group})",
            got=f"{error}"[:200],
            remedy="Reinstall the package that registers it.",
        ) from error
