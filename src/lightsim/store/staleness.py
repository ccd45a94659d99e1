"""Reasons why artefacts are stale: how their records differ from the keys they would have now."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import Any

from lightsim.store.artefact import ArtefactKey, json_ready

_SHOWN = 3
"""Files, settings or inputs that a reason names; the record holds all of them."""


def explain_staleness(record: Mapping[str, Any], artefact_key: ArtefactKey) -> tuple[str, ...]:
    """Return the reasons why an artefact is stale, as sentences without a full stop.

    Args:
        record: artefact.json of the artefact.
        artefact_key: the key that the artefact would have if it were made now.
    """
    reasons = []
    was = record.get("sources")
    if was is None:
        version = record.get("package_version", "an earlier version")
        reasons.append(f"made by LightSim {version}, which did not record its code")
    elif change := describe_source_change(was, artefact_key.sources):
        reasons.append(f"made by other code: {change}")
    settings = _differing(record["config"], json_ready(artefact_key.config))
    if settings:
        reasons.append(f"made with other settings: {_few(settings)}")
    inputs = [
        name for name, key in artefact_key.inputs.items() if record["inputs"].get(name) != key
    ]
    if inputs:
        reasons.append(f"its inputs have changed: {_few(inputs)}")
    if record.get("seed") != artefact_key.seed:
        reasons.append(f"made with seed {record.get('seed')} instead of {artefact_key.seed}")
    return tuple(reasons)


def describe_source_change(was: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return which source files differ, in words; empty where none does.

    Args:
        was: hashes by path at the time when the artefact was made.
        now: hashes by path of the installed code.
    """
    changes = [
        *(f"{path} changed" for path in now if path in was and was[path] != now[path]),
        *(f"{path} is new" for path in now if path not in was),
        *(f"{path} is gone" for path in was if path not in now),
    ]
    return _few(changes)


def _differing(was: Any, now: Any, name: str = "") -> list[str]:
    """Settings whose values differ, nested ones by their dotted names."""
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        return [
            difference
            for key in {**now, **was}
            for difference in _differing(
                was.get(key), now.get(key), f"{name}.{key}" if name else str(key)
            )
        ]
    if was == now:
        return []
    # The record may come from a stranger: reprlib bounds depth and length of what is shown.
    return [f"{name} = {reprlib.repr(was)}, now {reprlib.repr(now)}"]


def _few(words: list[str]) -> str:
    more = len(words) - _SHOWN
    return ", ".join(words[:_SHOWN]) + (f" and {more} more" if more > 0 else "")
