"""Frame-checked rigid transforms and trajectories (CONVENTIONS: Frames, Transforms)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial.transform import Rotation, Slerp

from lightsim.errors import FrameMismatchError, InputError, OutOfRangeError

# Largest error of R R^T from identity: rounding to float32 causes some 1e-7, and quaternions are
# normalised first; larger errors are a scale, a shear or a wrong matrix.
_ORTHONORMAL_TOLERANCE = 1e-6
# Last row of every homogeneous rigid transform.
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """`dst_from_src`: maps coordinates in frame `src` to coordinates in frame `dst`.

    Raises:
        InputError: the matrix is not finite or not a rotation and translation.
    """

    dst: str
    src: str
    matrix: Float[np.ndarray, "4 4"]

    def __post_init__(self) -> None:
        matrix = np.asarray(self.matrix, dtype=np.float64)
        object.__setattr__(self, "matrix", matrix)
        if _are_rigid(matrix[None]).all():
            return
        name = f"{self.dst}_from_{self.src}"
        if not np.isfinite(matrix).all():
            raise InputError(
                "the transform is not finite",
                where=name,
                got=matrix.tolist(),
                expected="16 finite numbers",
            )
        rotation = matrix[:3, :3]
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if error > _ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
            raise InputError(
                "the 3x3 block is not a rotation",
                where=name,
                got=f"orthonormality error {error:.2e}",
                remedy="Normalise the quaternion or fix the calibration.",
            )
        raise InputError(
            "the last row of the transform is wrong",
            where=name,
            got=matrix[3].tolist(),
            expected="0 0 0 1",
        )

    @staticmethod
    def identity(dst: str, src: str) -> RigidTransform:
        """Return the transform between two frames that coincide."""
        return RigidTransform(dst, src, np.eye(4))

    @staticmethod
    def from_rotation(
        dst: str,
        src: str,
        rotation: Float[np.ndarray, "3 3"],
        translation_m: Float[np.ndarray, "3"],
    ) -> RigidTransform:
        """Return the transform with a rotation and the origin of `src` in `dst`."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = translation_m
        return RigidTransform(dst, src, matrix)

    @staticmethod
    def from_quaternion(
        dst: str,
        src: str,
        quaternion_wxyz: Float[np.ndarray, "4"],
        translation_m: Float[np.ndarray, "3"],
    ) -> RigidTransform:
        """Return the transform of a (w, x, y, z) quaternion, normalised here; zero length raises
        InputError."""
        rotation = matrices_from_quaternions(np.asarray(quaternion_wxyz, dtype=np.float64)[None])
        return RigidTransform.from_rotation(dst, src, rotation[0], translation_m)

    @staticmethod
    def from_yaw(
        dst: str, src: str, yaw_rad: float, translation_m: Float[np.ndarray, "3"]
    ) -> RigidTransform:
        """Return a rotation by `yaw_rad` about z, counter-clockwise from above."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return RigidTransform.from_rotation(dst, src, rotation, translation_m)

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """The 3x3 block; its columns are the axes of `src` in `dst`."""
        return self.matrix[:3, :3]

    @property
    def translation_m(self) -> Float[np.ndarray, "3"]:
        """Origin of `src` in `dst`."""
        return self.matrix[:3, 3]

    @property
    def yaw_rad(self) -> float:
        """Direction of the src x axis in the dst x-y plane."""
        return float(np.arctan2(self.matrix[1, 0], self.matrix[0, 0]))

    def __matmul__(self, other: RigidTransform) -> RigidTransform:
        if self.src != other.dst:
            raise FrameMismatchError(
                "inner frames differ",
                where=f"{self.dst}_from_{self.src} @ {other.dst}_from_{other.src}",
                got=f"'{self.src}' and '{other.dst}'",
                expected="equal inner frames",
            )
        return RigidTransform(self.dst, other.src, self.matrix @ other.matrix)

    def inverse(self) -> RigidTransform:
        """Return `src_from_dst` by the transposed rotation, exact to rounding."""
        rotation = self.rotation.T
        return RigidTransform.from_rotation(
            self.src, self.dst, rotation, -rotation @ self.translation_m
        )

    def apply(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Transform points (rows) from `src` to `dst`."""
        return points @ self.rotation.T + self.translation_m

    def rotate(self, vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Rotate free vectors (rows), such as directions, from `src` to `dst`."""
        return points_rotated(vectors, self.rotation)


def _are_rigid(matrices: Float[np.ndarray, "n 4 4"]) -> Bool[np.ndarray, " n"]:
    """Return true for finite matrices of a rotation and a translation."""
    rotations = matrices[:, :3, :3]
    with np.errstate(all="ignore"):
        error = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
        is_rotation = (error <= _ORTHONORMAL_TOLERANCE) & (np.linalg.det(rotations) >= 0)
    # Tolerances of `np.allclose`.
    is_row = np.abs(matrices[:, 3] - _LAST_ROW) <= 1e-8 + 1e-5 * _LAST_ROW
    return is_rotation & is_row.all(axis=1) & np.isfinite(matrices).all(axis=(1, 2))


def points_rotated(
    vectors: Float[np.ndarray, "*n 3"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Rotate each row of `vectors` by one matrix, which multiplies column vectors from the left."""
    return vectors @ rotation.T


def turned_by(
    vectors: Float[np.ndarray, "n 3"], rotation_vectors_rad: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Rotate each vector by its own rotation vector (axis times angle)."""
    return Rotation.from_rotvec(rotation_vectors_rad).apply(vectors)


def rotation_from_vector(rotation_vector_rad: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the matrix of the rotation about `rotation_vector_rad` by its length."""
    return Rotation.from_rotvec(rotation_vector_rad).as_matrix()


def vector_from_rotation(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Return axis times angle of a rotation, with the angle in [0, pi]."""
    return Rotation.from_matrix(rotation).as_rotvec()


def matrices_from_quaternions(
    quaternions_wxyz: Float[np.ndarray, "n 4"],
) -> Float[np.ndarray, "n 3 3"]:
    """Return the rotation matrices of (w, x, y, z) quaternions, which are normalised first.

    Raises:
        InputError: a quaternion is not finite or has zero length.
    """
    norm = np.linalg.norm(quaternions_wxyz, axis=1)
    is_bad = ~np.isfinite(norm) | (norm < 1e-9)
    if is_bad.any():
        raise InputError(
            "a quaternion is not finite or has zero length",
            got=quaternions_wxyz[is_bad][0].tolist(),
            expected="finite (w, x, y, z) that are not all 0",
        )
    # SciPy's order is (x, y, z, w).
    return Rotation.from_quat(np.roll(quaternions_wxyz, -1, axis=1)).as_matrix()


def quaternion_from_matrix(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """Return the (w, x, y, z) quaternion of a rotation, with w >= 0."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(canonical=True), 1)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses `dst_from_src` over time: slerp and lerp between them, undefined beyond them.

    Rotations turn at constant rate between poses (Shoemake 1985, doi:10.1145/325165.325242).

    Args:
        times_ns: strictly increasing integer nanoseconds.
        matrices: one 4x4 `dst_from_src` each.
    """

    dst: str
    src: str
    times_ns: Int64[np.ndarray, " n"]
    matrices: Float[np.ndarray, "n 4 4"]

    def __post_init__(self) -> None:
        name = f"{self.dst}_from_{self.src}"
        if len(self.times_ns) == 0:
            raise InputError("the trajectory is empty", where=name, expected="one pose or more")
        backward = np.flatnonzero(np.diff(self.times_ns) <= 0)
        if len(backward):
            first = int(backward[0])
            raise InputError(
                "the times of a trajectory must increase strictly",
                where=name,
                got=f"{self.times_ns[first + 1]} ns after {self.times_ns[first]} ns",
                expected="each time once, in order",
            )
        # The constructor describes what is wrong; a check of each pose alone would take seconds.
        for matrix in self.matrices[~_are_rigid(self.matrices)]:
            RigidTransform(self.dst, self.src, matrix)

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def start_ns(self) -> int:
        """Time of the first pose."""
        return int(self.times_ns[0])

    @property
    def end_ns(self) -> int:
        """Time of the last pose."""
        return int(self.times_ns[-1])

    @property
    def positions_m(self) -> Float[np.ndarray, "n 3"]:
        """Origin of `src` in `dst` at each pose."""
        return self.matrices[:, :3, 3]

    def distance_ahead_m(self, time_ns: int) -> float:
        """Return the distance travelled along the x axis of `src` since the first pose, in metres;
        negative for reverse motion. Beyond the ends it is that of the end."""
        # Only the part along the x axis counts: wheels do not roll sideways, and labelled boxes
        # jitter.
        steps = np.diff(self.positions_m, axis=0)
        ahead = (self.matrices[:-1, :3, 0] + self.matrices[1:, :3, 0]) / 2
        way = np.concatenate([[0.0], np.cumsum(np.einsum("nc,nc->n", steps, ahead))])
        seconds = (self.times_ns - self.start_ns) / 1e9
        return float(np.interp((time_ns - self.start_ns) / 1e9, seconds, way))

    def covers(self, time_ns: int, hold_s: float = 0.0) -> bool:
        """Return whether `at` has a pose: from the first to the last one, extended by `hold_s`."""
        hold_ns = int(hold_s * 1e9)
        return self.start_ns - hold_ns <= time_ns <= self.end_ns + hold_ns

    def at(self, time_ns: int, hold_s: float = 0.0) -> RigidTransform:
        """Return the interpolated pose; within `hold_s` beyond an end, the pose of that end.

        Raises:
            OutOfRangeError: `time_ns` lies outside the trajectory.
        """
        if not self.covers(time_ns, hold_s):
            raise OutOfRangeError(
                "the time is outside the trajectory",
                where=f"{self.dst}_from_{self.src}",
                got=f"{time_ns} ns",
                expected=f"{self.start_ns} to {self.end_ns} ns",
            )
        time_ns = min(max(time_ns, self.start_ns), self.end_ns)
        j = int(np.searchsorted(self.times_ns, time_ns, side="left"))
        # Exact at stored times, without rounding; and j - 1 exists below.
        if self.times_ns[j] == time_ns:
            return RigidTransform(self.dst, self.src, self.matrices[j])
        before, after = self.matrices[j - 1], self.matrices[j]
        # Differences of integers first: nanoseconds since 1970 exceed a double's precision.
        span = int(self.times_ns[j] - self.times_ns[j - 1])
        fraction = int(time_ns - self.times_ns[j - 1]) / span
        turn = vector_from_rotation(before[:3, :3].T @ after[:3, :3])
        rotation = before[:3, :3] @ rotation_from_vector(fraction * turn)
        translation = (1 - fraction) * before[:3, 3] + fraction * after[:3, 3]
        return RigidTransform.from_rotation(self.dst, self.src, rotation, translation)

    def held(self, time_ns: int) -> RigidTransform:
        """Return the interpolated pose; beyond an end, the pose of that end."""
        return self.at(min(max(time_ns, self.start_ns), self.end_ns))

    def held_positions_m(self, times_ns: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "m 3"]:
        """Return the translations of `held_at` without computing rotations."""
        seconds, knots_s = self._seconds(times_ns), self._seconds(self.times_ns)
        return np.stack([np.interp(seconds, knots_s, k) for k in self.positions_m.T], axis=1)

    def held_at(self, times_ns: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, "m 4 4"]:
        """Return the poses `held` at many times."""
        # Slerp requires two poses.
        if len(self) == 1:
            return np.repeat(self.matrices, len(times_ns), axis=0)
        knots_s = self._seconds(self.times_ns)
        seconds = np.clip(self._seconds(times_ns), 0.0, knots_s[-1])
        poses = np.tile(np.eye(4), (len(times_ns), 1, 1))
        turns = Slerp(knots_s, Rotation.from_matrix(self.matrices[:, :3, :3]))
        poses[:, :3, :3] = turns(seconds).as_matrix()
        poses[:, :3, 3] = self.held_positions_m(times_ns)
        return poses

    def to_src(
        self, points_dst: Float[np.ndarray, "m 3"], times_ns: Int64[np.ndarray, " m"]
    ) -> Float64[np.ndarray, "m 3"]:
        """Transform points from `dst` to `src`, each by the pose `held` at its own time."""
        if len(self) == 1:
            return self.held(self.start_ns).inverse().apply(points_dst.astype(np.float64))
        times_ns = np.clip(times_ns, self.start_ns, self.end_ns)
        before = np.searchsorted(self.times_ns, times_ns, side="right") - 1
        before = np.minimum(before, len(self) - 2)
        # Differences of integers first: nanoseconds since 1970 exceed a double's precision.
        fraction = (times_ns - self.times_ns[before]) / np.diff(self.times_ns)[before]
        steps = np.diff(self.positions_m, axis=0)
        offset = points_dst - (self.positions_m[before] + fraction[:, None] * steps[before])
        rotations = self.matrices[:, :3, :3]
        unturned = np.einsum("nji,nj->ni", rotations[before], offset)
        # Few poses lie in the times of many points.
        used, row = np.unique(before, return_inverse=True)
        turns = Rotation.from_matrix(rotations[used].transpose(0, 2, 1) @ rotations[used + 1])
        return turned_by(unturned, -fraction[:, None] * turns.as_rotvec()[row])

    def _seconds(self, times_ns: Int64[np.ndarray, " m"]) -> Float64[np.ndarray, " m"]:
        """Return seconds since the first pose: nanoseconds since 1970 exceed a float's
        precision."""
        return (times_ns - self.start_ns) * 1e-9
