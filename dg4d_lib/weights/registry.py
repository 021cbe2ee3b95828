"""The weights that profiles and scores name: where they come from, what of them is needed, what their license allows.

Revisions and digests are not written here: the first `dg4d weights pull` records what it got (trust on first use, see
lock.py), and every later use is compared with that. `revision` pins a commit of the hub where one must not change.
"""

from dataclasses import dataclass
from typing import Literal

Commercial = Literal["yes", "conditions", "no", "unverified"]


@dataclass(frozen=True)
class License:
    """What may be done with weights, and with what they make.

    Attributes:
        name: as its owner calls it.
        commercial: "conditions": allowed under the conditions in `terms`; "unverified" is treated as "no".
        terms: one sentence for people.
    """

    name: str
    commercial: Commercial
    terms: str

    @property
    def allows_commercial_use(self) -> bool:
        """Whether `--commercial-only` lets it pass."""
        return self.commercial in ("yes", "conditions")

    def __str__(self) -> str:
        return f"{self.name}: {self.terms}"


@dataclass(frozen=True)
class Weights:
    """One set of weights on the Hugging Face hub.

    Attributes:
        name: what settings and commands call it.
        hub_id: owner and repository.
        purpose: what it is for.
        license: of the weights, not of the code around them.
        parts: folders (of a model in diffusers' layout) or single files that are needed; empty: all of the repository.
        revision: a commit or tag of the hub; None: the newest at the first pull, which the lock then remembers.
        about_gb: size of the download in units of 1e9 bytes as far as it is known without asking the hub.
    """

    name: str
    hub_id: str
    purpose: str
    license: License
    parts: tuple[str, ...] = ()
    revision: str | None = None
    about_gb: float | None = None


STABILITY_RESEARCH = License(
    "Stability AI Non-Commercial Research Community License",
    "no",
    "for research and other non-commercial use only",
)
STABILITY_COMMUNITY = License(
    "Stability AI Community License",
    "conditions",
    "commercial use is free below one million US dollars of yearly revenue, with registration and attribution; above, "
    "it takes an enterprise license (https://stability.ai/license)",
)
UNVERIFIED = "no statement of the authors on commercial use was found; read the model card before you use the weights"

ZERO123_PARTS = ("vae", "unet", "image_encoder", "clip_camera_projection", "scheduler")
SVD_PARTS = ("vae", "unet", "image_encoder", "scheduler")

KNOWN: dict[str, Weights] = {
    weights.name: weights
    for weights in (
        Weights(
            name="zero123-xl",
            hub_id="ashawkey/zero123-xl-diffusers",
            purpose="prior: other sides (Zero-1-to-3-XL)",
            license=License("license of Zero-1-to-3-XL", "unverified", UNVERIFIED),
            parts=ZERO123_PARTS,
        ),
        Weights(
            name="stable-zero123",
            hub_id="ashawkey/stable-zero123-diffusers",
            purpose="prior: other sides (Stable-Zero123)",
            license=STABILITY_RESEARCH,
            parts=ZERO123_PARTS,
        ),
        Weights(
            name="svd",
            hub_id="stabilityai/stable-video-diffusion-img2vid",
            purpose="motions of 14 frames, textures",
            license=STABILITY_COMMUNITY,
            parts=SVD_PARTS,
            about_gb=4.5,
        ),
        Weights(
            name="svd-xt",
            hub_id="stabilityai/stable-video-diffusion-img2vid-xt",
            purpose="motions of 25 frames",
            license=STABILITY_COMMUNITY,
            parts=SVD_PARTS,
            about_gb=4.5,
        ),
        Weights(
            name="imagedream",
            hub_id="ashawkey/imagedream-ipmv-diffusers",
            purpose="four views of an object, for LGM",
            license=License("license of ImageDream", "unverified", UNVERIFIED),
            about_gb=4.0,
        ),
        Weights(
            name="lgm",
            hub_id="ashawkey/LGM",
            purpose="Gaussians out of four views",
            license=License("license of LGM", "unverified", UNVERIFIED),
            parts=("model_fp16_fixrot.safetensors",),
            about_gb=0.83,
        ),
        Weights(
            name="vgg16",
            hub_id="timm/vgg16.tv_in1k",
            purpose="scores: the network of LPIPS (torchvision's VGG16)",
            license=License("BSD-3-Clause", "yes", "commercial use is allowed; trained on ImageNet"),
            parts=("model.safetensors",),
            about_gb=0.55,
        ),
        Weights(
            name="lpips-vgg",
            hub_id="chaofengc/IQA-PyTorch-Weights",
            purpose="scores: LPIPS on top of vgg16 (7 kB)",
            license=License("BSD-2-Clause", "yes", "commercial use is allowed; vgg.pth of the package lpips"),
            parts=("LPIPS_v0.1_vgg-a78928a0.pth",),
        ),
        Weights(
            name="clip-vit-b-32",
            hub_id="openai/clip-vit-base-patch32",
            purpose="scores: CLIP similarity",
            license=License("license of CLIP's weights", "unverified", UNVERIFIED),
        ),
        Weights(
            name="i3d",
            hub_id="flateon/FVD-I3D-torchscript",
            purpose="scores: FVD",
            license=License("license of I3D's weights", "unverified", UNVERIFIED),
            parts=("i3d_torchscript.pt",),
        ),
    )
}


ON_CARDS: dict[str, Commercial] = {
    **dict.fromkeys(("apache-2.0", "mit", "bsd-3-clause", "cc0-1.0", "cc-by-4.0"), "yes"),
    **dict.fromkeys(("openrail", "openrail++", "creativeml-openrail-m", "bigscience-openrail-m"), "conditions"),
    **dict.fromkeys(("cc-by-nc-4.0", "cc-by-nc-sa-4.0", "cc-by-nc-nd-4.0"), "no"),
}  # what model cards of the hub call licenses
TERMS: dict[Commercial, str] = {
    "yes": "commercial use is allowed",
    "conditions": "commercial use is allowed, but not for the purposes that the license lists",
    "no": "for non-commercial use only",
    "unverified": "read the license of these weights before you use them",
}


def weights_called(name: str, card: str = "") -> Weights:
    """The weights of a name or a hub id.

    Args:
        name: as a user wrote it.
        card: what the model card calls the license; it counts for weights that are not known here.
    """
    by_id = {weights.hub_id.lower(): weights for weights in KNOWN.values()}
    commercial = ON_CARDS.get(card, "unverified")
    theirs = License(card or "unknown license", commercial, TERMS[commercial])
    return KNOWN.get(name) or by_id.get(name.lower()) or Weights(name, name, "named by the user", theirs)
