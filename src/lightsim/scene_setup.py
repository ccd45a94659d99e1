"""How a twin's parts become a scene that can be rendered; used by stages and by relighting."""

from __future__ import annotations

from collections.abc import Sequence

from lightsim.core.buffers import GBuffers, ShadowBuffers
from lightsim.core.camera import PinholeCamera
from lightsim.core.dome import SkyDome
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.scenario import Scenario
from lightsim.core.sensors import CameraFrame
from lightsim.core.twin import SceneAssets
from lightsim.render.faces import FaceTable
from lightsim.render.gbuffers import render_gbuffers, with_ambient_occlusion
from lightsim.render.light import SkyCells, light, prepare_sky
from lightsim.render.scene import FrameScene, make_static_scene, place
from lightsim.render.transport import TransportConfig, static_face_table, trace_transport


def parked_actor_meshes(log: DrivingLog, assets: SceneAssets) -> list[TriMesh]:
    """Meshes of the actors that never move, in frame `world`."""
    return [
        assets.actors[track.actor_id].mesh.moved(track.trajectory.at(track.trajectory.start_ns))
        for track in log.actors
        if not track.is_moving and track.actor_id in assets.actors
    ]


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
    ) -> None:
        shadow_only = [inferred] if len(inferred.faces) else []
        self._static = make_static_scene(
            [background], shadow_only, inferred_is_visible=inferred_is_visible
        )
        self._transport = transport
        self._seed = seed
        self._faces: FaceTable | None = None

    def prepare(self, sky: SkyDome) -> SkyCells:
        """A sky made ready once for many frames."""
        return prepare_sky(sky, self._transport)

    def scene(self, scenario: Scenario, time_ns: int) -> FrameScene:
        return place(self._static, scenario, time_ns)

    def geometry(self, scenario: Scenario, frame: CameraFrame, camera: PinholeCamera) -> GBuffers:
        """Geometry buffers alone (ambient occlusion 1)."""
        scene = self.scene(scenario, frame.time_ns)
        return render_gbuffers(scene, camera, frame)

    def render(
        self,
        scenario: Scenario,
        frame: CameraFrame,
        camera: PinholeCamera,
        skies: Sequence[SkyDome | SkyCells],
    ) -> tuple[GBuffers, list[ShadowBuffers]]:
        """Geometry of a frame and its light under each sky, from one ray table."""
        scene = self.scene(scenario, frame.time_ns)
        if self._faces is None:
            self._faces = static_face_table(scene, self._transport, self._seed)
        buffers = render_gbuffers(scene, camera, frame)
        table = trace_transport(scene, buffers, self._transport, self._seed, self._faces)
        buffers = with_ambient_occlusion(buffers, table.ambient_occlusion)
        lights = [light(table, scene, buffers, sky, self._transport) for sky in skies]
        return buffers, lights
