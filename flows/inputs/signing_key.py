"""Key and certificate with which packages are signed, as the environment names them."""

import base64
import hashlib
import os
from pathlib import Path

from dg4d_lib.errors import BadInput

KEY, CERTIFICATE = "DG4D_SIGNING_KEY", "DG4D_SIGNING_CERTIFICATE"


def certificate() -> str | None:
    """Return the SHA-256 of the configured certificate, which stands for the signer; None if nobody signs.

    Raises:
        BadInput: only one of key and certificate is named, or the certificate cannot be read.
    """
    if not os.environ.get(KEY) and not os.environ.get(CERTIFICATE):
        return None
    pem(KEY)
    text = pem(CERTIFICATE).decode("ascii", "replace")
    body = text.partition("-----BEGIN CERTIFICATE-----")[2].partition("-----END CERTIFICATE-----")[0]
    try:
        content = base64.b64decode("".join(body.split()), validate=True)
    except ValueError:
        content = b""
    if not content:
        raise BadInput(f"${CERTIFICATE} names a file without a certificate in PEM: {os.environ[CERTIFICATE]}")
    return f"sha256:{hashlib.sha256(content).hexdigest()}"


def pem(name: str) -> bytes:
    """Return the content of the file that an environment variable names."""
    place = os.environ.get(name)
    if not place:
        raise BadInput(f"${KEY} and ${CERTIFICATE} go together, and ${name} is not set; set both, or neither")
    try:
        return Path(place).expanduser().read_bytes()
    except OSError as error:
        raise BadInput(f"${name} names {place}, which cannot be read: {error.strerror}") from error
