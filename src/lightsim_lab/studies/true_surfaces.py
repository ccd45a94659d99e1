"""True surfaces, classes and sunlight in the frames of a synthetic log, under any sky."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from lightsim.build.workspace import Workspace
from lightsim.core.buffers import BACKGROUND, GBuffers
from lightsim.core.colour import luminance
from lightsim.core.dome import SkyDome
from lightsim.render.frame_renderer import FrameRenderer, TransportFrame
from lightsim.render.transport.matrix import TransportConfig
from lightsim.render.transport.sun import unshadowed_sun
from lightsim_lab.metrics.base_colour import GROUND_ABOVE, LIT_ABOVE, SHADOW_BELOW
from lightsim_lab.metrics.shadows import TrueShadows
from lightsim_lab.synthetic.reader import read_true_meshes, true_scenario

_Frame = tuple[str, str]


@dataclass(frozen=True, eq=False)
class _TrueFrame:
    """True buffers of a frame; one byte per pixel limits the memory for full-size logs.

    Args:
        visibility_by_sky: sun visibility times 255; skies without a sun are omitted.
        rest_by_sky: light in full shadow over light in full sun, times 255.
    """

    is_surface: Bool[np.ndarray, "h w"]
    is_ground: Bool[np.ndarray, "h w"]
    is_vehicle: Bool[np.ndarray, "h w"]
    visibility_by_sky: Mapping[str, UInt8[np.ndarray, "h w"]]
    rest_by_sky: Mapping[str, UInt8[np.ndarray, "h w"]]


class TrueSurfaces:
    """True geometry of a synthetic log at pixel centres, and the light on it."""

    def __init__(
        self,
        path: Path,
        workspace: Workspace,
        skies: Mapping[str, SkyDome] = MappingProxyType({}),
    ) -> None:
        """
        Args:
            path: scene.npz of the log's truth.
            skies: all skies that will be requested; each frame is traced once for all of them.
        """
        self.meshes = read_true_meshes(path)
        self._log = workspace.log_at(1.0)
        self._skies = {name: sky for name, sky in skies.items() if sky.sun is not None}
        background = self.meshes["background"]
        self.scenario = true_scenario(self.meshes, self._log.actors)
        # The true scene is complete: there are no unobserved occluders.
        empty = replace(background, faces=background.faces[:0])
        self._renderer = FrameRenderer(background, empty, TransportConfig(), 0)
        self._known: dict[_Frame, _TrueFrame] = {}

    def is_surface(self, camera_name: str, stem: str) -> Bool[np.ndarray, "h w"]:
        """Return the mask of pixels that show a surface."""
        return self._frame(camera_name, stem).is_surface

    def classes(self, sky: str, camera_name: str, stem: str) -> dict[str, Bool[np.ndarray, "h w"]]:
        """Return masks of sky, ground, vehicles and other surfaces; with a sun, also of lit and
        shadowed surfaces. Surfaces turned away from the sun are shadowed."""
        true = self._frame(camera_name, stem)
        found = {
            "sky": ~true.is_surface,
            "ground": true.is_ground,
            "building, other": true.is_surface & ~true.is_ground & ~true.is_vehicle,
            "vehicle": true.is_vehicle,
        }
        if sky in true.visibility_by_sky:
            visibility = true.visibility_by_sky[sky]
            found["lit"] = true.is_surface & (visibility > 255 * LIT_ABOVE)
            found["shadowed"] = true.is_surface & (visibility < 255 * SHADOW_BELOW)
        return found

    def shadows(self, sky: str, camera_name: str, stem: str) -> TrueShadows | None:
        """Return the true shadows of a sky's sun; None for a sky without sun."""
        true = self._frame(camera_name, stem)
        if sky not in true.visibility_by_sky:
            return None
        visibility = true.visibility_by_sky[sky]
        is_shadowed = visibility < 255 * SHADOW_BELOW
        return TrueShadows(
            is_shadowed,
            true.is_surface & (is_shadowed | (visibility > 255 * LIT_ABOVE)),
            true.rest_by_sky[sky].astype(np.float32) / np.float32(255),
        )

    def _frame(self, camera_name: str, stem: str) -> _TrueFrame:
        if (camera_name, stem) not in self._known:
            frame = next(f for f in self._log.frames_of(camera_name) if f.stem == stem)
            camera = self._log.cameras[camera_name]
            traced = self._renderer.trace(self.scenario, frame, camera)
            self._known[camera_name, stem] = self._true_frame(traced)
        return self._known[camera_name, stem]

    def _true_frame(self, traced: TransportFrame) -> _TrueFrame:
        buffers = traced.geometry
        vehicles = [n for n, track in enumerate(self.scenario.tracks) if track.kind.is_vehicle]
        is_ground = buffers.actor_index == BACKGROUND
        is_ground &= buffers.normal_world[..., 2] > GROUND_ABOVE
        visibility, rest = {}, {}
        for name, sky in self._skies.items():
            visibility[name], rest[name] = (_byte(x) for x in _sunlight(traced, buffers, sky))
        is_vehicle = np.isin(buffers.actor_index, vehicles)
        return _TrueFrame(buffers.has_surface, is_ground, is_vehicle, visibility, rest)


def _sunlight(
    traced: TransportFrame, buffers: GBuffers, sky: SkyDome
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return sun visibility, and light without sun over light with unoccluded sun."""
    assert sky.sun is not None
    light = traced.light(sky)
    normals = buffers.normal_world.reshape(-1, 3)
    full = luminance(unshadowed_sun(normals, sky.sun)).reshape(buffers.depth_z_m.shape)
    rest = luminance(light.sky + light.bounce)
    # The guard avoids 0 / 0 on black pixels.
    fraction = rest / np.maximum(rest + full, np.float32(1e-6))
    return light.sun_visibility, np.where(buffers.has_surface, fraction, 1.0).astype(np.float32)


def _byte(values: Float32[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    return np.round(255 * np.clip(values, 0.0, 1.0)).astype(np.uint8)
