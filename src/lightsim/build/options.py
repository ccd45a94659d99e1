"""Options of a build."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from lightsim.align.config import AlignConfig
from lightsim.appearance.config import Colour
from lightsim.core.checks import check_choice, check_number, check_seed
from lightsim.core.option_types import Names
from lightsim.core.reading import LogReading
from lightsim.errors import InputError

Preset = Literal["draft", "standard", "paper"]
PRESETS: tuple[Preset, ...] = get_args(Preset)
GpsUse = Literal["all", "place", "none"]
"""GPS data for the sun's direction: place, time and heading; place and time; or none."""
SkyModel = Literal["analytic", "paper"]
"""Source sky: a physical model fitted to all evidence, or the output of the sky network's
decoder."""
Device = Literal["auto", "cpu", "cuda"]
# Largest number of training steps, 500 times those of the preset paper: more is a typing error.
_MAX_STEPS = 10_000_000


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """Options of a build."""

    reading: LogReading
    """Options of reading the recording."""
    preset: Preset = "standard"
    """Quality of the reconstruction. draft: fast; standard: best; paper: the published system
    alone, for comparison (docs/paper-map.md)."""
    colour: Colour | None = None
    """Colour of the meshes: at image resolution, at vertices, or the neural field's colour at
    vertices (as in the paper); by default that of the preset."""
    no_refine: Names = ()
    """Comma-separated corrections to leave out: rolling_shutter, point_times, ego_vehicle_masks,
    lidar_poses, actor_tracks, camera_poses, camera_gains."""
    no_complete: Names = ()
    """Comma-separated steps of the completion of the geometry to leave out, to measure their worth:
    flat_walls, kerbs, crowns, webs, poles, leaves, crown_tops, far_walls, pitched_roofs,
    roofs, panes, ledges, far_field."""
    gps: GpsUse = "all"
    """GPS data for the sun's direction, besides the images. all: place, time and heading; place:
    place and time; none."""
    sky_model: SkyModel | None = None
    """Model of the source sky. analytic: a physical sky fitted to images and shadows; paper: the
    sky network's decoder, from its latent, its peak and the GPS sun; by default that of the
    preset."""
    sky_weights: Path | None = None
    """Weights of the sky network, in LightSim's form or in the published one, as lightsim train sky
    writes them; by default those of the package."""
    inpaint_weights: Path | None = None
    """Weights of the panorama completion, as lightsim train inpaint writes them; by default those
    of the package."""
    field_cameras: Names = ()
    """Comma-separated cameras from which the neural field learns; empty for all. The panorama keeps
    all cameras."""
    device: Device = "auto"
    """Device on which the neural field is trained; auto uses CUDA if present."""
    neural_steps: int | None = None
    """Training steps of the neural field; by default those of the preset; 0 uses the fused LiDAR as
    it is."""
    seed: int = 0
    """Seed of all random numbers."""

    def __post_init__(self) -> None:
        check_choice("--preset", self.preset, PRESETS)
        check_choice("--colour", self.colour, (None, *get_args(Colour)))
        check_choice("--gps", self.gps, get_args(GpsUse))
        check_choice("--sky-model", self.sky_model, (None, *get_args(SkyModel)))
        check_choice("--device", self.device, get_args(Device))
        # Raises for a correction that does not exist; the result is not needed here.
        AlignConfig().without(self.no_refine)
        check_seed(self.seed)
        if self.neural_steps is not None:
            check_number("--neural-steps", self.neural_steps, 0, _MAX_STEPS)
        if self.preset == "paper":
            self._check_paper()

    def _check_paper(self) -> None:
        """Reject options that the published system does not have."""
        is_set = {
            "--colour": self.colour not in (None, "field"),
            "--sky-model": self.sky_model not in (None, "paper"),
            "--neural-steps": self.neural_steps == 0,
        }
        wrong = [name for name, is_given in is_set.items() if is_given]
        if wrong:
            raise InputError(
                "the preset 'paper' requires other options",
                where=", ".join(wrong),
                expected="--colour field, --sky-model paper, --neural-steps 1 or more",
                remedy="Leave the option out, or choose --preset standard.",
            )
