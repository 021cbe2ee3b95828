"""Signing key and certificate from the environment."""

import base64
import hashlib
import os
from pathlib import Path

from dg4d_lib.errors import BadInput

KEY, CERTIFICATE = "DG4D_SIGNING_KEY", "DG4D_SIGNING_CERTIFICATE"


def certificate_digest() -> str | None:
    """Return the SHA-256 of the signer's certificate; None if neither variable is set.

    Raises:
        BadInput: only one of key and certificate is set, or the certificate cannot be read.
    """
    if not os.environ.get(KEY) and not os.environ.get(CERTIFICATE):
        return None
    read_pem(KEY)
    text = read_pem(CERTIFICATE).decode("ascii", "replace")
    body = text.partition("-----BEGIN CERTIFICATE-----")[2].partition("-----END CERTIFICATE-----")[0]
    try:
        content = base64.b64decode("".join(body.split()), validate=True)
    except ValueError:
        content = b""
    if not content:
        raise BadInput(f"${CERTIFICATE} names a file without a certificate in PEM: {os.environ[CERTIFICATE]}")
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def read_pem(name: str) -> bytes:
    """Return the content of the file that an environment variable names."""
    path = os.environ.get(name)
    if not path:
        raise BadInput(f"${name} is not set; ${KEY} and ${CERTIFICATE} go together: set both, or neither")
    try:
        return Path(path).expanduser().read_bytes()
    except OSError as error:
        raise BadInput(f"${name} names {path}, which cannot be read: {error.strerror}") from error
