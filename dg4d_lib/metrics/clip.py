"""How alike pictures are to CLIP (Radford et al. 2021): the cosine of their embeddings by ViT-B/32."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.clip_images import normalize_for_clip
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.metrics.image import resize_square

PICTURES_AT_ONCE = 16


@dataclass(frozen=True)
class ClipModel:
    """The image side of a CLIP model.

    Attributes:
        model: a CLIPModel of transformers.
        device: where it is.
    """

    model: Any
    device: torch.device

    def embed(self, images: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b d"]:
        """Embeddings of length 1 of square pictures in [0, 1], which are resize_square to what the model sees."""
        size = self.model.config.vision_config.image_size
        found = []
        with torch.no_grad():
            for part in images.split(PICTURES_AT_ONCE):
                planes = normalize_for_clip(resize_square(part.to(self.device), size).movedim(-1, 1))
                embedded = self.model.get_image_features(pixel_values=planes.contiguous())
                found.append(getattr(embedded, "pooler_output", embedded))  # a tensor before transformers 5
        return torch.nn.functional.normalize(torch.cat(found), dim=-1)


def cosine_similarity(a: Float[Tensor, "b d"], b: Float[Tensor, "b d"]) -> Float[Tensor, " b"]:
    """Cosines of embeddings, pair by pair: 1 is equal."""
    return (a * b).sum(-1)


def load_clip(folder: Path, device: torch.device) -> ClipModel:
    """The CLIPModel of a folder in the layout of transformers.

    Raises:
        BackendUnavailable: transformers is not installed.
        BadInput: the folder does not hold such a model.
    """
    try:
        from transformers import CLIPModel  # noqa: PLC0415 - takes seconds
        from transformers.utils.logging import disable_progress_bar  # noqa: PLC0415
    except ImportError as error:
        raise BackendUnavailable(f"CLIP needs transformers ({error}); run `make setup`") from error
    disable_progress_bar()
    try:
        model = CLIPModel.from_pretrained(folder, local_files_only=True)
    except Exception as error:  # whatever a damaged folder makes transformers raise
        raise BadInput(f"{folder} holds no CLIP model: {type(error).__name__}: {error}".splitlines()[0]) from error
    return ClipModel(model.eval().requires_grad_(False).to(device), device)
