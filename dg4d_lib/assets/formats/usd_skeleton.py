"""Skinned mesh in USD: a UsdSkel skeleton with one animation, which Quick Look, Blender and game engines play.

    /asset/mesh                 SkelRoot
    /asset/mesh/subject         the mesh at rest, with joint indices and weights
    /asset/mesh/rig             Skeleton; rest pose and bind pose are equal
    /asset/mesh/rig/motion      SkelAnimation, joints relative to their parents

Skeleton and animation are also named at the mesh itself, because Apple's readers do not inherit them.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, UsdSkel, Vt

from dg4d_lib.assets.formats.joint_motion import bone_names, close_loop, relative_motion, rest_arms
from dg4d_lib.assets.formats.usd_stage import animate, bounds, integers, matrices, quaternions, time_code, vectors
from dg4d_lib.mesh.tracking.rig import Rig, rig_offsets

RIG = "/asset/mesh/rig"
MOTION = f"{RIG}/motion"


def add_skeleton(
    stage: Usd.Stage, mesh: UsdGeom.Mesh, vertices: NDArray[np.float32], first: NDArray[np.int64], rig: Rig, fps: float
) -> None:
    """Add skeleton and animation of a rig, and skin a mesh to it.

    Args:
        stage: stage whose prim /asset/mesh is a SkelRoot.
        mesh: mesh at rest, below the SkelRoot.
        vertices: rest positions of the rig's vertices.
        first: vertex of the rig for every point of the mesh.
        rig: skeleton, weights and motion.
        fps: frames per second.
    """
    joints = _joint_paths(rig)
    skeleton = UsdSkel.Skeleton.Define(stage, RIG)
    skeleton.CreateJointsAttr(joints)
    skeleton.CreateBindTransformsAttr(matrices(rig.rest_positions.double().cpu().numpy()))
    skeleton.CreateRestTransformsAttr(matrices(rest_arms(rig)))
    _add_animation(stage, rig, joints, fps)
    for prim in (skeleton.GetPrim(), mesh.GetPrim()):
        UsdSkel.BindingAPI.Apply(prim).CreateAnimationSourceRel().SetTargets([MOTION])
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([RIG])
    width = rig.weights.shape[1]
    weights = rig.weights.cpu().numpy().astype("<f4")[first]
    bones = np.where(weights > 0, rig.bones.cpu().numpy()[first], 0)
    binding.CreateJointIndicesPrimvar(False, width).Set(integers(bones))
    binding.CreateJointWeightsPrimvar(False, width).Set(Vt.FloatArray.FromNumpy(weights.ravel()))
    binding.CreateGeomBindTransformAttr().Set(matrices(np.zeros((1, 3)))[0])
    points = torch.from_numpy(vertices)
    moved = (points + rig_offsets(rig, points)).numpy()
    boxes = [bounds(pose, pose) for pose in moved]
    animate(UsdSkel.Root(stage.GetPrimAtPath(mesh.GetPath().GetParentPath())).CreateExtentAttr(), boxes, fps)


def _joint_paths(rig: Rig) -> list[str]:
    """Return the joints as UsdSkel names them: a path from the root, whose last element is the joint's own name."""
    paths: list[str] = []
    for name, parent in zip(bone_names(rig), rig.parents.tolist(), strict=True):
        paths.append(f"{paths[parent]}/{name}" if parent >= 0 else name)
    return paths


def _add_animation(stage: Usd.Stage, rig: Rig, joints: list[str], fps: float) -> None:
    """Add the animation; readers that ignore time get its first frame."""
    motion = UsdSkel.Animation.Define(stage, MOTION)
    motion.CreateJointsAttr(joints)
    rotations, translations = (close_loop(values) for values in relative_motion(rig))
    motion.CreateScalesAttr(Vt.Vec3hArray(len(joints), (1.0, 1.0, 1.0)))
    for attribute, values in (
        (motion.CreateRotationsAttr(), [quaternions(quats) for quats in rotations]),
        (motion.CreateTranslationsAttr(), [vectors(rows) for rows in translations]),
    ):
        for frame, value in enumerate(values):
            attribute.Set(value, time_code(frame, fps))
        attribute.Set(values[0])


def as_skel_root(stage: Usd.Stage, path: str) -> None:
    """Define a prim that contains a skinned mesh and its skeleton."""
    UsdSkel.Root.Define(stage, Sdf.Path(path))
