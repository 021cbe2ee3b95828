"""GLBs of other programs in motion: the same file with morph targets over time, and its skeleton animated.

Everything in the file is kept: nodes, names, materials, textures, texture coordinates and skeletons. The skeleton
is animated, and morph targets add what it cannot reproduce. Existing animations are dropped, since they would move the
model twice, and scenes that are not shown, since their nodes may be shared; existing morph targets keep their default
weights.
"""

import json
from collections.abc import Iterable, Sequence
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats import meshopt
from dg4d_lib.assets.formats.foreign_glb import ForeignGlb, Piece
from dg4d_lib.assets.formats.foreign_nodes import (
    flattening,
    global_matrices,
    mesh_attributes,
    mesh_matrices,
    parents_of,
    skin_of,
    skin_weights,
    transform_points,
)
from dg4d_lib.assets.formats.foreign_skeleton import (
    JointTrack,
    SkeletonAtRest,
    SkeletonMotion,
    SkinnedVertices,
    fit_skeleton,
)
from dg4d_lib.assets.formats.gltf import MAX_POSES, VERTEX_DATA, GlbReader, GltfDocument, json_object
from dg4d_lib.assets.formats.joint_motion import close_loop
from dg4d_lib.assets.formats.normals import SmoothNormals, normal_groups
from dg4d_lib.assets.formats.tracks import Animation
from dg4d_lib.mesh.models.model import Model
from dg4d_lib.mesh.tracking.rig import continuous_quats

SAMPLE = 2000  # evenly spaced vertices that the motion of a skeleton is fitted to
PLACEMENT = "dg4d placement"
MOTION = "dg4d motion"
MOVES = "the model is animated by its skeleton; morph targets add what the skeleton cannot reproduce"
TANGENTS = "the tangents of the model were left out; players compute those of the moved surface"
AT_REST = "the skeleton of the model is not animated ({}); the motion is in morph targets"


def write_moving_glb(
    glb: ForeignGlb,
    placement: NDArray[np.float64],
    moved: NDArray[np.float32],
    fps: float,
    extras: dict[str, Any],
    interpolation: str = "LINEAR",
    moving_normals: bool = True,
) -> tuple[bytes, tuple[str, ...]]:
    """Write the file with a morph target per frame, and its skeleton in motion, in the coordinates of the world.

    Args:
        glb: the file at rest.
        placement: from the coordinates of the model to the world.
        moved: vertices of all pieces in their order, at every frame, world units.
        fps: frames per second.
        extras: JSON that is added to the asset.
        interpolation: between frames, LINEAR or STEP.
        moving_normals: True to move the normals of primitives that have some.

    Returns:
        The GLB, and notes about it.

    Raises:
        BadInput: the file would be larger than a GLB may be.
    """
    notes = list(glb.notes)
    document = _editable_document(glb.reader, extras)
    tree = document.tree
    if tree.pop("animations", None):
        notes.append("the animations of the model were dropped: the new motion takes their place")
    if len(tree["scenes"]) > 1:
        notes.append("the scenes of the model that are not shown were dropped")
    if any("TANGENT" in mesh_attributes(tree, piece.node, piece.primitive) for piece in glb.pieces):
        notes.append(TANGENTS)
    step = -(-len(moved) // MAX_POSES)
    if step > 1:
        notes.append(f"the animated model has a key every {step} frames; {MAX_POSES} morph targets are allowed")
    keys = [*range(0, len(moved), step), len(moved)]  # frames; the last one shows frame 0 again
    moved = moved[::step]
    track = np.eye(len(moved), dtype=np.float32)[np.arange(len(keys)) % len(moved)]  # the base is the model as given
    back: NDArray[np.float64] = np.linalg.inv(placement).astype(np.float64)
    animation = Animation(document, fps)
    skeleton = None
    if "skins" in tree:
        try:
            skeleton, tracks = _moving_skeleton(glb, moved, back)
            _animate_joints(document, animation, skeleton.joints, tracks, keys, interpolation)
            notes.append(MOVES)
        except SkeletonAtRest as reason:
            notes.append(AT_REST.format(reason))
    start = 0
    for node, pieces in _by_node(glb.pieces).items():
        mesh = {**tree["meshes"][tree["nodes"][node]["mesh"]]}
        mesh["primitives"] = [{**primitive} for primitive in mesh["primitives"]]
        for primitive in mesh["primitives"]:
            primitive.pop("targets", None)
        for piece in pieces:
            states = moved[:, start : start + len(piece.local)]
            start += len(piece.local)
            primitive = mesh["primitives"][piece.primitive]
            at_default = {
                name: document.add_accessor(f"{piece.part.name} {name}", values, VERTEX_DATA)
                for name, values in piece.morphed.items()
            }
            primitive["attributes"] = {**primitive["attributes"], **at_default}
            primitive["attributes"].pop("TANGENT", None)  # it would not turn with the normals
            inverses = _world_to_mesh(glb, piece, skeleton, back)
            turns = moving_normals and "NORMAL" in primitive["attributes"]
            poses = zip(keys, states, inverses, strict=False)
            primitive["targets"] = _targets(document, piece, poses, _smooth_normals(piece, states) if turns else None)
        mesh["primitives"] = [one for one in mesh["primitives"] if "targets" in one]  # all need as many targets
        mesh["weights"] = track[0].tolist()
        mesh["extras"] = {**json_object(mesh.get("extras")), "targetNames": [f"frame_{pose:03d}" for pose in keys[:-1]]}
        tree["nodes"][node] = {key: value for key, value in tree["nodes"][node].items() if key != "weights"}
        tree["nodes"][node]["mesh"] = document.add("meshes", **mesh)
        animation.add_morph(node, str(tree["nodes"][node].get("name", f"node {node}")), keys, track, interpolation)
    animation.finish()
    tree["animations"][-1]["name"] = MOTION
    _place_scene(document, placement)
    _drop_unused_meshes(tree)
    return document.to_bytes(), tuple(notes)


def _moving_skeleton(
    glb: ForeignGlb, moved: NDArray[np.float32], back: NDArray[np.float64]
) -> tuple[SkeletonMotion, list[JointTrack]]:
    """Return the motion of the model's skeleton, and that of every joint relative to its parent.

    Args:
        glb: the file at rest.
        moved: vertices of all pieces at every frame, world units.
        back: from the world to the coordinates of the model.

    Raises:
        SkeletonAtRest: it cannot move.
    """
    tree, start, skinned = glb.reader.tree, 0, []
    skins = [skin_of(tree, piece.node, piece.primitive) for piece in glb.pieces]
    step = max(1, sum(len(piece.local) for piece, skin in zip(glb.pieces, skins, strict=True) if skin) // SAMPLE)
    for piece, skin in zip(glb.pieces, skins, strict=True):
        rows = slice(start, start := start + len(piece.local), step)
        if skin is not None:
            indices, weights = skin_weights(glb.reader, mesh_attributes(tree, piece.node, piece.primitive))
            states = moved[:, rows] @ back[:3, :3].T + back[:3, 3]
            rest = piece.part.vertices[::step]
            skinned.append(SkinnedVertices(skin["joints"], indices[::step], weights[::step], rest, states))
    matrices = global_matrices(tree)
    skeleton = fit_skeleton(matrices, parents_of(tree, matrices), skinned)
    return skeleton, [skeleton.track(joint) for joint in skeleton.joints]


def _animate_joints(
    document: GltfDocument,
    animation: Animation,
    joints: Sequence[int],
    tracks: Sequence[JointTrack],
    keys: list[int],
    interpolation: str,
) -> None:
    """Add the motion of the joints; they get translations, rotations and scales in place of matrices."""
    quats = continuous_quats(np.stack([track.rotations for track in tracks]))[..., [1, 2, 3, 0]]
    nodes = document.tree["nodes"]
    for number, (joint, track) in enumerate(zip(joints, tracks, strict=True)):
        places, turns = close_loop(track.translations), close_loop(quats[:, number])
        node = {key: value for key, value in nodes[joint].items() if key != "matrix"}
        node.update(translation=places[0].tolist(), rotation=turns[0].tolist(), scale=track.scale.tolist())
        nodes[joint] = node
        animation.add_transform(joint, str(node.get("name", f"node {joint}")), keys, places, turns, interpolation)


def _world_to_mesh(
    glb: ForeignGlb, piece: Piece, skeleton: SkeletonMotion | None, back: NDArray[np.float64]
) -> Iterable[NDArray[np.float64]]:
    """Return the world-to-mesh matrices of a piece, one per frame."""
    if skeleton is None:
        return repeat(_inverse(piece.matrices) @ back)
    skin = skin_of(glb.reader.tree, piece.node, piece.primitive)
    needed = {node: skeleton.matrices(node) for node in (skin["joints"] if skin else [piece.node])}
    frames = ({node: moving[frame] for node, moving in needed.items()} for frame in range(len(skeleton.maps)))
    return (_inverse(mesh_matrices(glb.reader, piece.node, piece.primitive, one)) @ back for one in frames)


def _by_node(pieces: Sequence[Piece]) -> dict[int, list[Piece]]:
    found: dict[int, list[Piece]] = {}
    for piece in pieces:
        found.setdefault(piece.node, []).append(piece)
    return found


def _smooth_normals(piece: Piece, states: NDArray[np.float32]) -> SmoothNormals:
    """Return the normals of a piece in any pose; they are shared where the file gives equal ones at one place."""
    given = Model((piece.part,)).smoothing_groups
    return SmoothNormals(normal_groups(np.concatenate([piece.local[None], states]), piece.faces, given), piece.faces)


def _targets(
    document: GltfDocument,
    piece: Piece,
    poses: Iterable[tuple[int, NDArray[np.float32], NDArray[np.float64]]],
    normals_of: SmoothNormals | None,
) -> list[dict[str, int]]:
    """Add displacements in the coordinates of the mesh; return the morph targets.

    Args:
        document: document to extend.
        piece: vertices at rest.
        poses: frames with the vertices in the world, and the matrices from there to the coordinates of the mesh.
        normals_of: normals of the mesh in any pose; None to keep those at rest.
    """
    rest = normals_of(piece.local) if normals_of else None
    targets = []
    for frame, state, inverse in poses:
        local = transform_points(inverse, state)
        name = f"{piece.part.name} frame_{frame:03d}"
        shifts = (local - piece.local).astype(np.float32)  # of a small difference: a mesh may be far from its origin
        target = {"POSITION": document.add_accessor(name, shifts, VERTEX_DATA)}
        if normals_of is not None and rest is not None:
            turned = normals_of(local.astype(np.float32))
            target["NORMAL"] = document.add_accessor(f"{name} normals", turned - rest, VERTEX_DATA)
        targets.append(target)
    return targets


def _place_scene(document: GltfDocument, placement: NDArray[np.float64]) -> None:
    """Put the root nodes of the scene under a node that moves them into the world; other scenes are dropped.

    Skinned meshes stay roots, as glTF advises: they follow their joints alone. A node may be a root in another scene,
    but not below another node at the same time.
    """
    tree = document.tree
    scene = tree["scenes"][tree.get("scene", 0)]
    tree["scenes"], tree["scene"] = [scene], 0
    skinned = [node for node in scene["nodes"] if _follows_joints_alone(tree, node)]
    others = [node for node in scene["nodes"] if node not in skinned]
    root = document.add("nodes", name=PLACEMENT, children=others, matrix=placement.T.ravel().tolist())
    scene["nodes"] = [root, *skinned]


def _follows_joints_alone(tree: dict[str, Any], node: int) -> bool:
    """Return whether the transform of a node has no effect: its mesh is skinned, and it has no children."""
    item = tree["nodes"][node]
    if "mesh" not in item or item.get("children") or any(node in skin["joints"] for skin in tree.get("skins", ())):
        return False
    return all(skin_of(tree, node, number) for number in range(len(tree["meshes"][item["mesh"]]["primitives"])))


def _drop_unused_meshes(tree: dict[str, Any]) -> None:
    """Remove meshes that no node shows any more; others keep their order."""
    used = sorted({node["mesh"] for node in tree["nodes"] if "mesh" in node})
    tree["meshes"] = [tree["meshes"][index] for index in used]
    for node in tree["nodes"]:
        if "mesh" in node:
            node["mesh"] = used.index(node["mesh"])


def _editable_document(reader: GlbReader, extras: dict[str, Any]) -> GltfDocument:
    """Return the file as a document for further items, without compression."""
    document = GltfDocument({})
    tree = json.loads(json.dumps(reader.tree))
    views = []
    for index, view in enumerate(tree.get("bufferViews", [])):
        content = reader.view(index)
        view.get("extensions", {}).pop(meshopt.EXTENSION, None)
        view.update(buffer=0, byteOffset=len(document.binary), byteLength=len(content))
        document.binary += content + bytes(-len(content) % 4)
        views.append(view)
    tree["bufferViews"] = views
    for names in (tree.get("extensionsUsed", []), tree.get("extensionsRequired", [])):
        if meshopt.EXTENSION in names:
            names.remove(meshopt.EXTENSION)
    for collection in [name for name, value in tree.items() if value == []]:
        del tree[collection]  # glTF allows no empty arrays
    tree["asset"] = {**tree["asset"], "extras": {**json_object(tree["asset"].get("extras")), **extras}}
    document.tree = tree
    return document


def _inverse(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert matrices; use the pseudo-inverse where skinning makes one singular."""
    flat = flattening(matrices)
    found: NDArray[np.float64] = np.linalg.inv(np.where(flat[:, None, None], np.eye(4), matrices))
    if flat.any():
        found[flat] = np.linalg.pinv(matrices[flat])
    return found
