import re

import pytest

from dg4d_lib.weights.pull import needed
from dg4d_lib.weights.registry import KNOWN, lookup_weights


def test_a_name_and_its_hub_id_mean_the_same() -> None:
    for weights in KNOWN.values():
        assert lookup_weights(weights.name) is weights
        assert lookup_weights(weights.hub_id) is weights
        assert lookup_weights(weights.hub_id.upper()) is weights


def test_pins_are_commits_and_digests_of_files_that_are_needed() -> None:
    for weights in KNOWN.values():
        assert re.fullmatch("[0-9a-f]{40}", weights.revision or "0" * 40)
        assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in weights.published.values())
        assert needed(weights.published, weights.parts) == sorted(weights.published)


def test_what_is_not_verified_is_not_commercial() -> None:
    allowed = {name for name, weights in KNOWN.items() if weights.license.allows_commercial_use}
    assert allowed == {
        *("svd", "svd-xt", "imagedream", "lgm", "vgg16", "lpips-vgg", "birefnet", "birefnet-lite"),
        *("wan2.2-ti2v-5b", "wan2.1-flf2v", "qwen-image-edit-2511", "qwen-image-edit-2509", "qwen-multiple-angles"),
        "depth-anything-v2-small",
    }
    assert lookup_weights("stable-zero123").license.commercial == "no"
    assert not lookup_weights("somebody/something").license.allows_commercial_use


@pytest.mark.parametrize(
    ("card", "commercial"),
    [("mit", "yes"), ("openrail++", "conditions"), ("cc-by-nc-4.0", "no"), ("other", "unverified"), ("", "unverified")],
)
def test_a_model_card_counts_for_weights_that_are_not_known(card: str, commercial: str) -> None:
    its = lookup_weights("somebody/something", card).license
    assert its.commercial == commercial
    assert (card or "unknown") in str(its)


def test_a_model_card_does_not_change_what_is_known() -> None:
    assert lookup_weights("stable-zero123", "mit").license.commercial == "no"


@pytest.mark.parametrize(
    ("copy", "original"),
    [
        ("Somebody/Stable-Zero123-diffusers", "stable-zero123"),
        ("/models/stable_zero123/diffusers", "stable-zero123"),
        ("/models/zero123-xl", "zero123-xl"),
        ("somebody/svd", "svd"),
        ("somebody/stable-video-diffusion-img2vid", "svd"),
    ],
)
def test_a_copy_is_no_freer_than_what_it_is_a_copy_of(copy: str, original: str) -> None:
    copied = lookup_weights(copy, "mit")
    assert copied.license == KNOWN[original].license
    assert copied.hub_id == copy


def test_a_name_or_a_file_frees_no_weights_and_a_name_counts_as_whole_words() -> None:
    assert lookup_weights("somebody/lgm", "cc-by-nc-4.0").license.commercial == "no"
    assert lookup_weights("somebody/lgm").license.commercial == "unverified"
    vgg16 = set(KNOWN["vgg16"].published.values())
    assert lookup_weights("somebody/else", "cc-by-nc-4.0", vgg16).license.commercial == "no"
    for other in ("somebody/zero123", "somebody/svdquant", "somebody/Hi3D"):
        assert lookup_weights(other, "mit").license.name == "mit"


def test_a_copy_is_known_by_its_files_whatever_its_name() -> None:
    published = KNOWN["stable-zero123"].published
    unet = published["unet/diffusion_pytorch_model.safetensors"]
    assert lookup_weights("somebody/views", "mit", {unet}).license == KNOWN["stable-zero123"].license
    shared = published["vae/diffusion_pytorch_model.safetensors"]
    assert lookup_weights("somebody/views", "mit", {shared}).license.name == "mit"
