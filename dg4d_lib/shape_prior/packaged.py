"""Weights of the shape prior that the package ships, read once per process."""

import functools
import hashlib
from pathlib import Path

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.shape_prior.network import ShapePriorNetwork, load_network

NAME = "shape-prior"
LICENSE = "Apache-2.0"
WEIGHTS = Path(__file__).with_name("weights.safetensors")
SHA256 = "fa07f759220e937c2b878a3299fd0f492eb2ca9995a44975e5ba1cf2a5a6e66e"


@functools.cache
def packaged_network() -> ShapePriorNetwork:
    """Load the shipped network.

    Raises:
        BackendUnavailable: the file is missing.
        BadInput: the file is not the one of this version.
    """
    try:
        found = hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()
    except FileNotFoundError:
        raise BackendUnavailable(
            f"The weights of the shape prior are missing: {WEIGHTS}. Install a version of dg4d that has them, or use "
            "--set prior.kind=geometric."
        ) from None
    if found != SHA256:
        raise BadInput(
            f"Digest mismatch in {WEIGHTS}: recorded {SHA256[:12]}, found {found[:12]}. Install dg4d again, or use "
            "--set prior.kind=geometric."
        )
    return load_network(WEIGHTS)


def digests() -> dict[str, str]:
    """Return the digest of the shipped weights by name, as provenance records hold it."""
    return {f"{NAME}/{WEIGHTS.name}": f"sha256:{SHA256}"}
