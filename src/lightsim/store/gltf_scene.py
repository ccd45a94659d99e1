"""Scene graph of glTF: placements of meshes by nodes, instances and joints.

Reference: Khronos glTF 2.0 specification, sections 3.5 and 3.7.3; EXT_mesh_gpu_instancing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from lightsim.store.gltf_accessors import Accessors
from lightsim.store.gltf_document import GltfDocument, extensions, whole

# Largest depth of nested nodes; a skeleton of a long chain has some hundred.
_MAX_DEPTH = 1000
# Largest number of nodes on all paths from the roots, and of instances of one node. It bounds the
# time for hostile files, in which paths multiply.
_MAX_VISITS = 100_000
_INSTANCING = "EXT_mesh_gpu_instancing"


@dataclass(frozen=True, eq=False)
class Placement:
    """A mesh in the scene.

    Args:
        mesh: index of the mesh.
        scene_from_mesh: one transform for each instance.
        joints: for a skin, the transform of each joint times its inverse bind matrix; they place
            the vertices instead of `scene_from_mesh`. None without a skin.
        weights: weights of the mesh's morph targets.
    """

    mesh: int
    scene_from_mesh: Float64[np.ndarray, "k 4 4"]
    joints: Float64[np.ndarray, "j 4 4"] | None
    weights: tuple[float, ...]


class Scene:
    """Reader of the nodes of the default scene."""

    def __init__(self, document: GltfDocument, accessors: Accessors) -> None:
        self._document = document
        self._accessors = accessors
        self._locals: dict[int, Float64[np.ndarray, "4 4"]] = {}
        self._globals: dict[int, Float64[np.ndarray, "4 4"]] = {}
        self._skins: dict[int, Float64[np.ndarray, "j 4 4"]] = {}
        self.moving: set[int] = set()
        """Nodes whose transform places a vertex: with a mesh, joints, and their ancestors."""
        self.visited: set[int] = set()
        """Nodes of the scene that are not hidden."""

    def placements(self) -> Iterator[Placement]:
        """Yield every mesh of the scene, except below hidden nodes (KHR_node_visibility).

        Raises:
            ValueError: nodes form a loop, or a transform or a skin is broken.
        """
        # A stack, since recursion would exceed Python's limit for deep or looping nodes.
        stack = [(np.eye(4), whole(root), 0) for root in self._roots()]
        visits = 0
        while stack:
            parent, index, depth = stack.pop()
            visits += 1
            if depth > _MAX_DEPTH or visits > _MAX_VISITS:
                raise ValueError("its nodes form a loop or are nested too deep")
            node = self._document.item("nodes", index)
            if extensions(node).get("KHR_node_visibility", {}).get("visible") is False:
                continue
            self.visited.add(index)
            matrix = parent @ self._local(index)
            if "mesh" in node:
                self._mark(index)
                yield self._placement(node, matrix)
            stack.extend((matrix, whole(child), depth + 1) for child in node.get("children", ()))

    def _placement(self, node: dict[str, Any], matrix: Float64[np.ndarray, "4 4"]) -> Placement:
        mesh = self._document.item("meshes", node["mesh"])
        weights = tuple(float(w) for w in node.get("weights", mesh.get("weights", ())))
        joints = self._skin(whole(node["skin"])) if "skin" in node else None
        instances = matrix[None]
        if joints is None and _INSTANCING in extensions(node):
            instances = matrix @ self._instances(extensions(node)[_INSTANCING])
        return Placement(whole(node["mesh"]), instances, joints, weights)

    def _roots(self) -> list[int]:
        scenes = self._document.items("scenes")
        if scenes:
            return self._document.item("scenes", self._document.json.get("scene", 0)).get(
                "nodes", []
            )
        return [i for i in range(len(self._document.items("nodes"))) if i not in self._parents]

    @cached_property
    def _parents(self) -> dict[int, int]:
        nodes = self._document.items("nodes")
        return {
            whole(child): i for i, node in enumerate(nodes) for child in node.get("children", ())
        }

    def _local(self, index: int) -> Float64[np.ndarray, "4 4"]:
        if index not in self._locals:
            self._locals[index] = _node_matrix(self._document.item("nodes", index))
        return self._locals[index]

    def _mark(self, index: int) -> None:
        """Add a node and its ancestors to `moving`."""
        node: int | None = index
        while node is not None and node not in self.moving:
            self.moving.add(node)
            node = self._parents.get(node)

    def _instances(self, extension: dict[str, Any]) -> Float64[np.ndarray, "k 4 4"]:
        attributes = extension.get("attributes", {})
        columns = {
            name: self._accessors.floats(attributes[name], width)
            for name, width in (("TRANSLATION", 3), ("ROTATION", 4), ("SCALE", 3))
            if name in attributes
        }
        counts = {len(rows) for rows in columns.values()}
        if len(counts) != 1 or max(counts) > _MAX_VISITS:
            raise ValueError(f"instances of a mesh number {sorted(counts)}")
        return _transforms(
            columns.get("TRANSLATION"), columns.get("ROTATION"), columns.get("SCALE"), counts.pop()
        )

    def _skin(self, index: int) -> Float64[np.ndarray, "j 4 4"]:
        if index not in self._skins:
            skin = self._document.item("skins", index)
            # Joint indices have 16 bits.
            if not 0 < len(skin["joints"]) <= 1 << 16:
                raise ValueError(f"a skin has {len(skin['joints'])} joints")
            joints = np.stack([self._global(whole(number)) for number in skin["joints"]])
            if "inverseBindMatrices" in skin:
                inverse = self._accessors.floats(skin["inverseBindMatrices"], 16)
                if len(inverse) < len(joints):
                    raise ValueError(f"a skin has {len(inverse)} matrices for {len(joints)} joints")
                # Accessors store matrices in column-major order.
                joints = joints @ inverse[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
            self._skins[index] = joints
        return self._skins[index]

    def _global(self, number: int) -> Float64[np.ndarray, "4 4"]:
        """Return the transform of a node from its root; the node need not belong to the scene."""
        self._mark(number)
        chain = [number]
        while chain[-1] not in self._globals and chain[-1] in self._parents:
            chain.append(self._parents[chain[-1]])
            if len(chain) > _MAX_DEPTH:
                raise ValueError("its nodes form a loop or are nested too deep")
        matrix = self._globals.get(chain[-1], None)
        for node in reversed(chain if matrix is None else chain[:-1]):
            matrix = self._local(node) if matrix is None else matrix @ self._local(node)
            self._globals[node] = matrix
        assert matrix is not None
        return matrix


def _node_matrix(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    else:
        rows = {
            name: np.array(node[name], dtype=np.float64).reshape(1, width)
            for name, width in (("translation", 3), ("rotation", 4), ("scale", 3))
            if name in node
        }
        matrix = _transforms(rows.get("translation"), rows.get("rotation"), rows.get("scale"), 1)[0]
    if not np.isfinite(matrix).all():
        raise ValueError("a node's transform is not finite")
    return matrix


def _transforms(
    translation: Float64[np.ndarray, "k 3"] | None,
    rotation: Float64[np.ndarray, "k 4"] | None,
    scale: Float64[np.ndarray, "k 3"] | None,
    count: int,
) -> Float64[np.ndarray, "k 4 4"]:
    """Return translation times rotation (quaternions in the order x, y, z, w) times scale."""
    matrices = np.tile(np.eye(4), (count, 1, 1))
    if rotation is not None:
        if not (np.abs(rotation) < 2.0).all():
            raise ValueError("the rotation of a node is not a unit quaternion")
        matrices[:, :3, :3] = Rotation.from_quat(rotation).as_matrix()
    if scale is not None:
        matrices[:, :3, :3] *= scale[:, None, :]
    if translation is not None:
        matrices[:, :3, 3] = translation
    return matrices


def skinned(
    vertices: Float64[np.ndarray, "n 3"],
    joints: Float64[np.ndarray, "j 4 4"],
    numbers: Float64[np.ndarray, "n k"],
    weights: Float64[np.ndarray, "n k"],
) -> tuple[Float64[np.ndarray, "n 3"], bool]:
    """Place vertices by their joints.

    Args:
        numbers, weights: joint indices of each vertex and their weights, all sets side by side.
            Weights are divided by their sum; a vertex without weights follows its first joint.

    Returns:
        Vertices in the scene, and whether the joints mirror most of the vertices.

    Raises:
        ValueError: a vertex with weight refers to a missing joint.
    """
    weights = np.maximum(weights, 0.0)
    if ((numbers >= len(joints)) & (weights > 0)).any() or (numbers < 0).any():
        raise ValueError("a vertex names no joint of its skin")
    numbers = np.minimum(numbers, len(joints) - 1).astype(np.int64)
    weights[weights.sum(axis=1) == 0, 0] = 1.0
    weights = weights / weights.sum(axis=1, keepdims=True)
    # Linear blend skinning: the weighted mean of the joints' matrices.
    mixed = np.zeros((len(vertices), 3, 4))
    for column in range(weights.shape[1]):
        mixed += weights[:, column, None, None] * joints[numbers[:, column], :3]
    placed = np.einsum("nij,nj->ni", mixed[:, :, :3], vertices) + mixed[:, :, 3]
    return placed, bool(np.median(np.linalg.det(mixed[:, :, :3])) < 0)
