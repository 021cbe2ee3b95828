"""The `depth_field` artifact: depth of the middle of the subject, by a depth picture or layers of the user."""

import json
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import save

from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.hints import DepthField
from steps.artifacts.media import read_tensors

KEY = "depth_field"  # of the metadata


def write_depth_field(path: Path, field: DepthField) -> None:
    """Write a field as safetensors."""
    tensors = {"middle": field.middle.float().contiguous(), "known": field.known.contiguous()}
    path.write_bytes(save(tensors, {KEY: json.dumps({"sigma": field.sigma})}))


def read_depth_field(path: Path) -> DepthField:
    """Read a field that `write_depth_field` wrote.

    Raises:
        BadInput: the file is not a field, or nothing is known in it.
    """
    try:
        about, tensors = read_tensors(path, KEY)
        middle, known, sigma = tensors["middle"], tensors["known"], float(about["sigma"])
    except (SafetensorError, KeyError, ValueError, TypeError) as error:
        raise BadInput(
            f"{path.name} is not a depth field ({type(error).__name__}); give the output `depth_field` of "
            "prepare_subject"
        ) from error
    square = middle.ndim == 2 and len(set(middle.shape)) == 1 and middle.shape == known.shape
    if not square or known.dtype != torch.bool or not known.any():
        raise BadInput(f"{path.name} is not a depth field: {tuple(middle.shape)} values, {int(known.sum())} known")
    return DepthField(middle.float(), known, sigma)
