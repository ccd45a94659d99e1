"""Choice of the renderer of a street's pictures; each renderer has a different camera model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lightsim.core.mitsuba_variants import TracingDevice, variant_on
from lightsim.errors import InputError
from lightsim.render.reference.blender import Blender
from lightsim_lab.synthetic.cycles_tracer import CyclesTracer
from lightsim_lab.synthetic.plan import RendererName
from lightsim_lab.synthetic.sensor import DEFAULT_SENSOR, CameraSensor
from lightsim_lab.synthetic.shapes import Part
from lightsim_lab.synthetic.skies import Sky, environment
from lightsim_lab.synthetic.textures import Finish
from lightsim_lab.synthetic.tracer import PathTracer
from lightsim_lab.synthetic.tracing import Placed, StreetTracer

# Longer exposure, compressed highlights and twice the noise of the default camera (3.7 % at mid
# grey): typical differences between manufacturers, chosen before any method was evaluated on it.
_CYCLES_SENSOR = CameraSensor(exposure_ev=0.4, knee=0.5, photon_noise=2e-4, read_noise=3e-3)


@dataclass(frozen=True)
class StreetRenderer:
    """Renderer of the pictures of log and truth.

    Args:
        device: of Mitsuba; the noise differs between CPU and CUDA.
        blender_python: interpreter that has bpy, for Cycles (`blender.Blender`).

    Raises:
        InputError: Cycles is requested on CUDA.
    """

    name: RendererName = "mitsuba"
    device: TracingDevice = "cpu"
    blender_python: Path | None = None

    def __post_init__(self) -> None:
        if self.name == "cycles" and self.device != "cpu":
            raise InputError(
                "--renderer cycles renders on the CPU only",
                got=f"--device {self.device}",
                remedy="Leave --device out, or use --renderer mitsuba.",
            )

    @property
    def sensor(self) -> CameraSensor:
        """The camera of the streets of this renderer."""
        return _CYCLES_SENSOR if self.name == "cycles" else DEFAULT_SENSOR

    @property
    def words(self) -> str:
        """Options of the command line, with a leading space."""
        cycles = " --renderer cycles" if self.name == "cycles" else ""
        return cycles + (" --device cuda" if self.device == "cuda" else "")

    def record(self) -> dict[str, Any]:
        """Return the entries of truth.json; none for Mitsuba, whose truths are older.

        Starts Blender, which also verifies that it works before any file is written.

        Raises:
            MissingDependencyError: the interpreter for Blender has no bpy.
        """
        if self.name == "mitsuba":
            return {}
        blender = Blender(self.blender_python)
        blender.close()
        facts = {"name": self.name, "version": blender.version}
        return {"renderer": facts, "sensor": asdict(self.sensor)}

    def tracer(
        self,
        background: Sequence[Part],
        actors: Sequence[Placed],
        finishes: Mapping[str, Finish],
        sky: Sky,
        environment_height_px: int,
    ) -> StreetTracer:
        """Return the path tracer of a street under a sky.

        Args:
            background: static parts, frame `world`.
            actors: parts of each actor, in its own frame.
            environment_height_px: rows of Mitsuba's sky; Cycles takes it as it is.

        Raises:
            MissingDependencyError: the interpreter for Blender has no bpy.
        """
        if self.name == "cycles":
            python = self.blender_python
            return CyclesTracer(background, actors, finishes, sky.smooth, sky.sun, python)
        light = environment(sky, environment_height_px)
        return PathTracer(background, actors, finishes, light, sky.sun, variant_on(self.device))
