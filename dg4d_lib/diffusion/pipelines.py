"""Pipelines of diffusers from a folder: loading, choice of offloading, placement and progress.

No code of a folder is executed: classes come from diffusers and transformers, tensors from the files.
"""

import inspect
import json
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import torch
from torch import nn

from dg4d_lib.diffusion.components import HALF, missing_packages, require_all_tensors
from dg4d_lib.diffusion.flop_counter import attach_flop_counter
from dg4d_lib.errors import BackendUnavailable, BadInput

INDEX = "model_index.json"
NEGATIVE = " "  # as the card of Qwen-Image: true_cfg_scale needs some negative prompt
GIB = 2**30  # bytes
WORKSPACE_GB = 1.5  # GiB: CUDA context, latents and activations of 512 x 512 pixels; a plan, not measured on a GPU

Offload = Literal["none", "model", "sequential"]


def pipeline_class_name(model: Path) -> str:
    """Return the class that model_index.json names.

    Raises:
        BadInput: there is no model_index.json, or it names no class.
    """
    path = model / INDEX
    if not path.is_file():
        raise BadInput(f"{model} has no {INDEX}; give a pipeline in the layout of diffusers")
    try:
        name = json.loads(path.read_text(encoding="utf-8"))["_class_name"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInput(f"{path} names no pipeline ({type(error).__name__}); download the model again") from error
    return str(name[-1] if isinstance(name, list) else name)


def load_pipeline(model: Path, dtype: torch.dtype, class_name: str = "", **parts: Any) -> Any:
    """Load the pipeline in a folder.

    Args:
        model: folder in diffusers' layout, with model_index.json.
        dtype: of the networks.
        class_name: class of diffusers; empty: the one that model_index.json names.
        parts: components that replace those of the folder.

    Raises:
        BadInput: there is no pipeline, it cannot be read, or tensors are missing.
        BackendUnavailable: diffusers or a package that the pipeline needs is not installed.
    """
    try:
        import diffusers  # noqa: PLC0415 - takes seconds
    except ImportError as error:
        raise missing_packages(error) from error
    named = pipeline_class_name(model)
    cls = getattr(diffusers, class_name, None) if class_name else diffusers.DiffusionPipeline
    if cls is None:
        raise BadInput(f"diffusers {diffusers.__version__} has no {class_name}, which {named} in {model} needs")
    try:
        taken = inspect.signature(cls).parameters
        networks = _load_networks(model, dtype, lambda name: name not in parts and (not class_name or name in taken))
        half = any(_variant(folder, dtype) for folder in model.iterdir())
        pipeline = cls.from_pretrained(
            model, dtype=dtype, variant=HALF if half else None, local_files_only=True, **networks, **parts
        )
    except ImportError as error:
        raise BackendUnavailable(f"the pipeline in {model} needs a package that is not installed: {error}") from error
    except BadInput:
        raise
    except Exception as error:  # every class and file format raises its own types
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise BadInput(f"the pipeline in {model} cannot be read: {reason}") from error
    _clean_prompts_without_ftfy(pipeline)
    pipeline.set_progress_bar_config(disable=True)
    return pipeline


def place_pipeline(pipeline: Any, device: torch.device, memory_gb: float) -> Offload:
    """Put a pipeline on a device within a memory budget; return the way of offloading that this takes."""
    networks = networks_of(pipeline)
    for network in networks.values():
        network.eval().requires_grad_(False)
        attach_flop_counter(network)
    if device.type == "cpu":
        pipeline.to(device)
        return "none"
    offload = choose_offload({name: bytes_of(network) for name, network in networks.items()}, memory_gb)
    if offload == "model":
        pipeline.enable_model_cpu_offload(device=device)
    elif offload == "sequential":
        pipeline.enable_sequential_cpu_offload(device=device)
    else:
        pipeline.to(device)
    if offload != "none" and hasattr(getattr(pipeline, "vae", None), "enable_tiling"):
        pipeline.vae.enable_tiling()
    return offload


def choose_offload(sizes: Mapping[str, int], memory_gb: float) -> Offload:
    """Return the least offloading that fits a budget.

    Args:
        sizes: bytes of every network.
        memory_gb: budget, GiB.
    """
    for offload in ("none", "model"):
        if peak_gib(sizes, offload) <= memory_gb:
            return offload
    return "sequential"


def peak_gib(sizes: Mapping[str, int], offload: Literal["none", "model"]) -> float:
    """Return the planned peak of GPU memory, GiB: all networks, or the largest one, and the workspace."""
    held = sum(sizes.values()) if offload == "none" else max(sizes.values(), default=0)
    return held / GIB + WORKSPACE_GB


def networks_of(pipeline: Any) -> dict[str, nn.Module]:
    """Return the networks of a pipeline by the names of their components."""
    return {name: part for name, part in pipeline.components.items() if isinstance(part, nn.Module)}


def bytes_of(network: nn.Module) -> int:
    """Return the size of parameters and buffers."""
    tensors = [*network.parameters(), *network.buffers()]
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def call_parameters(pipeline: Any) -> Mapping[str, inspect.Parameter]:
    """Return the parameters that a call of the pipeline takes."""
    return inspect.signature(pipeline.__call__).parameters


def guidance_arguments(pipeline: Any, scale: float) -> dict[str, Any]:
    """Return the arguments of a call that set the scale of classifier-free guidance.

    Pipelines with `true_cfg_scale` ignore `guidance_scale` unless their network is guidance-distilled. Where its
    default is 1 (FLUX), the models are meant to be sampled without it.
    """
    true_scale = call_parameters(pipeline).get("true_cfg_scale")
    configs = (getattr(part, "config", None) for part in networks_of(pipeline).values())
    distilled = any(getattr(config, "guidance_embeds", False) for config in configs)
    if true_scale is None or true_scale.default <= 1 or distilled:
        return {"guidance_scale": scale}
    return {"true_cfg_scale": scale, "negative_prompt": NEGATIVE}


def call_pipeline(pipeline: Any, model: Path, arguments: Mapping[str, Any]) -> Any:
    """Call a pipeline with those of the arguments that it takes.

    Raises:
        BadInput: it refuses one of them.
    """
    known = call_parameters(pipeline)
    try:
        return pipeline(**{name: value for name, value in arguments.items() if name in known})
    except (ValueError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(f"{type(pipeline).__name__} in {model} refused its input: {reason}") from error


def is_flow_matching(model: Path) -> bool:
    """Return True if the scheduler of a folder is one of flow matching, whose networks predict velocities."""
    try:
        config = json.loads((model / "scheduler" / "scheduler_config.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    named = str(config.get("_class_name", ""))
    return "FlowMatch" in named or bool(config.get("use_flow_sigmas")) or "flow" in str(config.get("prediction_type"))


def after_step(total: int, progress: Callable[[int, int], None], done: int = 0) -> Callable[..., dict[str, Any]]:
    """Return a `callback_on_step_end` of diffusers that reports progress.

    Args:
        total: denoising steps of all calls.
        progress: called with (steps done, total).
        done: steps of earlier calls.
    """

    def report(_pipeline: Any, number: int, _time: Any, tensors: dict[str, Any]) -> dict[str, Any]:
        progress(min(done + number + 1, total), total)
        return tensors

    return report


def _load_networks(model: Path, dtype: torch.dtype, wanted: Callable[[str], bool]) -> dict[str, nn.Module]:
    """Load the networks of model_index.json whose classes belong to diffusers or transformers.

    `DiffusionPipeline.from_pretrained` does not say which tensors are missing, and fills them with random numbers.

    Args:
        model: folder of the pipeline.
        dtype: of the networks.
        wanted: True for the names of the components to load.

    Raises:
        BadInput: tensors are missing.
    """
    networks = {}
    for name, entry in json.loads((model / INDEX).read_text(encoding="utf-8")).items():
        match entry:
            case ["diffusers" | "transformers" as library, str(class_name)] if wanted(name):
                cls: Any = getattr(import_module(library), class_name, None)
                is_network = isinstance(cls, type) and issubclass(cls, nn.Module)
                if is_network:
                    folder = model / name
                    networks[name], info = cls.from_pretrained(
                        folder,
                        dtype=dtype,
                        variant=_variant(folder, dtype),
                        local_files_only=True,
                        output_loading_info=True,
                    )
                    require_all_tensors(folder, info)
    return networks


def _variant(folder: Path, dtype: torch.dtype) -> str | None:
    """Return the variant of the files to read: half precision if it is requested or if there is no other."""
    files = [*folder.glob("*.safetensors"), *folder.glob("*.bin")]
    variants = {file.name.split(".")[1].split("-")[0] for file in files}  # NAME.fp16-00001-of-00002.safetensors
    return HALF if HALF in variants and (dtype == torch.float16 or not variants & {"safetensors", "bin"}) else None


def _clean_prompts_without_ftfy(pipeline: Any) -> None:
    """Let prompts pass unrepaired where ftfy is not installed: some pipelines call it without a check."""
    module = sys.modules[type(pipeline).__module__]
    if hasattr(module, "is_ftfy_available") and not module.is_ftfy_available():
        module.ftfy = SimpleNamespace(fix_text=str)  # type: ignore[attr-defined]  # a name of that module
