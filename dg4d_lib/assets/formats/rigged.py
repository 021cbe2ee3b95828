"""A tracked mesh on a skeleton, as one skinned GLB: what animators can go on working with.

Joints form one tree and carry the bones' motion relative to their parents; the pose of the nodes, and the mesh, is the
mesh at rest. The animation is closed like that of the morphed mesh. Changing textures are left out: the mesh wears its
own.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt16
from numpy.typing import NDArray

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.gltf import VERTEX_DATA, GltfDocument
from dg4d_lib.assets.formats.materials import add_material, add_texture, to_uint8
from dg4d_lib.assets.formats.primitives import MeshPrimitive
from dg4d_lib.errors import BadInput
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat
from dg4d_lib.mesh.tracking.rig import Rig, fit_rig

NAME = "subject"
ENOUGH = 0.05  # of the motion may be missed: more bones would follow what nobody sees
MAX_BONES = 255  # that bytes can number
FLOAT = 5126  # glTF's name of a kind of number
SHARES = 65535  # of which weights are whole multiples


def fit_asset_rig(asset: Asset4D, max_bones: int, max_error: float) -> tuple[Rig | None, str]:
    """The rig of an asset, if one follows the motion well enough; and a sentence for the report, either way.

    Args:
        asset: what moves.
        max_bones: of the rig, at most 255.
        max_error: part of the motion that may be missed (`Rig.error`).

    Raises:
        BadInput: no vertices, no frames, or numbers that are not finite.
    """
    rig = fit_rig(asset.mesh.vertices, asset.offsets, ENOUGH, max_bones)
    bones = "1 bone misses" if len(rig.rest_positions) == 1 else f"{len(rig.rest_positions)} bones miss"
    figures = f"{bones} {rig.error:.1%} of the motion: {rig.rms:.2g} world units (rms), at most {rig.max_distance:.2g}"
    if rig.error > max_error:
        return None, f"no rig: {figures}; {max_error:.1%} is allowed"
    return rig, f"rig: {figures}"


def write_rigged_glb(asset: Asset4D, rig: Rig, settings: GltfSettings) -> bytes:
    """A GLB of a skinned mesh.

    Args:
        asset: gives the mesh, the frames per second and what the file says about itself.
        rig: of this asset.
        settings: image, quality, meshopt, interpolation, roughness and metallic.

    Raises:
        BadInput: the rig is of another mesh or has too many bones, or the texture is too large for its format.
        BackendUnavailable: the package for compression is missing.
    """
    mesh = asset.mesh
    if len(rig.weights) != len(mesh.vertices) or len(rig.rest_positions) > MAX_BONES:
        given = f"{len(rig.rest_positions)} bones and {len(rig.weights)} vertices"
        raise BadInput(
            f"a rig for this mesh has at most {MAX_BONES} bones and {len(mesh.vertices)} vertices; given {given}"
        )
    document = GltfDocument(asset.extras, compressed=settings.meshopt)
    texture = add_texture(document, NAME, to_uint8(mesh.texture), settings)
    material = add_material(document, NAME, texture, settings)
    vertices, uvs = (values.detach().cpu().numpy().astype("<f4") for values in (mesh.vertices, mesh.uvs))
    shape = MeshPrimitive(document, NAME, vertices, mesh.faces.cpu().numpy(), uvs, None)
    shares = _whole_shares(rig.weights.double().cpu().numpy())
    bones = np.where(shares > 0, rig.bones.cpu().numpy(), 0).astype("u1")
    attributes = {
        **shape.attributes,
        "JOINTS_0": document.add_accessor(f"{NAME} joints", bones, VERTEX_DATA),
        "WEIGHTS_0": document.add_accessor(f"{NAME} weights", shares, VERTEX_DATA, normalized=True),
    }
    primitive = {"attributes": attributes, "indices": shape.indices, "material": material, "mode": 4}
    number = document.add("meshes", name=NAME, primitives=[primitive])
    skeleton, joints = _add_joints(document, rig)
    binding = _add_matrices(document, rig.rest_positions.double().cpu().numpy())
    skin = document.add("skins", name="rig", inverseBindMatrices=binding, skeleton=skeleton, joints=joints)
    node = document.add("nodes", name=NAME, mesh=number, skin=skin)
    _add_motion(document, rig, joints, asset.fps, settings.interpolation.upper())
    document.tree["scene"] = document.add("scenes", name="asset", nodes=[skeleton, node])
    return document.to_bytes()


def _whole_shares(weights: Float[np.ndarray, "v 4"]) -> UInt16[np.ndarray, "v 4"]:
    """Weights as whole numbers whose rows sum to 65535: rounded down, and what is missing to the largest rests."""
    exact = weights / weights.sum(1, keepdims=True) * SHARES
    shares = np.floor(exact)
    missing = np.rint(SHARES - shares.sum(1, keepdims=True))
    order = np.argsort(shares - exact, axis=1, kind="stable")
    np.put_along_axis(shares, order, np.take_along_axis(shares, order, 1) + (np.arange(4) < missing), 1)
    return shares.astype("<u2")


def _add_joints(document: GltfDocument, rig: Rig) -> tuple[int, list[int]]:
    """The nodes of the joints at rest. Returns the node above all, and theirs."""
    parents, rest = rig.parents.tolist(), rig.rest_positions.double().cpu().numpy()
    joints = []
    for bone, parent in enumerate(parents):
        arm = rest[bone] - (rest[parent] if parent >= 0 else 0)
        joints.append(document.add("nodes", name=f"joint_{bone:03d}", translation=arm.tolist()))
    nodes = document.tree["nodes"]
    for bone, parent in enumerate(parents):
        if parent >= 0:
            nodes[joints[parent]].setdefault("children", []).append(joints[bone])
    return document.add("nodes", name="skeleton", children=[joints[0]]), joints


def _add_matrices(document: GltfDocument, rest: Float[np.ndarray, "b 3"]) -> int:
    """From the mesh to every joint at rest. Returns the number of the accessor."""
    matrices = np.tile(np.eye(4, dtype="<f4"), (len(rest), 1, 1))
    matrices[:, 3, :3] = -rest  # columns one after another
    view = document.add_view("joints at rest", matrices.tobytes())
    return document.add(
        "accessors", name="joints at rest", bufferView=view, componentType=FLOAT, count=len(rest), type="MAT4"
    )


def _add_motion(document: GltfDocument, rig: Rig, joints: list[int], fps: float, interpolation: str) -> None:
    """Rotations and translations of all joints, relative to their parents."""
    quats, places = rig.quats.double().cpu(), rig.positions.double().cpu()
    inner = rig.parents[1:]
    back = quats[:, inner] * quats.new_tensor((1, -1, -1, -1))
    arms = places[:, 1:] - places[:, inner]
    turns, moves = quats.clone(), places.clone()
    turns[:, 1:] = quat_multiply(back, quats[:, 1:])
    moves[:, 1:] = (quat_to_rotmat(back) @ arms[..., None])[..., 0]
    samplers: list[dict[str, Any]] = []
    channels = []
    times = document.add_accessor("times", (np.arange(len(quats) + 1) / fps).astype("<f4"))
    for joint, turn, move in zip(joints, turns.unbind(1), moves.unbind(1), strict=True):
        name = document.tree["nodes"][joint]["name"]
        for path, values in (("rotation", turn.numpy()[:, [1, 2, 3, 0]]), ("translation", move.numpy())):
            output = document.add_accessor(f"{name} {path}", _closed(values))
            channels.append({"sampler": len(samplers), "target": {"node": joint, "path": path}})
            samplers.append({"input": times, "output": output, "interpolation": interpolation})
    document.add("animations", name="motion", samplers=samplers, channels=channels)


def _closed(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """The first value again at the end; a quaternion on the near side of the one before."""
    first = values[:1]
    if values.shape[1] == 4 and (first * values[-1:]).sum() < 0:
        first = -first
    return np.concatenate((values, first)).astype("<f4")
