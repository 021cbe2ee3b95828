import json
import shutil
from pathlib import Path

import pytest
import tiny_weights
import torch
from safetensors.torch import load_file, save_file

from dg4d_lib.diffusion import components, noise_schedule
from dg4d_lib.diffusion.components import Placement
from dg4d_lib.diffusion.video_model import start_index
from dg4d_lib.errors import BackendUnavailable, BadInput

CPU = torch.device("cpu")
FP32 = Placement(CPU, torch.float32)
LOADERS = {"vae": components.load_vae, "unet": components.load_unet, "image_encoder": components.load_image_encoder}
FILES = {
    "vae": "diffusion_pytorch_model.safetensors",
    "unet": "diffusion_pytorch_model.safetensors",
    "image_encoder": "model.safetensors",
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_weights.write_zero123(tmp_path_factory.mktemp("whole") / "model")


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_weights.write_zero123(tmp_path_factory.mktemp("half") / "model", variant="fp16")


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "model"))


@pytest.mark.parametrize("name", LOADERS)
def test_what_is_loaded_is_what_was_saved(name: str, whole: Path, tmp_path: Path) -> None:
    part = LOADERS[name](whole, FP32)
    for key, value in load_file(whole / name / FILES[name]).items():
        assert torch.equal(part.state_dict()[key], value)
    part.save_pretrained(tmp_path / name)
    again = LOADERS[name](tmp_path, FP32).state_dict()
    assert all(torch.equal(again[key], value) for key, value in part.state_dict().items())


@pytest.mark.parametrize("name", LOADERS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_every_part_has_the_precision_that_was_asked_for_and_is_frozen(
    name: str, dtype: torch.dtype, whole: Path
) -> None:
    part = LOADERS[name](whole, Placement(CPU, dtype))
    assert {value.dtype for value in part.parameters()} == {dtype}
    assert not any(value.requires_grad for value in part.parameters())
    assert not part.training


@pytest.mark.parametrize("name", LOADERS)
def test_every_tensor_of_a_part_goes_to_its_device(name: str, whole: Path) -> None:
    part = LOADERS[name](whole, Placement(torch.device("meta"), torch.float32))
    assert {value.device.type for value in (*part.parameters(), *part.buffers())} == {"meta"}


def test_channels_can_lie_innermost_and_change_nothing(whole: Path) -> None:
    plain, innermost = components.load_vae(whole, FP32), components.load_vae(whole, Placement(CPU, torch.float32, True))
    assert innermost.encoder.conv_in.weight.is_contiguous(memory_format=torch.channels_last)
    pixels = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    expected, found = (vae.encode(pixels).latent_dist.mode() for vae in (plain, innermost))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("name", LOADERS)
def test_files_of_the_half_precision_variant_are_read_where_there_are_no_others(name: str, half: Path) -> None:
    (file,) = (half / name).glob("*.fp16.safetensors")
    part = LOADERS[name](half, FP32)
    for key, value in load_file(file).items():
        assert value.dtype == torch.float16
        assert torch.equal(part.state_dict()[key], value.float())


def test_half_precision_reads_the_variant_and_others_the_whole(tmp_path: Path) -> None:
    for name in ("diffusion_pytorch_model.safetensors", "diffusion_pytorch_model.fp16.safetensors"):
        save_file({}, tmp_path / name)
    (tmp_path / "diffusion_pytorch_model.bin").touch()
    assert components.weights_file(tmp_path).name == "diffusion_pytorch_model.safetensors"
    assert components.weights_file(tmp_path, half=True).name == "diffusion_pytorch_model.fp16.safetensors"


@pytest.mark.parametrize("variant", [None, "fp16"])
@pytest.mark.parametrize("name", LOADERS)
def test_shards_are_read_through_their_index(name: str, variant: str | None, whole: Path, tmp_path: Path) -> None:
    part = LOADERS[name](whole, FP32)
    part.save_pretrained(tmp_path / name, max_shard_size="20KB", variant=variant)
    index = components.weights_file(tmp_path / name, ("diffusion_pytorch_model", "model"))
    assert index.name.endswith(f".safetensors.index{f'.{variant}' if variant else ''}.json")
    read = components.read_tensors(index)
    again = LOADERS[name](tmp_path, FP32).state_dict()
    for key, value in part.state_dict().items():
        assert torch.equal(again[key], value) and torch.equal(read[key], value)


def test_an_index_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    index = tmp_path / "diffusion_pytorch_model.safetensors.index.json"
    for weight_map, message in (
        ({"a": "lost.safetensors"}, "lost.safetensors cannot be read"),
        ({"a": "../other.safetensors"}, "names a shard outside of its folder"),
        (["a"], "cannot be read"),
        ({"a": 1}, "cannot be read"),
    ):
        index.write_text(json.dumps({"weight_map": weight_map}))
        with pytest.raises(BadInput, match=message):
            components.read_tensors(index)


@pytest.mark.parametrize("name", LOADERS)
def test_pickled_tensors_are_read_too(name: str, copy: Path) -> None:
    file = copy / name / FILES[name]
    tensors = load_file(file)
    file.unlink()
    torch.save(
        tensors, copy / name / ("pytorch_model.bin" if name == "image_encoder" else "diffusion_pytorch_model.bin")
    )
    part = LOADERS[name](copy, FP32)
    assert all(torch.equal(part.state_dict()[key], value) for key, value in tensors.items())


@pytest.mark.parametrize("name", LOADERS)
def test_a_missing_file_is_named(name: str, copy: Path) -> None:
    (copy / name / FILES[name]).unlink()
    with pytest.raises(BadInput, match=f"{name} has no tensors; expected one of: .*{FILES[name]}"):
        LOADERS[name](copy, FP32)
    (copy / name / "config.json").unlink()
    with pytest.raises(BadInput, match=f"{name} has no config.json"):
        LOADERS[name](copy, FP32)


@pytest.mark.parametrize("name", LOADERS)
def test_a_damaged_file_is_named(name: str, copy: Path) -> None:
    file = copy / name / FILES[name]
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(BadInput, match=f"{FILES[name]} cannot be read"):
        LOADERS[name](copy, FP32)


@pytest.mark.parametrize("name", LOADERS)
def test_tensors_that_are_missing_or_of_another_shape_are_named(name: str, copy: Path) -> None:
    file = copy / name / FILES[name]
    tensors = load_file(file)
    lost = sorted(tensors)[0]
    kept = {key: value for key, value in tensors.items() if key != lost}
    save_file(kept, file, {"format": "pt"})
    with pytest.raises(BadInput, match=lost.replace(".", r"\.")):
        LOADERS[name](copy, FP32)
    save_file({**kept, lost: torch.zeros(3, 5, 7)}, file, {"format": "pt"})
    with pytest.raises(BadInput, match=FILES[name]):
        LOADERS[name](copy, FP32)


@pytest.mark.parametrize("suffix", ["safetensors", "bin"])
def test_a_linear_layer_is_read_from_either_format(suffix: str, tmp_path: Path) -> None:
    layer = torch.nn.Linear(5, 3)
    tensors = {f"proj.{name}": value.detach() for name, value in layer.named_parameters()}
    file = tmp_path / f"diffusion_pytorch_model.{suffix}"
    save_file(tensors, file) if suffix == "safetensors" else torch.save(tensors, file)
    read = components.read_linear(tmp_path, "proj", FP32)
    given = torch.rand(2, 5)
    assert torch.equal(read(given), layer(given)) and not read.weight.requires_grad
    with pytest.raises(BadInput, match=r"not a linear layer other\.weight"):
        components.read_linear(tmp_path, "other", FP32)


@pytest.mark.parametrize(("content", "named"), [({"a": 1}, "'a'"), ({3: torch.ones(2)}, "3")])
def test_a_pickle_of_more_than_named_tensors_is_refused(
    content: dict[object, object], named: str, tmp_path: Path
) -> None:
    torch.save({"weight": torch.ones(2), **content}, tmp_path / "lora.bin")
    with pytest.raises(BadInput, match=rf"lora\.bin is not a file of named tensors: {named} is not a tensor"):
        components.read_tensors(tmp_path / "lora.bin")


@pytest.mark.parametrize("steps", [*range(1, 41), 142, 143, 166, 334, 400, 500, 900, 999])
def test_a_sampler_starts_near_pure_noise_whatever_its_number_of_steps(steps: int) -> None:
    timesteps = noise_schedule.ddim_timesteps(steps)
    assert len(set(timesteps)) == steps and sorted(timesteps, reverse=True) == list(timesteps)
    assert 901 <= timesteps[0] < 1000 and (timesteps[-1] == 1 or steps == 1)
    assert float(noise_schedule.alphas_cumprod()[timesteps[0]]) < 0.0141


@pytest.mark.parametrize("steps", [20, 30, 50, 143, 334, 400, 500])
@pytest.mark.parametrize("strength", [0.95, 0.5, 0.05])
def test_a_strength_is_that_share_of_the_schedule(steps: int, strength: float) -> None:
    timestep = noise_schedule.ddim_timesteps(steps)[start_index(steps, strength)]
    assert 900 * strength - 1000 / steps <= timestep <= 1000 * strength + 1


def test_a_pickle_that_would_run_code_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "diffusion_pytorch_model.bin"
    torch.save({"proj.weight": tiny_weights.write_scheduler}, file)
    with pytest.raises(BadInput, match="cannot be read"):
        components.read_tensors(file)


def test_a_model_with_another_schedule_is_refused(copy: Path) -> None:
    expected = noise_schedule.read_schedule(copy)
    assert expected == noise_schedule.BetaSchedule(0.00085, 0.012, "scaled_linear", 1000, "epsilon")
    noise_schedule.require_schedule(copy, expected)
    for change in ({"prediction_type": "v_prediction"}, {"beta_end": 0.02}, {"num_train_timesteps": 100}):
        tiny_weights.write_scheduler(copy / "scheduler", **change)
        with pytest.raises(BadInput, match=str(next(iter(change.values())))):
            noise_schedule.require_schedule(copy, expected)
    for change in ({"trained_betas": [0.001] * 1000}, {"rescale_betas_zero_snr": True}):
        tiny_weights.write_scheduler(copy / "scheduler", **change)
        with pytest.raises(BadInput, match=f"{next(iter(change))}=True"):
            noise_schedule.require_schedule(copy, expected)
    tiny_weights.write_scheduler(copy / "scheduler", trained_betas=None, rescale_betas_zero_snr=False)
    noise_schedule.require_schedule(copy, expected)
    (copy / "scheduler" / "scheduler_config.json").write_text(json.dumps({"beta_start": 0.1}))
    with pytest.raises(BadInput, match="not a scheduler"):
        noise_schedule.read_schedule(copy)
    (copy / "scheduler" / "scheduler_config.json").unlink()
    with pytest.raises(BadInput, match="missing"):
        noise_schedule.read_schedule(copy)


@pytest.mark.parametrize("name", LOADERS)
def test_missing_packages_are_named(name: str, whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("diffusers", "transformers"):
        monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(BackendUnavailable, match="run `make setup CUDA=1`"):
        LOADERS[name](whole, FP32)


def test_processors_compute_in_whole_precision() -> None:
    assert components.compute_dtype(CPU, "fp16") == torch.float32
    assert components.compute_dtype(torch.device("cuda"), "fp16") == torch.float16


def test_files_of_older_releases_are_read(copy: Path) -> None:
    """Names of attention layers before diffusers 0.15, and the buffer that CLIP kept before transformers 4.31."""
    old = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}
    vae = copy / "vae" / FILES["vae"]
    tensors = load_file(vae)
    renamed = {}
    for key, value in tensors.items():
        name = key
        for new, former in old.items():
            name = name.replace(f"attentions.0.{new}.", f"attentions.0.{former}.")
        renamed[name] = value
    assert len(renamed.keys() - tensors.keys()) == 16  # four layers of encoder and decoder, weight and bias
    save_file(renamed, vae, {"format": "pt"})
    found = components.load_vae(copy, FP32).state_dict()
    assert all(torch.equal(found[key], value) for key, value in tensors.items())
    clip = copy / "image_encoder" / FILES["image_encoder"]
    tensors = load_file(clip)
    assert "vision_model.embeddings.class_embedding" in tensors and "visual_projection.weight" in tensors
    buffer = {"vision_model.embeddings.position_ids": torch.arange(17)[None]}
    save_file({**tensors, **buffer}, clip, {"format": "pt"})
    found = components.load_image_encoder(copy, FP32).state_dict()
    assert all(torch.equal(found[key], value) for key, value in tensors.items())
