"""Nodes and skins of a glTF of another program: where its meshes are."""

from collections.abc import Container, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.gltf import GlbReader, json_object, read_accessor
from dg4d_lib.errors import BadInput

MAX_NODES = 100_000
MAX_DEPTH = 200  # of nested nodes
MAX_GROUPS = 4  # largest number of joint groups per vertex, four joints each
FLAT = 1e-9  # determinant of a matrix that cannot be inverted, relative to the cube of its norm

Matrices = dict[int, NDArray[np.float64]]  # "4 4" per node


def global_matrices(tree: dict[str, Any], unscaled: Container[int] = ()) -> Matrices:
    """Return the global matrix of every node of the scene, parents before their children.

    Args:
        tree: of the file; without scenes it gets one with all nodes.
        unscaled: nodes whose own scale counts as 1.

    Raises:
        BadInput: too many nodes, a node that is reached twice, or nodes that are nested too deeply.
        KeyError, IndexError, TypeError, ValueError: the JSON is broken.
    """
    nodes = tree.get("nodes", [])
    if len(nodes) > MAX_NODES:
        raise BadInput(f"the model has {len(nodes)} nodes; at most {MAX_NODES} are read")
    if not tree.get("scenes"):
        children = {child for node in nodes for child in node.get("children", ())}
        tree["scenes"] = [{"nodes": [index for index in range(len(nodes)) if index not in children]}]
        tree["scene"] = 0
    found: Matrices = {}
    waiting = [(index, np.eye(4), 1) for index in tree["scenes"][tree.get("scene", 0)].get("nodes", ())]
    while waiting:
        index, parent, depth = waiting.pop()
        if index in found or depth > MAX_DEPTH:
            raise BadInput("the nodes of the model form a circle or are nested too deeply; export it again")
        node = nodes[index] if index not in unscaled else {**nodes[index], "scale": (1, 1, 1)}
        found[index] = parent @ _local_matrix(node)
        waiting += [(child, found[index], depth + 1) for child in nodes[index].get("children", ())]
    return found


def invisible_nodes(tree: dict[str, Any], nodes: Iterable[int]) -> set[int]:
    """Return the nodes that KHR_node_visibility hides, with all below them; parents come before their children."""
    found: set[int] = set()
    for node in nodes:
        item = tree["nodes"][node]
        visibility = json_object(json_object(item.get("extensions")).get("KHR_node_visibility"))
        if node in found or visibility.get("visible", True) is False:
            found |= {node, *item.get("children", ())}
    return found


def move_roots(tree: dict[str, Any], shift: NDArray[np.float64]) -> None:
    """Move all that the scene shows, by its root nodes."""
    for index in tree["scenes"][tree.get("scene", 0)]["nodes"]:
        node = tree["nodes"][index]
        if "matrix" in node:
            node["matrix"] = [*node["matrix"][:12], *(np.array(node["matrix"][12:15]) + shift).tolist(), 1.0]
        else:
            node["translation"] = (np.array(node.get("translation", (0.0, 0.0, 0.0))) + shift).tolist()


def _local_matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), float)
    scale = 2 / max(x * x + y * y + z * z + w * w, 1e-12)
    turn = np.array(
        [
            [1 - scale * (y * y + z * z), scale * (x * y - z * w), scale * (x * z + y * w)],
            [scale * (x * y + z * w), 1 - scale * (x * x + z * z), scale * (y * z - x * w)],
            [scale * (x * z - y * w), scale * (y * z + x * w), 1 - scale * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), float)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def mesh_matrices(reader: GlbReader, node: int, primitive: int, globals_: Matrices) -> NDArray[np.float64]:
    """Return the matrix from the coordinates of a mesh to the model, or one per vertex where a skeleton moves it.

    Args:
        reader: of the file.
        node: that shows the mesh.
        primitive: of the mesh.
        globals_: global matrices of the nodes.
    """
    attributes = mesh_attributes(reader.tree, node, primitive)
    skin = skin_of(reader.tree, node, primitive)
    if skin is None:
        return globals_[node][None]
    joints = [globals_[joint] for joint in skin["joints"]]
    inverse = np.tile(np.eye(4), (len(joints), 1, 1))
    if "inverseBindMatrices" in skin:
        inverse = read_accessor(reader, skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)[: len(joints)]
    posed = np.stack(joints) @ inverse
    indices, weights = skin_weights(reader, attributes)
    blended: NDArray[np.float64] = np.einsum("vk,vkij->vij", weights, posed[indices])
    blended[weights.sum(1) == 0] = np.eye(4)
    return blended


def parents_of(tree: dict[str, Any], nodes: Iterable[int]) -> dict[int, int]:
    """Return the parent of every child of these nodes."""
    return {child: node for node in nodes for child in tree["nodes"][node].get("children", ())}


def mesh_attributes(tree: dict[str, Any], node: int, primitive: int) -> dict[str, int]:
    """Return the accessors of a primitive of the mesh that a node shows."""
    attributes: dict[str, int] = tree["meshes"][tree["nodes"][node]["mesh"]]["primitives"][primitive]["attributes"]
    return attributes


def skin_of(tree: dict[str, Any], node: int, primitive: int) -> dict[str, Any] | None:
    """Return the skin that moves a primitive of the mesh that a node shows, if one does."""
    item = tree["nodes"][node]
    if "skin" not in item or "JOINTS_0" not in mesh_attributes(tree, node, primitive):
        return None
    skin: dict[str, Any] = tree["skins"][item["skin"]]
    return skin


def skin_weights(reader: GlbReader, attributes: dict[str, int]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the joints of every vertex, as numbers in the skin, and their weights: sum 1, or 0 if none is given."""
    groups = [group for group in range(MAX_GROUPS) if f"JOINTS_{group}" in attributes]
    indices = [read_accessor(reader, attributes[f"JOINTS_{group}"], raw=True) for group in groups]
    weights = [read_accessor(reader, attributes[f"WEIGHTS_{group}"]) for group in groups]
    total = np.concatenate(weights, 1).astype(np.float64)
    share = total.sum(1, keepdims=True)
    broken = np.abs(share) < 1e-6
    return np.concatenate(indices, 1).astype(np.int64), np.where(broken, 0, total / np.where(broken, 1, share))


def flattening(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which matrices flatten what they move; small ones need not, as of quantized meshes."""
    linear = matrices[:, :3, :3]
    flat: NDArray[np.bool_] = np.abs(np.linalg.det(linear)) <= FLAT * np.linalg.norm(linear, axis=(1, 2)) ** 3
    return flat


def transform_points(matrices: NDArray[np.float64], points: NDArray[Any]) -> NDArray[np.float64]:
    """Apply one affine matrix, or one per point."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1)
    if len(matrices) == 1:
        return (homogeneous @ matrices[0].T)[:, :3]
    return np.einsum("vij,vj->vi", matrices, homogeneous)[:, :3]
