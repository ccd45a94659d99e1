"""What a build is made from, as a user gives it."""

from __future__ import annotations

from dataclasses import dataclass
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
"""Place, time and heading; place and time alone; or the images alone."""
SkyModel = Literal["analytic", "paper"]
"""The source sky as one light found from all evidence, or as the sky network's decoder draws it."""
Device = Literal["auto", "cpu", "cuda"]
_MAX_STEPS = 10_000_000
"""Weeks of training; beyond it somebody has slipped a digit."""


@dataclass(frozen=True, kw_only=True)
class BuildOptions:
    """What a build is made from."""

    reading: LogReading
    """How the recording is read."""
    preset: Preset = "standard"
    """Quality of the reconstruction; paper: the published system and nothing of ours, to compare
    with (docs/paper-map.md)."""
    colour: Colour | None = None
    """Colour of the meshes: at image resolution, at vertices, or (the paper's) the neural field's
    at vertices; by default the preset's."""
    no_refine: Names = ()
    """Comma-separated physics of the log to leave out: rolling_shutter, point_times,
    ego_vehicle_masks, lidar_poses, actor_tracks, camera_poses, camera_gains."""
    gps: GpsUse = "all"
    """What the sun is found with besides the images: place, time and heading; place and time; or
    nothing."""
    sky_model: SkyModel | None = None
    """How the source sky is made: a physical sky fitted to what was seen with the sun by shadows,
    or (the paper's) by the decoder of the sky network, from its latent and peak and the GPS sun; by
    default the preset's."""
    device: Device = "auto"
    """Where the neural field is trained; auto takes CUDA where there is one. Results on the CPU do
    not depend on it."""
    neural_steps: int | None = None
    """Training steps of the neural field; by default the preset's; 0 keeps the fused LiDAR."""
    seed: int = 0
    """Of all random numbers."""

    def __post_init__(self) -> None:
        check_choice("--preset", self.preset, PRESETS)
        check_choice("--colour", self.colour, (None, *get_args(Colour)))
        check_choice("--gps", self.gps, get_args(GpsUse))
        check_choice("--sky-model", self.sky_model, (None, *get_args(SkyModel)))
        check_choice("--device", self.device, get_args(Device))
        AlignConfig().without(self.no_refine)
        check_seed(self.seed)
        if self.neural_steps is not None:
            check_number("--neural-steps", self.neural_steps, 0, _MAX_STEPS)
        if self.preset == "paper":
            self._check_paper()

    def _check_paper(self) -> None:
        """The paper's system is one switch: nothing of ours goes into it."""
        ours = {
            "--colour": self.colour not in (None, "field"),
            "--sky-model": self.sky_model not in (None, "paper"),
            "--neural-steps": self.neural_steps == 0,
        }
        wrong = [name for name, is_ours in ours.items() if is_ours]
        if wrong:
            raise InputError(
                "the preset paper is the published system, which knows no such part",
                where=", ".join(wrong),
                expected="--colour field, --sky-model paper, --neural-steps 1 or more",
                remedy="Leave the option out, or choose --preset standard.",
            )
