"""Estimated source light on the surfaces of a log, the input of intrinsic decomposition."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lightsim.appearance.intrinsic.light import LightAt, ObservedPoints, Reflections, SurfaceLight
from lightsim.core.dome import SkyDome
from lightsim.core.frames import RigidTransform
from lightsim.core.log import DrivingLog
from lightsim.core.mesh import TriMesh
from lightsim.core.twin import SceneAssets, parked_actor_meshes
from lightsim.render.casters.embree import make_embree_caster
from lightsim.render.composite import CompositeCaster
from lightsim.render.scene import FrameScene, make_static_scene, without_actors
from lightsim.render.transport.irradiance import IrradianceConfig, irradiance_at
from lightsim.render.transport.lobes import Lobes, normal_reflectance
from lightsim.render.transport.matrix import TransportConfig, static_face_table
from lightsim.render.transport.sun import sun_visibility, unshadowed_sun

IRRADIANCE = IrradianceConfig(TransportConfig(sky_rays=32, face_rays=8, glossy_rays=64), 0.25)
"""Settings of the source light: numbers of rays, and the albedo of surfaces that no camera
observed. Fewer rays for reflections cause coloured noise on shaded asphalt, whose own radiance is
small. Chosen; sensitivity not measured."""


class SourceLight:
    """Estimated source light on the meshes of a log, with and without the inferred casters."""

    def __init__(
        self,
        log: DrivingLog,
        assets: SceneAssets,
        inferred: TriMesh,
        dome: SkyDome,
        config: IrradianceConfig,
        seed: int,
        unseen_sky: SkyDome | None = None,
    ) -> None:
        # Moving actors are left out: their shadows are in few of the pictures behind a colour.
        parked = parked_actor_meshes(log, assets)
        measured = [assets.background, *parked]
        self._measured = without_actors(make_static_scene(measured))
        self._all = _with_casters(self._measured, inferred)
        self._dome, self._unseen_sky = dome, unseen_sky
        self._config, self._seed = config, seed
        self._faces = None
        if config.unseen_albedo is not None:
            self._faces = static_face_table(self._all, config.transport, seed)

    def on(self, world_from_mesh: RigidTransform) -> LightAt:
        """Return the light at points of a mesh at a pose."""

        def light_at(points: ObservedPoints) -> SurfaceLight:
            placed, normals, towards = (
                np.asarray(vectors).astype(np.float32)
                for vectors in (
                    world_from_mesh.apply(points.position),
                    world_from_mesh.rotate(points.normal),
                    world_from_mesh.rotate(points.towards_camera),
                )
            )
            # Points that no camera observed have no view direction, hence no reflection.
            is_seen = towards.any(axis=1)
            f0 = normal_reflectance(np.zeros_like(placed), np.zeros(len(placed), np.float32))
            f0[~is_seen] = 0.0
            roughness = np.asarray(points.roughness).astype(np.float32)
            return self._at(Lobes(placed, normals, towards, roughness, f0))

        return light_at

    def _at(self, lobes: Lobes) -> SurfaceLight:
        points_world, normals_world = lobes.ray_starts_world, lobes.normal_world
        config, dome = self._config, self._dome
        found = irradiance_at(
            lobes,
            self._all,
            dome,
            config,
            self._seed,
            self._faces,
            self._unseen_sky,
        )
        rays = config.transport
        # Column 0: with measured surfaces alone; column 1: with inferred roofs, too. Where they
        # differ, only an inferred surface casts the shadow, which is weaker evidence.
        columns = [found.sun_visibility, found.sun_visibility]
        direct = np.zeros((len(points_world), 3), dtype=np.float32)
        if dome.sun is not None:
            columns[0] = sun_visibility(
                self._measured.caster, points_world, normals_world, dome.sun, rays
            )
            direct = unshadowed_sun(normals_world, dome.sun)
        return SurfaceLight(
            direct,
            np.stack(columns, axis=1),
            found.sky,
            found.sky_part,
            found.bounce,
            Reflections(found.reflected, found.reflected_part, found.reflected_sun),
        )


def _with_casters(scene: FrameScene, inferred: TriMesh) -> FrameScene:
    """Return the scene with an additional mesh that is invisible to cameras; both scenes use the
    same acceleration structure for all other meshes."""
    static = replace(
        scene.static,
        inferred=(inferred,),
        caster=CompositeCaster([scene.static.caster, make_embree_caster([inferred])]),
        normals=(*scene.static.normals, inferred.vertex_normals()),
    )
    return replace(scene, static=static)
