"""USD stages: units, axes, time codes, and conversion of arrays to USD values.

A stage is y up, in meters, and has 24 time codes per second whatever the frame rate of the asset: programs that play
one time code per frame of their scene, such as Blender with its 24 frames per second, then show the right speed. Frame
k of an animation is at time code 24 k / fps.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, Vt
from torch import Tensor

TIME_CODES_PER_SECOND = 24.0


def time_code(frame: float, fps: float) -> float:
    """Return the time code of a frame of an animation with `fps` frames per second."""
    return TIME_CODES_PER_SECOND * frame / fps


def new_stage(root: str, kind: str, name: str, end: float) -> Usd.Stage:
    """Create a stage with a default prim.

    Args:
        root: path of the default prim.
        kind: model kind, "component" or "assembly".
        name: display name.
        end: last time code.
    """
    stage = Usd.Stage.CreateInMemory(load=Usd.Stage.LoadNone)  # payloads exist in the package only
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    stage.SetTimeCodesPerSecond(TIME_CODES_PER_SECOND)
    stage.SetFramesPerSecond(TIME_CODES_PER_SECOND)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(end)
    prim = UsdGeom.Xform.Define(stage, root).GetPrim()
    prim.SetDisplayName(name)
    model = Usd.ModelAPI(prim)
    model.SetKind(kind)
    model.SetAssetName(name)
    stage.SetDefaultPrim(prim)
    return stage


def animate(attribute: Usd.Attribute, values: Sequence[Any], fps: float) -> None:
    """Set a value per frame, the first value again one frame after the last, and as default value."""
    for frame, value in enumerate((*values, values[0])):
        attribute.Set(value, time_code(frame, fps))
    attribute.Set(values[0])


def to_array(values: Tensor) -> NDArray[Any]:
    """Convert a tensor to float32."""
    return values.detach().cpu().numpy().astype("<f4")


def vectors(rows: NDArray[Any]) -> Vt.Vec3fArray | Vt.Vec3hArray:
    """Convert rows of three numbers, half or single precision."""
    return (Vt.Vec3hArray if rows.dtype == np.float16 else Vt.Vec3fArray).FromNumpy(rows)


def quaternions(wxyz: NDArray[Any]) -> Vt.QuatfArray | Vt.QuathArray:
    """Convert rows of quaternions, half or single precision."""
    kind = Vt.QuathArray if wxyz.dtype == np.float16 else Vt.QuatfArray
    return kind.FromNumpy(np.roll(wxyz, -1, axis=-1))  # USD's memory layout is xyzw


def matrices(translations: NDArray[Any]) -> Vt.Matrix4dArray:
    """Convert translations to matrices, which act on row vectors in USD."""
    return Vt.Matrix4dArray([Gf.Matrix4d(1).SetTranslate(Gf.Vec3d(*row)) for row in translations.tolist()])


def integers(values: NDArray[Any]) -> Vt.IntArray:
    """Convert integers to a flat array."""
    return Vt.IntArray.FromNumpy(values.ravel().astype("<i4"))


def bounds(low: NDArray[Any], high: NDArray[Any]) -> Vt.Vec3fArray:
    """Return the extent of points with these lower and upper corners."""
    return vectors(np.stack((low.min(0), high.max(0))))


def file_reference(file: str) -> Sdf.AssetPath:
    """Return the asset path of a file beside the layer."""
    return Sdf.AssetPath(f"./{file}")
