import shutil
from pathlib import Path

import pytest
import torch
from tiny_qwen_edit import save_tiny_qwen_image
from tiny_text_to_image import save_pipeline

from dg4d_lib.diffusion.flop_counter import count_flops
from dg4d_lib.diffusion.text_to_image import draw_picture
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.input_settings import TextSettings

CPU = torch.device("cpu")
QUICK = TextSettings(size=48, num_inference_steps=3)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_pipeline(tmp_path_factory.mktemp("models") / "tiny")


def draw(model: Path, text: str = "a red dragon", seed: int = 0, **changes: object) -> torch.Tensor:
    settings = TextSettings.model_validate({**QUICK.model_dump(), **changes})
    return draw_picture(model, text, settings, torch.Generator().manual_seed(seed), CPU)


def test_equal_words_and_seeds_give_equal_pictures_and_others_do_not(model: Path) -> None:
    picture = draw(model)
    assert picture.shape == (48, 48, 3)
    assert picture.dtype == torch.float32
    assert 0 <= picture.min() < picture.max() <= 1
    assert torch.equal(picture, draw(model))
    for other in (
        draw(model, seed=1),
        draw(model, "a blue newt"),
        draw(model, suffix=" in the red"),
        draw(model, num_inference_steps=2),
        draw(model, guidance_scale=1.0),
    ):
        assert not torch.equal(picture, other)


def test_a_vae_that_keeps_state_and_true_guidance_are_taken(tmp_path: Path) -> None:
    model = save_tiny_qwen_image(tmp_path)
    plain = draw(model, size=32)
    with count_flops() as flops:
        assert torch.equal(draw(model, size=32), plain)
    assert flops["QwenImageTransformer2DModel"] > 1e4
    assert not torch.equal(draw(model, size=32, guidance_scale=20.0), plain)


def test_what_the_pipeline_refuses_is_bad_input(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from diffusers import StableDiffusionPipeline

    def refuse(*given: object, **named: object) -> None:
        raise ValueError("`height` and `width` have to be divisible by 16")

    monkeypatch.setattr(StableDiffusionPipeline, "check_inputs", refuse)
    with pytest.raises(BadInput, match=r"StableDiffusionPipeline .* refused its input: .* divisible by 16"):
        draw(model)


def test_the_suffix_is_part_of_the_words(model: Path) -> None:
    assert torch.equal(draw(model, "a red", suffix=" dragon"), draw(model, "a red dragon", suffix=""))


def test_every_step_is_told(model: Path) -> None:
    told: list[tuple[int, int]] = []
    generator = torch.Generator().manual_seed(0)
    draw_picture(model, "a newt", QUICK, generator, CPU, lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_with_little_memory_networks_wait_beside_the_gpu_and_draw_the_same(
    model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The processor stands for the GPU: networks get diffusers' real hooks, which send them to it one by one."""
    from diffusers import DiffusionPipeline

    offload, asked = DiffusionPipeline.enable_model_cpu_offload, []

    def to_the_processor(pipeline: DiffusionPipeline, device: torch.device) -> None:
        asked.append(str(device))
        offload(pipeline, device="cpu")
        assert len(pipeline._all_hooks) == 3  # of words, of noise, of pixels

    monkeypatch.setattr(DiffusionPipeline, "enable_model_cpu_offload", to_the_processor)
    settings = QUICK.model_copy(update={"low_memory": True, "precision": "fp32"})
    generator = torch.Generator().manual_seed(0)
    picture = draw_picture(model, "a red dragon", settings, generator, torch.device("cuda"))
    assert asked.pop(0) == "cuda" and asked == ["cpu:0"]  # the pipeline itself sends away the last network
    assert torch.equal(picture, draw(model))
    assert torch.equal(picture, draw(model, low_memory=True)) and len(asked) == 1  # without a GPU there is no other way


@pytest.mark.slow
def test_files_in_half_precision_are_read_and_draw_the_same_up_to_their_rounding(model: Path, tmp_path: Path) -> None:
    from diffusers import StableDiffusionPipeline

    half = StableDiffusionPipeline.from_pretrained(model, dtype=torch.float16)
    half.save_pretrained(tmp_path / "half", variant="fp16")
    assert list(tmp_path.rglob("*.fp16.safetensors"))
    difference = (draw(tmp_path / "half") - draw(model)).abs()
    assert 0 < difference.max() < 0.02  # half precision keeps 11 bits


def test_a_picture_that_is_no_numbers_is_refused(model: Path, tmp_path: Path) -> None:
    from safetensors.torch import load_file, save_file

    broken = shutil.copytree(model, tmp_path / "broken")
    file = broken / "vae" / "diffusion_pytorch_model.safetensors"
    save_file({name: value * torch.nan for name, value in load_file(file).items()}, file)
    with pytest.raises(BadInput, match=r"text\.precision=fp32"):
        draw(broken)


def test_what_is_no_pipeline_of_pictures_is_refused(model: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"no model_index\.json"):
        draw(tmp_path)
    damaged = shutil.copytree(model, tmp_path / "damaged")
    (damaged / "unet" / "diffusion_pytorch_model.safetensors").write_bytes(b"not tensors")
    with pytest.raises(BadInput, match="cannot be read"):
        draw(damaged)
    other = shutil.copytree(model, tmp_path / "other")
    index = other / "model_index.json"
    index.write_text(index.read_text().replace('"StableDiffusionPipeline"', '"StableDiffusionImg2ImgPipeline"'))
    with pytest.raises(BadInput, match=r"StableDiffusionImg2ImgPipeline .* is not a text-to-image pipeline"):
        draw(other)


def test_without_diffusers_the_extra_is_named(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "diffusers", None)
    with pytest.raises(BackendUnavailable, match="run `make setup CUDA=1`"):
        draw(model)
