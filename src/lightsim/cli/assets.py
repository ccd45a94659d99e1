"""`lightsim assets`: what can be inserted into a street."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from lightsim.cli.options import Verbose, say
from lightsim.core.actors import ActorKind


@dataclass(frozen=True, kw_only=True)
class AssetsList:
    """Show the assets that scenarios can name."""

    library: Path | None = None
    """Folder of the library; by default the user's own."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """A line an asset."""
        from lightsim.simulation.edited import asset_library

        for info in asset_library(self.library).infos():
            size = " x ".join(f"{side:.2f}" for side in info.size_lwh_m)
            score = "" if info.score is None else f", seen {100 * info.score:.0f} %"
            say(f"{info.name:24} {info.kind:12} {size} m, {info.faces} faces, {info.origin}{score}")


@dataclass(frozen=True, kw_only=True)
class AssetsAdd:
    """Take a CAD file into the library."""

    model: tyro.conf.Positional[Path]
    """A .glb, .gltf or .obj file."""
    name: str = ""
    """By which scenarios name it; by default the file's."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """Axis of the file that points up; auto: y, unless wheels or the base indicate another one."""
    front: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = "auto"
    """Axis of the file that points ahead; auto: along the longer side, towards the lower end."""
    metres_per_unit: float = 1.0
    """Size of the file's unit: 0.01 for centimetres, 0.001 for millimetres, 0.0254 for inches."""
    length_m: float | None = None
    """Scale the model to this length along its front, whatever its unit."""
    kind: ActorKind | None = None
    """Kind of actor; by default the kind that a whole word of the file's name is, else by size."""
    library: Path | None = None
    """Folder of the library; by default the user's own."""
    overwrite: bool = False
    """Replace an asset of this name."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Store the model."""
        from lightsim.scenario.asset_library import add_model
        from lightsim.scenario.models import ModelSettings
        from lightsim.simulation.edited import asset_library

        info, model = add_model(
            asset_library(self.library),
            self.model,
            self.name,
            ModelSettings(
                up=self.up,
                front=self.front,
                metres_per_unit=self.metres_per_unit,
                length_m=self.length_m,
            ),
            kind=self.kind,
            is_replacing=self.overwrite,
        )
        size = " x ".join(f"{side:.2f}" for side in info.size_lwh_m)
        say(
            f"{info.name}: {info.kind}, {size} m, {info.faces} faces, up {model.up}, front"
            f" {model.front} (options --kind, --up, --front, --length-m change them)"
        )


@dataclass(frozen=True, kw_only=True)
class AssetsHarvest:
    """Take reconstructed actors of a log into the library, the best seen ones first."""

    work: tyro.conf.Positional[Path]
    """Work folder of a finished build."""
    least_seen: float = 0.3
    """Fraction of an actor's surface that sensors must have seen."""
    prefix: str = ""
    """Of the names; by default the name of the work folder."""
    library: Path | None = None
    """Folder of the library; by default the user's own."""
    overwrite: bool = False
    """Replace assets of these names."""
    verbose: Verbose = False
    """Show the trace of an error."""

    def run(self) -> None:
        """Store the actors."""
        from lightsim.simulation.edited import asset_library
        from lightsim.simulation.harvest import harvest

        prefix = self.prefix or self.work.resolve().name
        library = asset_library(self.library)
        found = harvest(self.work, library, prefix, self.least_seen, is_replacing=self.overwrite)
        for info in found:
            say(f"{info.name}: {info.kind}, seen {100 * (info.score or 0):.0f} %")
        say(f"{len(found)} actors: {library.folder}")


Assets = (
    Annotated[AssetsList, tyro.conf.subcommand("list")]
    | Annotated[AssetsAdd, tyro.conf.subcommand("add")]
    | Annotated[AssetsHarvest, tyro.conf.subcommand("harvest")]
)


@dataclass(frozen=True)
class AssetsGroup:
    """The asset library: list it, add CAD files, harvest actors of logs."""

    do: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Assets]]

    def run(self) -> None:
        """Run the chosen command."""
        self.do.run()
