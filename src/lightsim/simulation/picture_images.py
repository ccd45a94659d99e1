"""Radiance of frames from the log's pictures: `image` of `lightsim render`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from lightsim.build.workspace import Workspace
from lightsim.core.log import DrivingLog
from lightsim.core.scenario import Scenario, ScenarioFrame
from lightsim.render.frame_renderer import FrameRenderer
from lightsim.render.renderers import transport_as_chosen
from lightsim.simulation.options import RelightOptions, RenderOptions
from lightsim.simulation.relight_methods import weights_hash
from lightsim.simulation.relighter import RelightConfig, Relighter
from lightsim.simulation.target_sky import TargetSky
from lightsim.store.artefact import json_ready


def shown_by_pictures(scenario: Scenario, held_out: frozenset[str]) -> Scenario:
    """Return a replayed log whose frames are the recorded pictures, except held-out frames, which
    are rendered from the other pictures."""
    frames = tuple(
        frame if frame.stem in held_out else replace(frame, source="recorded")
        for frame in scenario.frames
    )
    return replace(scenario, frames=frames)


def picture_settings(workspace: Workspace, options: RenderOptions) -> dict[str, Any]:
    """Return the settings that determine `image` besides those of all buffers: method, weights and
    configuration of relighting.

    Raises:
        InputError: the package's list of weights is damaged.
    """
    relight_options, config = _relighting(options)
    weights = weights_hash(workspace, relight_options)
    return {"method": relight_options.method, **weights, "relighting": json_ready(config)}


def _relighting(options: RenderOptions) -> tuple[RelightOptions, RelightConfig]:
    """Return the options and settings of relighting: the defaults of `lightsim relight`."""
    # The name is required, but no folder is made under it.
    relight_options = RelightOptions(name="image", renderer=options.renderer, seed=options.seed)
    config = RelightConfig()
    return relight_options, replace(
        config, transport=transport_as_chosen(relight_options.renderer, config.transport)
    )


class PictureImages:
    """Relights the log's pictures under target skies.

    Args:
        workspace: with the twin.
        log: at the scale of the images.
        scenario: the log without edits, in the selected frames and camera positions.
        options: of the command.
        sky_by_name: target skies.
        renderer: of the same twin, whose static scene is reused; None sets up one.
    """

    def __init__(
        self,
        workspace: Workspace,
        log: DrivingLog,
        scenario: Scenario,
        options: RenderOptions,
        sky_by_name: Mapping[str, TargetSky],
        renderer: FrameRenderer | None = None,
    ) -> None:
        relight_options, config = _relighting(options)
        self._scenario = scenario
        self._relighter = Relighter(
            workspace, log, config, relight_options, scenario, workspace.held_out, renderer
        )
        self._targets = {n: self._relighter.target(sky) for n, sky in sky_by_name.items()}

    def of(
        self, frame: ScenarioFrame, skies: Sequence[str]
    ) -> Iterator[Float32[np.ndarray, "h w 3"]]:
        """Yield the radiance of a frame under each of these skies; the frame is traced once."""
        # Skies are prepared once, in the constructor, for all frames.
        targets = [self._targets[name] for name in skies]
        for relit in self._relighter.relit(frame, self._scenario, targets):
            yield relit.radiance
