"""Assets that ship with LightSim: .glb files in data/assets, listed in assets.json.

`tools/shipped_models` generates them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

from lightsim.core.actors import ActorKind
from lightsim.core.twin import ActorAsset
from lightsim.scenario.wheels import with_wheels
from lightsim.store.entries import Entries
from lightsim.store.meshes import read_glb

# Package data: models and assets.json.
ASSETS_FOLDER = Path(__file__).parents[1] / "data" / "assets"


def shipped_assets() -> Mapping[str, ActorAsset]:
    """Return the shipped assets by name; each file is read when its asset is first used.

    Meshes are in frame `actor`: x forward, origin at the centre of the box.
    """
    return _Shipped()


class _Shipped(Mapping[str, ActorAsset]):
    def __getitem__(self, name: str) -> ActorAsset:
        return _read(name)

    def __contains__(self, name: object) -> bool:
        return name in _kinds()

    def __iter__(self) -> Iterator[str]:
        return iter(_kinds())

    def __len__(self) -> int:
        return len(_kinds())


@cache
def _kinds() -> Mapping[str, ActorKind]:
    entries = Entries.of_file(ASSETS_FOLDER / "assets.json")
    return {name: entries.member(name, ActorKind) for name in entries}


@cache
def _read(name: str) -> ActorAsset:
    kind = _kinds()[name]
    return with_wheels(ActorAsset(name, kind, read_glb(ASSETS_FOLDER / f"{name}.glb", "actor")))
