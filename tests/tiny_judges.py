"""Tiny random networks of the scores, saved in the published formats. Every test of the suite may import this."""

import warnings
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import nn

STAGES = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
ACTIONS = 400


def write_vgg16(folder: Path, width: int = 2) -> Path:
    """VGG16's convolutions, with few channels."""
    folder.mkdir(parents=True, exist_ok=True)
    generator, tensors, before = torch.Generator().manual_seed(0), {}, 3
    for k in (k for stage in STAGES for k in stage):
        tensors[f"features.{k}.weight"] = torch.randn(width, before, 3, 3, generator=generator) / 3
        tensors[f"features.{k}.bias"] = torch.randn(width, generator=generator) / 5
        before = width
    save_file(tensors, folder / "model.safetensors")
    return folder


def write_lpips(folder: Path, width: int = 2) -> Path:
    """The weights of its stages."""
    folder.mkdir(parents=True, exist_ok=True)
    heads = {f"lin{k}.model.1.weight": torch.full((1, width, 1, 1), 0.5) for k in range(len(STAGES))}
    torch.save(heads, folder / "LPIPS_v0.1_vgg-a78928a0.pth")
    return folder


def write_clip(folder: Path) -> Path:
    """A CLIPModel for pictures of 64 pixels."""
    from transformers import CLIPConfig, CLIPModel
    from transformers.utils import logging

    logging.disable_progress_bar()
    text = {"hidden_size": 8, "intermediate_size": 8, "num_hidden_layers": 1, "num_attention_heads": 1, "vocab_size": 9}
    text |= {"bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 2}
    vision = {"image_size": 64, "patch_size": 32, "hidden_size": 16, "intermediate_size": 32}
    vision |= {"num_hidden_layers": 2, "num_attention_heads": 2}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=12)).save_pretrained(folder)
    return folder


class TinyI3d(nn.Module):
    """A linear function of the mean and the spread of every channel over time and place."""

    def __init__(self) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.last = nn.Linear(6, ACTIONS)

    def forward(
        self, film: torch.Tensor, rescale: bool = True, resize: bool = True, return_features: bool = False
    ) -> torch.Tensor:
        assert not rescale
        assert not resize
        flat = film.flatten(2)
        found = self.last(torch.cat([flat.mean(2), flat.std(2)], 1))
        return found if return_features else found.softmax(1)


def write_i3d(folder: Path) -> Path:
    """A network with the arguments of the shared I3D, as TorchScript."""
    folder.mkdir(parents=True, exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # published in this form
        torch.jit.script(TinyI3d()).save(str(folder / "i3d_torchscript.pt"))
    return folder
