"""Names of a rig's bones, and their motion relative to their parents, as glTF and UsdSkel store it."""

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat
from dg4d_lib.mesh.tracking.rig import Rig


def bone_names(rig: Rig) -> list[str]:
    """Return the names of all bones, numbered from the root; bones come from the motion and have no anatomy."""
    return [f"bone_{number:02d}" for number in range(1, len(rig.parents) + 1)]


def rest_arms(rig: Rig) -> Float[np.ndarray, "b 3"]:
    """Return the positions of all joints at rest relative to their parents; the root's relative to the world."""
    rest = rig.rest_positions.double().cpu().numpy()
    parents = rig.parents.cpu().numpy()
    return np.where(parents[:, None] >= 0, rest - rest[parents], rest)


def relative_motion(rig: Rig) -> tuple[Float[np.ndarray, "t b 4"], Float[np.ndarray, "t b 3"]]:
    """Return rotations (wxyz) and translations of all joints relative to their parents at every frame."""
    quats, positions = rig.quats.double().cpu(), rig.positions.double().cpu()
    parents = rig.parents[1:]
    inverse = quats[:, parents] * quats.new_tensor((1, -1, -1, -1))
    arms = positions[:, 1:] - positions[:, parents]
    rotations, translations = quats.clone(), positions.clone()
    rotations[:, 1:] = quat_multiply(inverse, quats[:, 1:])
    translations[:, 1:] = (quat_to_rotmat(inverse) @ arms[..., None])[..., 0]
    return rotations.numpy(), translations.numpy()


def close_loop(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """Append the first value; quaternions with the sign nearest to the last one."""
    first = values[:1]
    if values.shape[-1] == 4:
        first = np.where((first * values[-1:]).sum(-1, keepdims=True) < 0, -first, first)
    return np.concatenate((values, first)).astype("<f4")
