"""Sun rays of one frame, cast by Mitsuba from what already lies on its device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from lightsim.core.dome import Sun
from lightsim.core.mesh import TriMesh
from lightsim.core.mitsuba_variants import mitsuba_with
from lightsim.errors import InputError
from lightsim.render.casters.embree import offset_origins
from lightsim.render.casters.mitsuba import (
    VARIANTS,
    MitsubaBackend,
    is_usable,
    make_mitsuba_scene,
)
from lightsim.render.mitsuba_scene import columns
from lightsim.render.transport.faces import FaceSamples, TransportConfig, hashed_shifts
from lightsim.render.transport.sun import PATTERNS, disc_patterns

_TORCH_DEVICE: dict[MitsubaBackend, str] = {"cuda": "cuda", "llvm": "cpu"}


class DeviceSunRays:
    """Where the sun rays of pixels and faces start, on the device where they are cast.

    A sun costs an upload of its disc's directions and one kernel each for pixels and faces, in
    which the rays of a pixel are written out: meant for tens of them at most. All meshes are one
    scene, since a kernel on CUDA cannot trace two.
    """

    def __init__(
        self,
        meshes: Sequence[TriMesh],
        points_world: Float32[np.ndarray, "p 3"],
        normals_world: Float32[np.ndarray, "p 3"],
        faces: FaceSamples,
        config: TransportConfig,
        backend: MitsubaBackend,
    ) -> None:
        """
        Args:
            meshes: all that light meets, in frame `world`.
            points_world: where the rays of pixels start, not yet moved off their surfaces.

        Raises:
            InputError: Mitsuba or torch cannot use the device here.
        """
        self.device = _torch_device(backend)
        self.pixel_count, self.face_count = len(points_world), len(faces.normals_world)
        self._backend: MitsubaBackend = backend
        self._rays_each = (config.sun_rays, faces.sun_points_world.shape[1])
        chosen = hashed_shifts(np.arange(self.pixel_count), 7)[:, 0] * PATTERNS
        starts = offset_origins(points_world, normals_world)
        with mitsuba_with(VARIANTS[backend]) as mitsuba:
            has_faces = any(len(mesh.faces) for mesh in meshes)
            self._scene: Any = make_mitsuba_scene(mitsuba, meshes) if has_faces else None
            self._starts: Any = columns(mitsuba, starts)
            self._normals: Any = columns(mitsuba, normals_world)
            self._first_direction: Any = mitsuba.UInt32(
                chosen.astype(np.uint32) * np.uint32(config.sun_rays)
            )
            self._face_points: Any = columns(mitsuba, faces.sun_points_world.reshape(-1, 3))
            self._face_normals: Any = columns(mitsuba, faces.normals_world)

    @property
    def held_bytes(self) -> int:
        """Of the device's memory, without the ray casting structure."""
        face_rows = self.face_count * (1 + self._rays_each[1])
        return 4 * (self.pixel_count * 7 + face_rows * 3)

    def of_pixels(
        self, sun: Sun
    ) -> tuple[Float32[torch.Tensor, " p"], Float32[torch.Tensor, " p"]]:
        """Cosine of the sun (0 where it stands behind) and the seen fraction of its disc; the
        same directions as `light.sun_visibility`."""
        import drjit

        count = self._rays_each[0]
        if self.pixel_count == 0 or self._scene is None:
            return self._without_rays(self.pixel_count)
        with mitsuba_with(VARIANTS[self._backend]) as mitsuba:
            disc = columns(mitsuba, disc_patterns(sun, count).reshape(-1, 3))

            def ray(number: Any) -> Any:
                towards = drjit.gather(type(disc), disc, self._first_direction + number)
                return mitsuba.Ray3f(self._starts, towards)

            cosine = _cosine(mitsuba, self._normals, sun)
            return self._cast(mitsuba, cosine, count, ray, is_coherent=True)

    def of_faces(self, sun: Sun) -> Float32[torch.Tensor, " f"]:
        """Cosine of the sun's centre times the fraction of each face's points that see it."""
        import drjit

        count = self._rays_each[1]
        if self.face_count == 0 or self._scene is None:
            return torch.zeros(self.face_count, device=self.device)
        with mitsuba_with(VARIANTS[self._backend]) as mitsuba:
            towards = columns(mitsuba, sun.direction_world[None])
            first = drjit.arange(mitsuba.UInt32, self.face_count) * count

            def ray(number: Any) -> Any:
                start = drjit.gather(type(self._face_points), self._face_points, first + number)
                return mitsuba.Ray3f(start, towards)

            cosine = _cosine(mitsuba, self._face_normals, sun)
            cosine, visible = self._cast(mitsuba, cosine, count, ray, is_coherent=False)
            return cosine * visible

    def _cast(
        self,
        mitsuba: Any,
        cosine: Any,
        count: int,
        ray: Callable[[Any], Any],
        *,
        is_coherent: bool,
    ) -> tuple[Float32[torch.Tensor, " n"], Float32[torch.Tensor, " n"]]:
        """The cosine, and the fraction of `count` rays that meet nothing where it is not 0."""
        import drjit

        faces_sun = cosine > 0
        seen = mitsuba.Float(0)
        for number in range(count):
            is_blocked = self._scene.ray_test(ray(number), coherent=is_coherent, active=faces_sun)
            seen += drjit.select(is_blocked, 0.0, 1.0)
        visible = drjit.select(faces_sun, seen / count, 0.0)
        drjit.eval(cosine, visible)
        return self._to_torch(cosine), self._to_torch(visible)

    def _to_torch(self, values: Any) -> Float32[torch.Tensor, " n"]:
        """A copy on the device that torch owns.

        Dr.Jit and torch work on streams of their own and know nothing of each other's use of
        memory, so each has finished before the other goes on: Dr.Jit before torch reads, torch
        before Dr.Jit may put something else there.
        """
        import drjit

        drjit.sync_thread()
        owned = values.torch().clone()
        if owned.is_cuda:
            torch.cuda.current_stream(owned.device).synchronize()
        return owned

    def _without_rays(
        self, count: int
    ) -> tuple[Float32[torch.Tensor, " n"], Float32[torch.Tensor, " n"]]:
        return torch.zeros(count, device=self.device), torch.zeros(count, device=self.device)


def _torch_device(backend: MitsubaBackend) -> torch.device:
    """Where torch finds what Mitsuba's backend leaves."""
    if not is_usable(backend):
        raise InputError(
            f"Mitsuba cannot cast rays with {backend} here",
            where="the frame on a device",
            remedy="Light frames by render.light, which needs no device.",
        )
    if backend == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "torch finds no CUDA device",
            where="the frame on a device",
            remedy="Install a torch that is built for CUDA.",
        )
    import drjit

    with mitsuba_with(VARIANTS[backend]) as mitsuba:
        sample = mitsuba.Float(np.zeros(1, dtype=np.float32))
        drjit.sync_thread()
        device = sample.torch().device
    assert device.type == _TORCH_DEVICE[backend]
    return device


def _cosine(mitsuba: Any, normals: Any, sun: Sun) -> Any:
    import drjit

    unit = sun.direction_world / np.linalg.norm(sun.direction_world)
    return drjit.maximum(drjit.dot(normals, columns(mitsuba, unit[None])), 0.0)
