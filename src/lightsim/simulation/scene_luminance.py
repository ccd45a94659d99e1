"""Mean luminance of the visible surfaces under a sky, which `--sky-scale auto` preserves."""

from __future__ import annotations

from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float32

from lightsim.build.workspace import Workspace
from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome
from lightsim.render.frame_renderer import FrameRenderer, TransportFrame
from lightsim.render.transport.matrix import TransportConfig
from lightsim.scenario.replay import replay

# Times, evenly over the log, at which pictures are traced.
_TIME_COUNT = 4
# Width of the traced pictures, in pixels: six cameras at four times take some seconds.
_WIDTH_PX = 96
# Luminance, as a fraction of the mean, that is added to every pixel before the logarithm, so that
# dark pixels, such as the inside of a hole, do not dominate the mean.
_DARK = 1e-3


class SceneLuminance:
    """Light of small pictures of all cameras at a few times of the log, traced once for all skies.

    The pictures do not depend on the selected frames and edits, so that parts of a log that are
    relit separately are equally bright.
    """

    def __init__(self, workspace: Workspace, renderer: FrameRenderer | None = None) -> None:
        """
        Args:
            workspace: with the log and its twin.
            renderer: of the twin; None sets up one when it is first needed.
        """
        self._workspace = workspace
        self._given = renderer
        # Weak references, so that a session with hundreds of skies does not store all of them.
        self._known: WeakKeyDictionary[SkyDome, float] = WeakKeyDictionary()

    def mean_luminance(self, dome: SkyDome) -> float:
        """Return the geometric mean luminance, in scene units, that all visible surfaces would have
        if they were white Lambert surfaces; 0 without any surface.

        Photographic display mapping uses this log-average luminance as exposure (Reinhard et al.
        2002, doi:10.1145/566654.566575).
        """
        if dome not in self._known:
            self._known[dome] = self._measured(dome)
        return self._known[dome]

    def _measured(self, dome: SkyDome) -> float:
        sky, traced = self.renderer.prepare(dome), self._traced
        shaded = [frame.light(sky).shaded[frame.geometry.has_surface] for frame in traced]
        # The empty array is for logs without visible surfaces.
        return log_average_luminance(np.concatenate([*shaded, np.zeros((0, 3), np.float32)]))

    @cached_property
    def renderer(self) -> FrameRenderer:
        """Renderer of diffuse light in the twin; further renderers reuse its static scene."""
        # Reflections do not contribute to diffuse light. The seed is fixed, so that the brightness
        # of a sky does not depend on the seed of the frames.
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
        log = work.log_at(work.reading.image_scale * min(1.0, _WIDTH_PX / widest))
        stems = log.stems
        chosen = {stems[k] for k in np.linspace(0, len(stems) - 1, _TIME_COUNT).round().astype(int)}
        frames = [f for name in log.cameras for f in log.frames_of(name) if f.stem in chosen]
        scenario = replay(work.twin, "sky-scale", frames)
        return [self.renderer.trace(scenario, f, log.cameras[f.camera_name]) for f in frames]


def log_average_luminance(light: Float32[np.ndarray, "n 3"]) -> float:
    """Return the geometric mean of the luminance of lights; 0 without light."""
    values = luminance(light)
    mean = float(values.mean(dtype=np.float64)) if len(values) else 0.0
    if not mean > 0:
        return 0.0
    return float(np.exp(np.log(values + _DARK * mean, dtype=np.float64).mean()))
