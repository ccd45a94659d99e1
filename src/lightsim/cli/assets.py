"""`lightsim assets`: library of assets that scenarios insert."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from lightsim.cli.options import CommandGroup, Verbose, WorkFolder, print_line
from lightsim.core.actors import ActorKind


@dataclass(frozen=True, kw_only=True)
class AssetsList:
    """Show the assets that scenarios can name."""

    library: Path | None = None
    """Folder of the library; by default ~/.local/share/lightsim/assets."""
    verbose: Verbose = False

    def run(self) -> None:
        """Print one line per asset."""
        from lightsim.simulation.edited import asset_library

        for info in asset_library(self.library).infos():
            size = " x ".join(f"{side:.2f}" for side in info.size_lwh_m)
            score = "" if info.score is None else f", {100 * info.score:.0f} % observed"
            print_line(
                f"{info.name:24} {info.kind:12} {size} m, {info.faces} faces, {info.origin}{score}"
            )


@dataclass(frozen=True, kw_only=True)
class AssetsAdd:
    """Add a CAD file to the library."""

    model: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="MODEL")]]
    """A .glb, .gltf or .obj file."""
    name: str = ""
    """Name of the asset in scenarios; by default the name of the file."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """Axis of the file that points up; auto: y, unless wheels or the base indicate another one."""
    front: Literal["auto", "+x", "-x", "+y", "-y", "+z", "-z"] = "auto"
    """Axis of the file that points ahead; auto: along the longer side, towards the lower end."""
    metres_per_unit: float = 1.0
    """Size of the file's unit: 0.01 for centimetres, 0.001 for millimetres, 0.0254 for inches."""
    length_m: float | None = None
    """Scale the model to this length along its front, whatever its unit."""
    kind: ActorKind | None = None
    """Kind of actor; by default the kind named by a whole word of the file's name, else estimated
    from the size."""
    library: Path | None = None
    """Folder of the library; by default ~/.local/share/lightsim/assets."""
    overwrite: bool = False
    """Replace an asset of this name."""
    verbose: Verbose = False

    def run(self) -> None:
        """Add the model to the library and print its size and axes."""
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
        print_line(
            f"{info.name}: {info.kind}, {size} m, {info.faces} faces, up {model.up}, front"
            f" {model.front} (options --kind, --up, --front, --length-m change them)"
        )


@dataclass(frozen=True, kw_only=True)
class AssetsHarvest:
    """Add reconstructed actors of a log to the library, the best observed ones first."""

    work: WorkFolder
    """Work folder of a finished build."""
    least_seen: float = 0.3
    """Smallest fraction of an actor's surface that sensors observed."""
    prefix: str = ""
    """Prefix of the assets' names; by default the name of the work folder."""
    library: Path | None = None
    """Folder of the library; by default ~/.local/share/lightsim/assets."""
    overwrite: bool = False
    """Replace assets of these names."""
    verbose: Verbose = False

    def run(self) -> None:
        """Add the actors to the library and print their observed fractions."""
        from lightsim.simulation.edited import asset_library
        from lightsim.simulation.harvest import harvest

        prefix = self.prefix or self.work.resolve().name
        library = asset_library(self.library)
        found = harvest(self.work, library, prefix, self.least_seen, is_replacing=self.overwrite)
        for info in found:
            print_line(f"{info.name}: {info.kind}, {100 * (info.score or 0):.0f} % observed")
        print_line(f"{len(found)} actors: {library.folder}")


Assets = (
    Annotated[AssetsList, tyro.conf.subcommand("list")]
    | Annotated[AssetsAdd, tyro.conf.subcommand("add")]
    | Annotated[AssetsHarvest, tyro.conf.subcommand("harvest")]
)


@dataclass(frozen=True)
class AssetsGroup(CommandGroup):
    """The asset library: list it, add CAD files, harvest actors of logs."""

    do: tyro.conf.OmitSubcommandPrefixes[tyro.conf.OmitArgPrefixes[Assets]]
