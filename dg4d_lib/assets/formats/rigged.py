"""Skinned GLB of a tracked mesh with a skeleton, for editing by animators.

The joints form one tree and are animated relative to their parents; nodes and mesh are stored in the rest pose. The
animation loops like that of the morphed mesh. Textures per frame are not written; the mesh has its shared texture.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.gltf import VERTEX_DATA, GltfDocument
from dg4d_lib.assets.formats.joint_motion import bone_names, close_loop, relative_motion, rest_arms
from dg4d_lib.assets.formats.materials import add_material, add_texture, to_uint8
from dg4d_lib.assets.formats.normals import mesh_normal_groups
from dg4d_lib.assets.formats.primitives import MeshPrimitive, quantization_cube, reorder_mesh
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.tracking.rig import Rig, fit_rig

NAME = "subject"
TARGET_ERROR = 0.05  # share of the motion; no bones are added below it, as the rest is hardly visible
PRECISE = 0.004  # largest root mean square error of a rig that replaces the morph targets, world units of the fit
RIGID = 0.02  # change of a bone's length below which it counts as constant
STILL = 1e-5  # change of a translation below which it gets no channel, relative to the largest coordinate
MAX_BONES = 255  # joint indices are bytes
FLOAT = 5126  # glTF component type
WEIGHT_ONE, QUANTIZED_ONE = 65535, 255  # integer that encodes the weight 1


def fit_asset_rig(
    asset: Asset4D, max_bones: int, max_error: float, meters_per_unit: float = 1.0
) -> tuple[Rig | None, str]:
    """Fit a rig to an asset; return it, or None if its error is too large, and a note for the report.

    Args:
        asset: the animated mesh.
        max_bones: maximum number of bones, up to 255.
        max_error: largest acceptable `Rig.error`.
        meters_per_unit: scale of the asset, meters per world unit of the fit; the note gives distances in world units.

    Raises:
        BadInput: no vertices, no frames, or numbers that are not finite.
    """
    rig = fit_rig(asset.mesh.vertices, asset.offsets, TARGET_ERROR, max_bones)
    bones = "1 bone misses" if len(rig.rest_positions) == 1 else f"{len(rig.rest_positions)} bones miss"
    lengths = "bones keep their lengths" if rig.stretch < RIGID else f"bones stretch by up to {rig.stretch:.0%}"
    rms, largest = rig.rms / meters_per_unit, rig.max_distance / meters_per_unit
    figures = f"{bones} {rig.error:.1%} of the motion: {rms:.2g} world units (rms), at most {largest:.2g}"
    if rig.error > max_error:
        return None, f"no rig: {figures}; {max_error:.1%} is allowed"
    return rig, f"rig: {figures}; {lengths}"


def write_rigged_glb(asset: Asset4D, rig: Rig, settings: GltfSettings) -> bytes:
    """Encode a skinned mesh as GLB.

    Args:
        asset: mesh, frames per second and extras.
        rig: the rig of this asset.
        settings: image, quality, quantized, meshopt, interpolation, roughness and metallic.

    Raises:
        BadInput: the rig belongs to another mesh or has too many bones, or the texture is too large for its format.
        BackendUnavailable: meshoptimizer is missing.
    """
    mesh, bones, shares = asset.mesh, rig.bones.cpu(), rig.weights.cpu()
    if len(rig.weights) != len(mesh.vertices) or len(rig.rest_positions) > MAX_BONES:
        raise BadInput(
            f"the rig must have at most {MAX_BONES} bones and the {len(mesh.vertices)} vertices of the mesh; given "
            f"{len(rig.rest_positions)} bones and {len(rig.weights)} vertices"
        )
    document = GltfDocument(asset.extras, compressed=settings.meshopt)
    texture = add_texture(document, NAME, to_uint8(mesh.texture), settings)
    material = add_material(document, NAME, texture, settings)
    states = torch.cat([mesh.vertices[None], mesh.vertices + asset.offsets])
    if settings.meshopt:
        mesh, order = reorder_mesh(mesh)
        bones, shares, states = bones[order], shares[order], states[:, order]
    vertices, uvs = (values.detach().cpu().numpy().astype("<f4") for values in (mesh.vertices, mesh.uvs))
    cube = quantization_cube([vertices], (), settings)
    groups = mesh_normal_groups(mesh, states.detach().cpu().numpy())
    shape = MeshPrimitive(document, NAME, vertices, mesh.faces.cpu().numpy(), uvs, cube, groups, skinned=True)
    weights = _quantize_weights(shares.double().numpy(), WEIGHT_ONE if cube is None else QUANTIZED_ONE)
    joints_of = np.where(weights > 0, bones.numpy(), 0).astype("u1")
    attributes = {
        **shape.attributes,
        "JOINTS_0": document.add_accessor(f"{NAME} joints", joints_of, VERTEX_DATA),
        "WEIGHTS_0": document.add_accessor(f"{NAME} weights", weights, VERTEX_DATA, normalized=True),
    }
    primitive = {"attributes": attributes, "indices": shape.indices, "material": material, "mode": 4}
    number = document.add("meshes", name=NAME, primitives=[primitive])
    skeleton, joints = _add_joints(document, rig)
    bind_matrices = _add_bind_matrices(document, rig.rest_positions.double().cpu().numpy())
    skin = document.add("skins", name="rig", inverseBindMatrices=bind_matrices, skeleton=skeleton, joints=joints)
    node = document.add("nodes", name=NAME, mesh=number, skin=skin)
    _add_motion(document, rig, joints, asset.fps, settings.interpolation.upper())
    document.tree["scene"] = document.add("scenes", name="asset", nodes=[skeleton, node])
    return document.to_bytes()


def _quantize_weights(weights: Float[np.ndarray, "v 4"], one: int) -> UInt[np.ndarray, "v 4"]:
    """Quantize weights to integers whose rows sum to exactly `one`, by the largest remainder method."""
    exact = weights / weights.sum(1, keepdims=True) * one
    floors = np.floor(exact)
    missing = np.rint(one - floors.sum(1, keepdims=True))
    order = np.argsort(floors - exact, axis=1, kind="stable")
    np.put_along_axis(floors, order, np.take_along_axis(floors, order, 1) + (np.arange(4) < missing), 1)
    return floors.astype("<u2" if one > QUANTIZED_ONE else "u1")


def _add_joints(document: GltfDocument, rig: Rig) -> tuple[int, list[int]]:
    """Add the joint nodes in the rest pose; return the index of the skeleton's root node and those of the joints."""
    parents = rig.parents.tolist()
    joints = [
        document.add("nodes", name=name, translation=arm)
        for name, arm in zip(bone_names(rig), rest_arms(rig).tolist(), strict=True)
    ]
    nodes = document.tree["nodes"]
    for bone, parent in enumerate(parents):
        if parent >= 0:
            nodes[joints[parent]].setdefault("children", []).append(joints[bone])
    return document.add("nodes", name="skeleton", children=[joints[0]]), joints


def _add_bind_matrices(document: GltfDocument, rest: Float[np.ndarray, "b 3"]) -> int:
    """Add the inverse bind matrices, from the mesh to every joint at rest; return the accessor's index."""
    matrices = np.tile(np.eye(4), (len(rest), 1, 1))
    matrices[:, 3, :3] = -rest  # column-major
    matrices = matrices.astype("<f4")
    view = document.add_view("joints at rest", matrices.tobytes())
    return document.add(
        "accessors", name="joints at rest", bufferView=view, componentType=FLOAT, count=len(rest), type="MAT4"
    )


def _add_motion(document: GltfDocument, rig: Rig, joints: list[int], fps: float, interpolation: str) -> None:
    """Add an animation of all joints relative to their parents; a bone of constant length only turns."""
    rotations, translations = relative_motion(rig)
    samplers: list[dict[str, Any]] = []
    channels = []
    times = document.add_accessor("times", (np.arange(len(rotations) + 1) / fps).astype("<f4"))
    for number, joint in enumerate(joints):
        name = document.tree["nodes"][joint]["name"]
        tracks = [("rotation", rotations[:, number][:, [1, 2, 3, 0]])]
        if np.ptp(translations[:, number], axis=0).max() > STILL * np.abs(translations).max() or number == 0:
            tracks.append(("translation", translations[:, number]))
        for path, values in tracks:
            output = document.add_accessor(f"{name} {path}", close_loop(values))
            channels.append({"sampler": len(samplers), "target": {"node": joint, "path": path}})
            samplers.append({"input": times, "output": output, "interpolation": interpolation})
    document.add("animations", name="motion", samplers=samplers, channels=channels)
