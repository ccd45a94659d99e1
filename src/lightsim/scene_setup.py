"""How a twin's parts become a scene that can be rendered; used by stages and by relighting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.casting import MakeCaster
from lightsim.core.dome import SkyDome
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import SceneAssets
from lightsim.render.embree import make_embree_caster
from lightsim.render.faces import FaceTable
from lightsim.render.gbuffers import render_gbuffers, with_ambient_occlusion
from lightsim.render.light import SkyCells, light, prepare_sky
from lightsim.render.scene import FrameScene, make_static_scene, place
from lightsim.render.transport import (
    TransportConfig,
    TransportTable,
    static_face_table,
    trace_transport,
)


def parked_actor_meshes(log: DrivingLog, assets: SceneAssets) -> list[TriMesh]:
    """Meshes of the actors that never move, in frame `world`."""
    return [
        assets.actors[track.actor_id].mesh.moved(track.trajectory.at(track.trajectory.start_ns))
        for track in log.actors
        if not track.is_moving and track.actor_id in assets.actors
    ]


@dataclass(frozen=True, eq=False)
class TransportFrame:
    """A frame whose rays are traced: light under any sky is a few sums away.

    Args:
        buffers: geometry, with ambient occlusion.
        scene: the scene at the frame's time.
        table: its rays.
        config: of the rays.
    """

    buffers: GBuffers
    scene: FrameScene
    table: TransportTable
    config: TransportConfig

    def light(self, sky: SkyDome | SkyCells) -> ShadowBuffers:
        return light(self.table, self.scene, self.buffers, sky, self.config)


class FrameRenderer:
    """Buffers and light of single frames; what is static is prepared once."""

    def __init__(
        self,
        background: TriMesh,
        inferred: TriMesh,
        transport: TransportConfig,
        seed: int,
        *,
        inferred_is_visible: bool = False,
        make_caster: MakeCaster = make_embree_caster,
    ) -> None:
        shadow_only = [inferred] if len(inferred.faces) else []
        self._static = make_static_scene(
            [background],
            shadow_only,
            inferred_is_visible=inferred_is_visible,
            make_caster=make_caster,
        )
        self._make_caster = make_caster
        self._transport = transport
        self._seed = seed
        self._faces: FaceTable | None = None

    def prepare(self, sky: SkyDome) -> SkyCells:
        """A sky made ready once for many frames."""
        return prepare_sky(sky, self._transport)

    def scene(self, scenario: Scenario, time_ns: int) -> FrameScene:
        return place(self._static, scenario, time_ns, self._make_caster)

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """Geometry buffers alone (ambient occlusion 1)."""
        scene = self.scene(scenario, frame.time_ns)
        return render_gbuffers(scene, camera, frame)

    def trace(
        self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera
    ) -> TransportFrame:
        """Geometry and the ray table of a frame: all that does not depend on the sky."""
        scene = self.scene(scenario, frame.time_ns)
        if self._faces is None:
            self._faces = static_face_table(scene, self._transport, self._seed)
        buffers = render_gbuffers(scene, camera, frame)
        table = trace_transport(scene, buffers, self._transport, self._seed, self._faces)
        buffers = with_ambient_occlusion(buffers, table.ambient_occlusion)
        return TransportFrame(buffers, scene, table, self._transport)

    def render(
        self,
        scenario: Scenario,
        frame: CameraFrame,
        camera: PinholeCamera,
        skies: Sequence[SkyDome | SkyCells],
    ) -> tuple[GBuffers, list[ShadowBuffers]]:
        """Geometry of a frame and its light under each sky, from one ray table."""
        traced = self.trace(scenario, frame, camera)
        return traced.buffers, [traced.light(sky) for sky in skies]
