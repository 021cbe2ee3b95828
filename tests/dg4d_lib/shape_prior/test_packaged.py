"""Shipped weights of the shape prior: missing, damaged and loaded once."""

import hashlib
from pathlib import Path

import pytest
from tiny_shape_prior import tiny_network

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.shape_prior import packaged
from dg4d_lib.shape_prior.network import save_network


@pytest.fixture
def shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "weights.safetensors"
    save_network(tiny_network(), path)
    monkeypatch.setattr(packaged, "WEIGHTS", path)
    monkeypatch.setattr(packaged, "SHA256", hashlib.sha256(path.read_bytes()).hexdigest())
    packaged.packaged_network.cache_clear()
    return path


def test_shipped_weights_are_read_once(shipped: Path) -> None:
    network = packaged.packaged_network()
    shipped.unlink()
    assert packaged.packaged_network() is network and not network.training


def test_missing_weights_are_named_with_a_way_out(shipped: Path) -> None:
    shipped.unlink()
    with pytest.raises(BackendUnavailable, match=r"missing: .*weights\.safetensors.*prior\.kind=geometric"):
        packaged.packaged_network()


def test_other_weights_are_refused(shipped: Path) -> None:
    save_network(tiny_network(1), shipped)
    with pytest.raises(BadInput, match="Digest mismatch"):
        packaged.packaged_network()


def test_records_get_the_digest_of_the_file(shipped: Path) -> None:
    digest = hashlib.sha256(shipped.read_bytes()).hexdigest()
    assert packaged.digests() == {"shape-prior/weights.safetensors": f"sha256:{digest}"}
