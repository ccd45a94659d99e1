"""Explanation of stale artefacts: differences between their records and their present keys."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import Any

from lightsim.store.artefact import ArtefactKey, few, json_ready


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
        reasons.append(f"made with other settings: {few(settings, ', ')}")
    inputs = [
        name for name, key in artefact_key.inputs.items() if record["inputs"].get(name) != key
    ]
    if inputs:
        reasons.append(f"its inputs have changed: {few(inputs, ', ')}")
    if record.get("seed") != artefact_key.seed:
        reasons.append(f"made with seed {record.get('seed')} instead of {artefact_key.seed}")
    return tuple(reasons)


def describe_source_change(was: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Return a list of the source files that differ, as text; empty if there are none.

    Args:
        was: hashes by path at the time when the artefact was made.
        now: hashes by path of the installed code.
    """
    changes = [
        *(f"{path} changed" for path in now if path in was and was[path] != now[path]),
        *(f"{path} is new" for path in now if path not in was),
        *(f"{path} is gone" for path in was if path not in now),
    ]
    return few(changes)


def _differing(was: Any, now: Any, name: str = "") -> list[str]:
    """Return the settings whose values differ, nested ones with dotted names."""
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
    # The record may come from an untrusted source: reprlib bounds depth and length of the text.
    return [f"{name} = {reprlib.repr(was)}, now {reprlib.repr(now)}"]
