"""Final pictures of the viewer: equal to those of `lightsim relight` and `lightsim simulate`."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from lightsim.app.recent_results import RecentResults
from lightsim.build.workspace import Workspace
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.core.sky_choice import SkyChoice
from lightsim.relighting.physical.compose import camera_image
from lightsim.simulation.options import RelightOptions
from lightsim.simulation.relighter import PreparedFrame, RelightConfig, Relighter, RelightTarget
from lightsim.simulation.scene_luminance import SceneLuminance
from lightsim.simulation.skies import resolve_sky

# Number of frames whose traced rays and network inputs are cached: some 90 MB each at 480 x 270,
# 250 MB at 960 x 540.
_CACHED_FRAMES = 4
# Number of prepared skies that are cached: some 5 MB each.
_CACHED_SKIES = 8
# Largest exposure time for which `lightsim simulate` blurs actors by default, in seconds.
_EXPOSURE_S = 1e-3


@dataclass(frozen=True, eq=False)
class FinalPicture:
    """A frame under a target sky, as the commands make it.

    Args:
        recorded: picture under the source sky, with the edits.
        relit: picture under the target sky.
        expected_error: expected absolute error of the relit sRGB code, in [0, 1]; None without an
            estimate.
        depth_z_m: depth along the optical axis, infinite in the sky; None if nothing was traced.
    """

    recorded: UInt8[np.ndarray, "h w 3"]
    relit: UInt8[np.ndarray, "h w 3"]
    expected_error: Float32[np.ndarray, "h w"] | None
    depth_z_m: Float32[np.ndarray, "h w"] | None


def edits_key(edits: Sequence[Mapping[str, Any]]) -> str:
    """Return a text that is equal for equal edits."""
    return json.dumps([dict(edit) for edit in edits], sort_keys=True)


class Pictures:
    """Makes pictures of single frames of a work folder, and caches traced frames and skies.

    Methods may be called from several threads.

    Args:
        workspace: with the twin.
        recorded: the log without edits, all frames.
        method: relighting method, as --method of `lightsim relight`.
    """

    def __init__(self, workspace: Workspace, recorded: Scenario, method: str = "network") -> None:
        self.workspace = workspace
        self.recorded = recorded
        self.log = workspace.log
        options = RelightOptions(name="view", sky=("source",), method=method)
        self.config = config = RelightConfig(exposure_s=_EXPOSURE_S)
        self._seen = SceneLuminance(workspace)
        self._relighter = Relighter(
            workspace, self.log, config, options, recorded, renderer=self._seen.renderer
        )
        self._frames = RecentResults[PreparedFrame](_CACHED_FRAMES)
        self._skies = RecentResults[RelightTarget](_CACHED_SKIES)
        # Tracing adds rows to the renderer's table of faces, which all frames use.
        self.tracing = threading.Lock()

    @property
    def relighter(self) -> Relighter:
        """The relighter of all pictures."""
        return self._relighter

    def gain(self, camera: str) -> Float32[np.ndarray, "3"]:
        """Return the gain of a camera: linear picture over radiance."""
        return self.workspace.twin.assets.camera_gains[camera]

    def target(self, sky: SkyChoice) -> RelightTarget:
        """Return a prepared sky.

        Raises:
            InputError: as `simulation.skies.resolve_sky`.
        """

        def make() -> RelightTarget:
            # The first call traces small pictures of the log, to scale the sky.
            with self.tracing:
                return self._relighter.target(resolve_sky(sky, self.workspace, self._seen))

        return self._skies.get(sky, make)

    def prepare_frame(
        self, frame: ScenarioFrame, scenario: Scenario, *, is_traced: bool = True
    ) -> PreparedFrame:
        """Return a frame of a scenario, with its rays if `is_traced`."""
        key = (frame.camera_name, frame.stem, edits_key(scenario.edits))

        def make() -> PreparedFrame:
            with self.tracing:
                ready = self._relighter.prepare_frame(frame, scenario, is_traced=is_traced)
                if ready.traced is not None:
                    # Rays are cast at the first use; here no other thread casts any.
                    _ = ready.traced.buffers
                return ready

        found = self._frames.get(key, make)
        if is_traced and found.traced is None:
            self._frames.drop(key)
            return self._frames.get(key, make)
        return found

    def final(
        self, frame: ScenarioFrame, scenario: Scenario, sky: SkyChoice, exposure_ev: float
    ) -> FinalPicture:
        """Return the picture of a frame, equal to that of the commands byte for byte."""
        target = self.target(sky)
        ready = self.prepare_frame(frame, scenario, is_traced=not target.sky.is_source)
        result = self._relighter.relit_under(ready, target)
        image, gain = result.image_srgb8, self.gain(frame.camera_name)
        if exposure_ev:
            # Equal to --exposure-ev of the commands, with the exposure of this session.
            image = camera_image(result.radiance, gain, exposure_ev)
        depth = None if ready.traced is None else ready.traced.geometry.depth_z_m
        return FinalPicture(ready.source.srgb8, image, result.expected_error, depth)
