from pathlib import Path

import pytest

from dg4d_lib.weights.card import card_license


@pytest.mark.parametrize(
    ("card", "license_id"),
    [
        ("---\nlanguage: en\nlicense: Apache-2.0\n---\n# Model\n", "apache-2.0"),
        ("---\nlicense: 'openrail++'\ntags:\n- video\n---\n", "openrail++"),
        ("---\nlicense: other\nlicense_name: nvidia-open-model-license\n---\n", "nvidia-open-model-license"),
        ("---\nlicense: other\n---\n", "other"),
        ("# Model\nlicense: mit\n", ""),
        ("---\nlicense: mit\n", ""),
        ("---\ntags: []\n---\nlicense: mit\n---\n", ""),
        ("", ""),
    ],
)
def test_the_license_is_that_of_the_front_matter_alone(card: str, license_id: str, tmp_path: Path) -> None:
    (tmp_path / "README.md").write_text(card)
    assert card_license(tmp_path) == license_id


def test_a_folder_without_a_readable_card_has_no_license(tmp_path: Path) -> None:
    assert card_license(tmp_path) == ""
    (tmp_path / "README.md").write_bytes(b"---\nlicense: \xff\n---\n")
    assert card_license(tmp_path) == ""
