"""CLIP image similarity: cosine of ViT-B/32 embeddings (Radford et al. 2021)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.clip_images import normalize_for_clip
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.metrics.image import resize_square

BATCH = 16  # images


@dataclass(frozen=True)
class ClipModel:
    """Image encoder of a CLIP model.

    Attributes:
        model: CLIPModel of transformers.
        device: of the model.
    """

    model: Any
    device: torch.device

    def embed(self, images: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b d"]:
        """Return unit-length embeddings of square images in [0, 1], resized to the model's input size."""
        size = self.model.config.vision_config.image_size
        embeddings = []
        with torch.no_grad():
            for part in images.split(BATCH):
                planes = normalize_for_clip(resize_square(part.to(self.device), size).movedim(-1, 1))
                embedded = self.model.get_image_features(pixel_values=planes.contiguous())
                embeddings.append(getattr(embedded, "pooler_output", embedded))  # a tensor before transformers 5
        return torch.nn.functional.normalize(torch.cat(embeddings), dim=-1)


def cosine_similarity(a: Float[Tensor, "b d"], b: Float[Tensor, "b d"]) -> Float[Tensor, " b"]:
    """Return the cosines of pairs of unit-length embeddings."""
    return (a * b).sum(-1)


def load_clip(folder: Path, device: torch.device) -> ClipModel:
    """Load the CLIPModel of a folder in the layout of transformers.

    Raises:
        BackendUnavailable: transformers is not installed.
        BadInput: the folder holds no such model.
    """
    try:
        from transformers import CLIPModel  # noqa: PLC0415 - takes seconds
        from transformers.utils.logging import disable_progress_bar  # noqa: PLC0415
    except ImportError as error:
        raise BackendUnavailable(f"CLIP needs transformers ({error}); run `make setup`") from error
    disable_progress_bar()
    try:
        model = CLIPModel.from_pretrained(folder, local_files_only=True)
    except Exception as error:  # transformers raises many types for damaged folders
        raise BadInput(f"{folder} holds no CLIP model: {type(error).__name__}: {error}".splitlines()[0]) from error
    return ClipModel(model.eval().requires_grad_(False).to(device), device)
