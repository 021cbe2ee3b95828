"""Registry of the weights that profiles and scores use: source, needed files, digests and license.

`revision` pins a commit of the hub; `published` holds the digests of tensor files at that commit, where public records
have them. The first `dg4d weights pull` compares its download with them and records every digest (lock.py); every later
use is compared with that record. Files without a public digest are trusted on first use.
"""

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Literal

Commercial = Literal["yes", "conditions", "no", "unverified"]


@dataclass(frozen=True)
class License:
    """License of weights, and of the assets made with them.

    Attributes:
        name: given by its owner.
        commercial: "conditions": allowed under the conditions in `terms`; "unverified" is treated as "no".
        terms: one sentence for users.
    """

    name: str
    commercial: Commercial
    terms: str

    @property
    def allows_commercial_use(self) -> bool:
        """True if `--commercial-only` accepts it."""
        return self.commercial in ("yes", "conditions")

    def __str__(self) -> str:
        return f"{self.name}: {self.terms}"


@dataclass(frozen=True)
class Weights:
    """Weights of one model on the Hugging Face hub.

    Attributes:
        name: in settings and commands.
        hub_id: owner and repository.
        purpose: shown by `dg4d weights list`.
        license: of the weights, not of the code around them.
        parts: needed folders (of a model in diffusers' layout) or single files; empty: the whole repository.
        revision: commit on the hub; None: the newest at the first pull, which the lock then records.
        published: sha256 of tensor files at that commit, by path, where known.
        about_gb: approximate size of the download, units of 1e9 bytes; None: unknown.
        flow_matching: True for models that predict velocities of flow matching; no prior can be made of them.
    """

    name: str
    hub_id: str
    purpose: str
    license: License
    parts: tuple[str, ...] = ()
    revision: str | None = None
    published: Mapping[str, str] = field(default_factory=dict)
    about_gb: float | None = None
    flow_matching: bool = False


STABILITY_RESEARCH = License(
    "Stability AI Non-Commercial Research Community License",
    "no",
    "for research and other non-commercial use only",
)
STABILITY_COMMUNITY = License(
    "Stability AI Community License",
    "conditions",
    "commercial use is free up to one million US dollars of yearly revenue, affiliates included, with registration and "
    '"Powered by Stability AI" in sight; above, it takes an enterprise license (https://stability.ai/license)',
)

CARD_LICENSES: dict[str, Commercial] = {
    **dict.fromkeys(("apache-2.0", "mit", "bsd-3-clause", "cc0-1.0", "cc-by-4.0"), "yes"),
    **dict.fromkeys(("openrail", "openrail++", "creativeml-openrail-m", "bigscience-openrail-m"), "conditions"),
    **dict.fromkeys(("cc-by-nc-4.0", "cc-by-nc-sa-4.0", "cc-by-nc-nd-4.0"), "no"),
}  # license ids on model cards of the hub
STRICTNESS: tuple[Commercial, ...] = ("yes", "conditions", "unverified", "no")  # strictest last
REUSED_PARTS = ("vae/", "text_encoder/", "image_encoder/")  # many models share these files; they identify none
TERMS: dict[Commercial, str] = {
    "yes": "commercial use is allowed",
    "conditions": "commercial use is allowed, but not for the purposes that the license lists",
    "no": "for non-commercial use only",
    "unverified": "read the license of these weights before you use them",
}

ZERO123_PARTS = ("vae", "unet", "image_encoder", "clip_camera_projection", "scheduler")
SVD_PARTS = ("vae", "unet", "image_encoder", "scheduler")
SEGMENTATION_PARTS = ("onnx/model.onnx", "preprocessor_config.json")  # without the variants of lower precision
SD_VAE = "3e4c08995484ee61270175e9e7a072b66a6e4eeb5f0c266667fe1f45b90daf9a"  # Stable Diffusion's VAE, half precision
SVD_SHARED = {
    "vae/diffusion_pytorch_model.fp16.safetensors": "af602cd0eb4ad6086ec94fbf1438dfb1be5ec9ac03fd0215640854e90d6463a3",
    "image_encoder/model.fp16.safetensors": "ae616c24393dd1854372b0639e5541666f7521cbe219669255e865cb7f89466a",
}  # the same files in the variants for 14 and for 25 frames
APACHE_CARD = License(
    "Apache-2.0",
    "yes",
    "commercial use is allowed according to quotations of its card; read the card before commercial use",
)
WAN_PARTS = ("vae", "text_encoder", "tokenizer", "transformer", "scheduler", "model_index.json")
OPEN_MODELS = (
    Weights(
        name="wan2.2-ti2v-5b",
        hub_id="Wan-AI/Wan2.2-TI2V-5B-Diffusers",
        purpose="driving videos: driving.kind=diffusers (Wan 2.2, 5B)",
        license=APACHE_CARD,
        parts=WAN_PARTS,
        revision="b8fff7315c768468a5333511427288870b2e9635",
        about_gb=34.2,
        flow_matching=True,
    ),
    Weights(
        name="wan2.1-flf2v",
        hub_id="Wan-AI/Wan2.1-FLF2V-14B-720P-diffusers",
        purpose="looping driving videos: driving.kind=diffusers, driving.loop=true (Wan 2.1, 14B)",
        license=APACHE_CARD,
        parts=(*WAN_PARTS, "image_encoder", "image_processor"),
        flow_matching=True,
    ),
    Weights(
        name="ltx-video",
        hub_id="Lightricks/LTX-Video",
        purpose="driving videos on small GPUs: driving.kind=diffusers (LTX-Video, 2B)",
        license=License(
            "LTXV Open Weights License",
            "unverified",
            "the terms differ between versions of this model and depend on yearly revenue; read the text in its "
            "repository before any commercial use",
        ),
        parts=WAN_PARTS,
        revision="8984fa25007f376c1a299016d0957a37a2f797bb",
        flow_matching=True,
    ),
    Weights(
        name="qwen-image-edit-2511",
        hub_id="Qwen/Qwen-Image-Edit-2511",
        purpose="views of other sides: views.kind=image_edit (Qwen-Image-Edit, 20B)",
        license=APACHE_CARD,
        revision="6f3ccc0b56e431dc6a0c2b2039706d7d26f22cb9",
        about_gb=57.7,
        flow_matching=True,
    ),
    Weights(
        name="qwen-image-edit-2509",
        hub_id="Qwen/Qwen-Image-Edit-2509",
        purpose="views of other sides, earlier version (Qwen-Image-Edit, 20B)",
        license=APACHE_CARD,
        revision="d3968ef930e841f4c73640fb8afa3b306a78167e",
        about_gb=57.7,
        flow_matching=True,
    ),
    Weights(
        name="qwen-multiple-angles",
        hub_id="fal/Qwen-Image-Edit-2511-Multiple-Angles-LoRA",
        purpose="LoRA for camera angles: views.lora_weights",
        license=License("Apache-2.0", "yes", "commercial use is allowed; so says its card"),
        parts=("qwen-image-edit-2511-multiple-angles-lora.safetensors",),
    ),
    Weights(
        name="depth-anything-v2-small",
        hub_id="depth-anything/Depth-Anything-V2-Small-hf",
        purpose="depth as a hint for the geometric prior: prior.depth_weights (25M)",
        license=License("Apache-2.0", "yes", "commercial use is allowed; so says its card, for the small model alone"),
        revision="5426e4f0f36572d16453bbda7a8389317b1bef99",
        about_gb=0.1,
    ),
)  # sizes from parameter counts and stored precisions; unpinned entries take the newest commit at the first pull

KNOWN: dict[str, Weights] = {
    weights.name: weights
    for weights in (
        *OPEN_MODELS,
        Weights(
            name="zero123-xl",
            hub_id="ashawkey/zero123-xl-diffusers",
            purpose="prior: novel views (Zero-1-to-3-XL)",
            license=License(
                "MIT on its card",
                "unverified",
                "the card says MIT, but the authors of Zero-1-to-3 call the model intended for research only, and it "
                "was fine-tuned from one under CreativeML OpenRAIL-M; ask them before any commercial use",
            ),
            parts=ZERO123_PARTS,
            revision="10e9e8e75adaa3bf77f5ac9c381419016fed68c7",
            about_gb=2.5,
        ),
        Weights(
            name="stable-zero123",
            hub_id="ashawkey/stable-zero123-diffusers",
            purpose="prior: novel views (Stable-Zero123)",
            license=STABILITY_RESEARCH,
            parts=ZERO123_PARTS,
            revision="a6c09344fbd45843d35f2095c203c4a8e55b4dbb",
            published={
                "unet/diffusion_pytorch_model.safetensors": (
                    "df42cdcac55d5b89c15a0512845db20a6213f1eaa129f201dfc080fc8642d220"
                ),
                "vae/diffusion_pytorch_model.safetensors": SD_VAE,
                "clip_camera_projection/diffusion_pytorch_model.safetensors": (
                    "0cb292c6da02a0d8866c4378cd6053e097c7a6bdf0886cc4ac1fba2bda3af6f0"
                ),
            },
            about_gb=2.5,
        ),
        Weights(
            name="svd",
            hub_id="stabilityai/stable-video-diffusion-img2vid",
            purpose="driving videos of 14 frames, texture refinement",
            license=STABILITY_COMMUNITY,
            parts=SVD_PARTS,
            revision="9cf024d5bfa8f56622af86c884f26a52f6676f2e",
            published={
                "unet/diffusion_pytorch_model.fp16.safetensors": (
                    "cb552818963e736506c6693ffc279d59df423d63aced38902ea4373ab1fd2932"
                ),
                **SVD_SHARED,
            },
            about_gb=4.5,
        ),
        Weights(
            name="svd-xt",
            hub_id="stabilityai/stable-video-diffusion-img2vid-xt",
            purpose="driving videos of 25 frames",
            license=STABILITY_COMMUNITY,
            parts=SVD_PARTS,
            revision="9e43909513c6714f1bc78bcb44d96e733cd242aa",
            published={
                "unet/diffusion_pytorch_model.fp16.safetensors": (
                    "9fbc02e90f37d422f5e3a4aeaee95f6629dc8c45ca211b951626e930daf2bddf"
                ),
                **SVD_SHARED,
            },
            about_gb=4.5,
        ),
        Weights(
            name="imagedream",
            hub_id="ashawkey/imagedream-ipmv-diffusers",
            purpose="four views of an object, for LGM; prior",
            license=License("OpenRAIL", "conditions", TERMS["conditions"]),
            revision="73a034178e748421506492e91790cc62d6aefef5",
            published={
                "unet/diffusion_pytorch_model.safetensors": (
                    "28d8b241a54125fa0a041c1818a5dcdb717e6f5270eea1268172acd3ab0238e0"
                ),
                "vae/diffusion_pytorch_model.safetensors": SD_VAE,
                "text_encoder/model.safetensors": "bc1827c465450322616f06dea41596eac7d493f4e95904dcb51f0fc745c4e13f",
                "image_encoder/model.safetensors": "2a56cfd4ffcf40be097c430324ec184cc37187f6dafef128ef9225438a3c03c4",
            },
            about_gb=4.0,
        ),
        Weights(
            name="lgm",
            hub_id="ashawkey/LGM",
            purpose="Gaussians from four views",
            license=License("MIT", "yes", "commercial use is allowed; trained on objects of Objaverse"),
            parts=("model_fp16_fixrot.safetensors",),
            revision="1c28a2fd3bb1982414f722503ae862bdbb82636c",
            published={
                "model_fp16_fixrot.safetensors": "744d6324656342c64f871308e73db97f0eb51858d94329b30090e986a6d050ab"
            },
            about_gb=0.83,
        ),
        Weights(
            name="birefnet",
            hub_id="onnx-community/BiRefNet-ONNX",
            purpose="cut-outs: subject.matting=birefnet (BiRefNet)",
            license=License("MIT", "yes", TERMS["yes"]),
            parts=SEGMENTATION_PARTS,
            about_gb=0.97,
        ),
        Weights(
            name="birefnet-lite",
            hub_id="onnx-community/BiRefNet_lite-ONNX",
            purpose="cut-outs: subject.matting=birefnet-lite (BiRefNet, smaller)",
            license=License("MIT", "yes", TERMS["yes"]),
            parts=SEGMENTATION_PARTS,
            about_gb=0.22,
        ),
        Weights(
            name="isnet",
            hub_id="onnx-community/ISNet-ONNX",
            purpose="cut-outs: subject.matting=isnet (IS-Net)",
            license=License(
                "AGPL-3.0 on its card",
                "unverified",
                "the card of this export says AGPL-3.0, while the authors of IS-Net released their weights under "
                "Apache-2.0; read both before any commercial use",
            ),
            parts=SEGMENTATION_PARTS,
            revision="3fe6e3db3e32c69aadde61fe388ddb1a0574440c",
            about_gb=0.18,
        ),
        Weights(
            name="vgg16",
            hub_id="timm/vgg16.tv_in1k",
            purpose="scores: the network of LPIPS (torchvision's VGG16)",
            license=License("BSD-3-Clause", "yes", "commercial use is allowed; trained on ImageNet"),
            parts=("model.safetensors",),
            revision="b8d8aa2dd860af9233c8c67385a8097fd6c35d3f",
            published={"model.safetensors": "57b026918159a6bf9faf8405c3a551903768e7138989d9c6224a14227203fad8"},
            about_gb=0.55,
        ),
        Weights(
            name="lpips-vgg",
            hub_id="chaofengc/IQA-PyTorch-Weights",
            purpose="scores: LPIPS on top of vgg16 (7 kB)",
            license=License(
                "BSD-2-Clause",
                "yes",
                "commercial use is allowed; byte for byte vgg.pth of the package lpips, though the card of the hub's "
                "repository says CC BY-NC-SA 4.0",
            ),
            parts=("LPIPS_v0.1_vgg-a78928a0.pth",),
            revision="e03d58097b4b231515f900fa8006a2168becc745",
            published={
                "LPIPS_v0.1_vgg-a78928a0.pth": "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"
            },
        ),
        Weights(
            name="clip-vit-b-32",
            hub_id="openai/clip-vit-base-patch32",
            purpose="scores: CLIP similarity",
            license=License(
                "none stated",
                "unverified",
                "the code is under MIT; of the weights, OpenAI's card says only that any deployed use is out of scope",
            ),
            revision="3d74acf9a28c67741b2f4f2ea7635f0aaf6f0268",
            published={"pytorch_model.bin": "a63082132ba4f97a80bea76823f544493bffa8082296d62d71581a4feff1576f"},
            about_gb=0.61,
        ),
        Weights(
            name="i3d",
            hub_id="flateon/FVD-I3D-torchscript",
            purpose="scores: FVD",
            license=License(
                "none stated",
                "unverified",
                "this copy states no license; DeepMind released the original checkpoints under Apache-2.0",
            ),
            parts=("i3d_torchscript.pt",),
            published={"i3d_torchscript.pt": "bec6519f66ea534e953026b4ae2c65553c17bf105611c746d904657e5860a5e2"},
            about_gb=0.05,
        ),
    )
}


def lookup_weights(name: str, card: str = "", digests: Collection[str] = ()) -> Weights:
    """Return the registered weights of a name or a hub id, or an entry for unknown ones.

    Args:
        name: from the user; or the path of a folder.
        card: license id on the model card, used for unknown weights.
        digests: sha256 of their files, where known; used for unknown weights.
    """
    by_id = {weights.hub_id.lower(): weights for weights in KNOWN.values()}
    known = KNOWN.get(name) or by_id.get(name.lower())
    return known or Weights(name, name, "given by the user", _license_of_unknown(name, card, digests))


def _license_of_unknown(name: str, card: str, digests: Collection[str]) -> License:
    """Return the strictest license: of the card, and of registered weights that share the name or a file."""
    commercial = CARD_LICENSES.get(card, "unverified")
    of_card = License(card or "unknown license", commercial, TERMS[commercial])
    copied = [one.license for one in KNOWN.values() if _names(one, name) or _own_digests(one) & set(digests)]
    return max((*copied, of_card), key=lambda one: STRICTNESS.index(one.commercial))


def _own_digests(weights: Weights) -> set[str]:
    return {digest for path, digest in weights.published.items() if not path.startswith(REUSED_PARTS)}


def _names(weights: Weights, name: str) -> bool:
    """Return True if a name has that of registered weights, or of their repository, as whole words."""
    repository = weights.hub_id.rpartition("/")[2]
    return any(_words(one) in _words(name) for one in (weights.name, repository))


def _words(name: str) -> str:
    return "-" + re.sub(r"[\W_]+", "-", name.lower()) + "-"
