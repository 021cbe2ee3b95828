"""Names for the shapes that recur.

Letters: n Gaussians, t frames, v vertices, f faces, h rows, w columns, b images, k harmonics bases.
"""

from jaxtyping import Bool, Float, Int
from torch import Tensor

Points = Float[Tensor, "n 3"]
Quaternions = Float[Tensor, "*batch 4"]  # wxyz, any non-zero norm
Image = Float[Tensor, "h w 3"]  # color in [0, 1]
Images = Float[Tensor, "b h w 3"]
Coverage = Float[Tensor, "b h w 1"]  # opacity in [0, 1]
Cutout = Float[Tensor, "h w 4"]  # straight alpha, color and alpha in [0, 1]
Mask = Bool[Tensor, "h w"]
Pose = Float[Tensor, "4 4"]
Vertices = Float[Tensor, "v 3"]
Faces = Int[Tensor, "f 3"]
Color = Float[Tensor, " 3"]
