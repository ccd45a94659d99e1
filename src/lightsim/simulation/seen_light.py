"""How brightly a sky lights what a log's cameras see: what `--sky-scale auto` keeps."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from lightsim.build.workspace import Workspace
from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome
from lightsim.render.frame_renderer import FrameRenderer, TransportFrame
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.replay import replay

_MOMENTS = 4
_COLUMNS = 96
"""Of the small pictures that are traced: six cameras at four moments take some seconds."""
_DARK = 1e-3
"""Of the mean: what is darker, such as the inside of a hole, counts as if it were this bright."""


class SeenLight:
    """A few small pictures of all cameras, spread over the log and traced once for all skies.

    They do not depend on the frames and edits that are asked for, so that parts of a log which are
    relit apart are equally bright.
    """

    def __init__(self, workspace: Workspace, renderer: FrameRenderer | None = None) -> None:
        """
        Args:
            workspace: with the log and its twin.
            renderer: of the twin; None sets up one when it is first needed.
        """
        self._workspace = workspace
        self._given = renderer
        self._known: dict[SkyDome, float] = {}

    def mean_luminance(self, dome: SkyDome) -> float:
        """Geometric mean over all surfaces in the pictures of the luminance, in scene units, that
        a white Lambert surface in their place would show; 0 without any surface.

        The mean of logs is what photographs are exposed by (Reinhard et al. 2002,
        doi:10.1145/566654.566575).
        """
        if dome not in self._known:
            self._known[dome] = self._measured(dome)
        return self._known[dome]

    def _measured(self, dome: SkyDome) -> float:
        sky, traced = self.renderer.prepare(dome), self._traced
        shaded = [frame.light(sky).shaded[frame.geometry.has_surface] for frame in traced]
        light = luminance(np.concatenate([*shaded, np.zeros((0, 3), np.float32)]))
        mean = float(light.mean(dtype=np.float64)) if len(light) else 0.0
        if not mean > 0:
            return 0.0
        return float(np.exp(np.log(light + _DARK * mean, dtype=np.float64).mean()))

    @cached_property
    def renderer(self) -> FrameRenderer:
        """Renderer of the twin that diffuse light is traced with; other renderers of the twin share
        its static scene."""
        config = TransportConfig(glossy_rays=0)
        if self._given is not None:
            return self._given.with_tracing(config, 0)
        twin = self._workspace.twin
        return FrameRenderer(
            twin.assets.background, self._workspace.unobserved_occluders, config, 0
        )

    @cached_property
    def _traced(self) -> list[TransportFrame]:
        work = self._workspace
        widest = max(camera.width_px for camera in work.log.cameras.values())
        log = work.log_at(work.reading.image_scale * min(1.0, _COLUMNS / widest))
        stems = log.stems
        chosen = {stems[k] for k in np.linspace(0, len(stems) - 1, _MOMENTS).round().astype(int)}
        frames = [f for name in log.cameras for f in log.frames_of(name) if f.stem in chosen]
        scenario = replay(work.twin, "seen", frames)
        return [self.renderer.trace(scenario, f, log.cameras[f.camera_name]) for f in frames]
