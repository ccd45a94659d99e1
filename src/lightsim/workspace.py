"""A work folder: one sub-folder per artefact, loaded when asked for and kept."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from lightsim.core.alignment import Alignment
from lightsim.core.fields import SceneFields
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import DigitalTwin, Panorama, SceneAssets, SkyEstimate
from lightsim.errors import ArtefactError
from lightsim.store.alignment import read_alignment
from lightsim.store.artefact import read_json, read_record
from lightsim.store.assets import read_assets, read_mesh
from lightsim.store.fields import read_fields
from lightsim.store.images import read_grey8
from lightsim.store.log import LogReading, held_out_stems, read_reading
from lightsim.store.sky import read_estimate, read_panorama
from lightsim.store.twin import read_twin_assets

if TYPE_CHECKING:
    from lightsim.reconstruct.sdf_field import SceneField

FIELD_NAME = "field.safetensors"
FIELD_CONFIG_NAME = "field.json"


class Workspace:
    """The artefacts of one log under `root` (INTERFACE: WORK)."""

    def __init__(self, root: Path, reading: LogReading | None = None) -> None:
        self.root = root
        self._reading = reading

    def folder(self, stage: str) -> Path:
        return self.root / stage

    def need(self, stage: str) -> Path:
        """Folder of a finished artefact.

        Raises:
            ArtefactError: it has not been made.
        """
        folder = self.folder(stage)
        if read_record(folder) is None:
            raise ArtefactError(
                f"the '{stage}' artefact has not been made",
                where=self.root,
                remedy=f"Run: lightsim build SOURCE --work {self.root}",
            )
        return folder

    @cached_property
    def reading(self) -> LogReading:
        return self._reading or read_reading(self.need("log"))

    @cached_property
    def log(self) -> DrivingLog:
        """All frames at the scale of the build; sensors, path and boxes aligned."""
        return self.alignment.applied_to(self.recorded_log)

    @cached_property
    def recorded_log(self) -> DrivingLog:
        """The same as recorded."""
        return self._recorded_at(self.reading.image_scale)

    @cached_property
    def alignment(self) -> Alignment:
        return read_alignment(self.need("alignment"))

    @cached_property
    def _full_log(self) -> DrivingLog:
        from lightsim.ingest.reader import read_log

        reading = self.reading
        return read_log(
            Path(reading.source),
            dataset=reading.dataset,
            cameras=reading.cameras,
            frames=reading.frames,
            heading_deg=reading.heading_deg,
        )

    def log_at(self, image_scale: float) -> DrivingLog:
        """The aligned log at another image scale."""
        return self.alignment.applied_to(self._recorded_at(image_scale))

    def _recorded_at(self, image_scale: float) -> DrivingLog:
        from lightsim.ingest.scale import at_scale

        return at_scale(self._full_log, image_scale)

    @cached_property
    def held_out(self) -> frozenset[str]:
        return held_out_stems(self._full_log, self.reading.hold_out)

    @cached_property
    def training_log(self) -> DrivingLog:
        """The log without held-out frames and sweeps: all that building may look at."""
        return self._without_held_out(self.log)

    @cached_property
    def recorded_training_log(self) -> DrivingLog:
        """The same as recorded: what is aligned."""
        return self._without_held_out(self.recorded_log)

    def _without_held_out(self, log: DrivingLog) -> DrivingLog:
        out = self.held_out
        return replace(
            log,
            frames=tuple(f for f in log.frames if f.stem not in out),
            sweeps=tuple(s for s in log.sweeps if s.stem not in out),
        )

    def sky_matte(self, frame: CameraFrame) -> Float32[np.ndarray, "h w"]:
        """Sky alpha of a frame at the build's image scale, 1 = sky."""
        path = self.need("masks") / frame.camera_name / f"{frame.stem}.png"
        return read_grey8(path).astype(np.float32) / 255.0

    @cached_property
    def fused(self) -> SceneFields:
        """The fused LiDAR."""
        return read_fields(self.need("fields"))

    @cached_property
    def fields(self) -> SceneFields:
        """The geometry that is meshed: the fused LiDAR as the neural field has refined it."""
        return read_fields(self.need("neural"))

    @cached_property
    def scene_field(self) -> SceneField:
        """The trained neural field.

        Raises:
            ArtefactError: the build trained none.
        """
        from lightsim.reconstruct.neural import make_field
        from lightsim.reconstruct.neural_config import config_from_json
        from lightsim.store.checkpoint import read_weights

        folder = self.need("neural")
        config = config_from_json(read_json(folder / FIELD_CONFIG_NAME))
        field = make_field(self.training_log, self.fused, config, 0)
        field.load_state_dict(read_weights(folder / FIELD_NAME))
        return field

    @cached_property
    def meshes(self) -> SceneAssets:
        """The same without colour."""
        return read_assets(self.need("geometry"))

    @cached_property
    def assets(self) -> SceneAssets:
        """Meshes whose colour is the observed radiance under the source sky."""
        return read_assets(self.need("assets"))

    @cached_property
    def inferred(self) -> TriMesh:
        """Roofs and rear walls that no sensor measured but that cast shadows."""
        return read_mesh(self.need("assets") / "inferred.npz", "world")

    @cached_property
    def panorama(self) -> Panorama:
        return read_panorama(self.need("panorama"))

    @cached_property
    def sky(self) -> SkyEstimate:
        return read_estimate(self.need("sky"))

    @cached_property
    def _twin_assets(self) -> tuple[SceneAssets, TriMesh]:
        return read_twin_assets(self.need("twin"))

    @property
    def shadow_casters(self) -> TriMesh:
        """The inferred casters with their base colour."""
        return self._twin_assets[1]

    @cached_property
    def twin(self) -> DigitalTwin:
        return DigitalTwin(self.log, self._twin_assets[0], self.sky)
