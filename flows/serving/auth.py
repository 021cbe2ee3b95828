"""Authentication of the background server: its secret, and sessions of browsers that download artifacts.

The secret is Prefect's `PREFECT_SERVER_API_AUTH_STRING`. It allows to run code as the user, so it is kept in a file
that only the user can read, and is never part of an address that a browser sends.
"""

import base64
import hashlib
import hmac
import os
import secrets
import tempfile
import time
from contextlib import suppress
from pathlib import Path

USER = "dg4d"  # Prefect's secret has the form NAME:PASSWORD
SECRET_BYTES = 32
SESSION_S = 12 * 3600  # lifetime of a browser's session; the sign-in page renews it silently


def auth_string(folder: Path) -> str:
    """Read the secret of the server whose state is in `folder`; create it if there is none.

    Args:
        folder: state of the server; the secret is in `folder/auth`, mode 0600.
    """
    path = folder / "auth"
    with suppress(FileNotFoundError):
        path.chmod(0o600)
        if secret := path.read_text(encoding="ascii").strip():
            return secret
        path.unlink()  # empty: the disk was full
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile("w", dir=folder, prefix=".auth-", encoding="ascii") as file:  # mode 0600
        file.write(f"{USER}:{secrets.token_urlsafe(SECRET_BYTES)}")
        file.flush()
        with suppress(FileExistsError):  # another command was faster; all use its secret
            os.link(file.name, path)
    return path.read_text(encoding="ascii").strip()


def basic(secret: str) -> str:
    """Return the value of the header `Authorization` for a secret NAME:PASSWORD."""
    return f"Basic {base64.b64encode(secret.encode()).decode()}"


def is_authorized(header: str | None, secret: str) -> bool:
    """Compare a header `Authorization` with the secret, in constant time."""
    return header is not None and hmac.compare_digest(header.encode(), basic(secret).encode())


class Sessions:
    """Signed, expiring cookies that let a browser read artifacts, and nothing else.

    A browser sends the cookies of a host to every port of that host, so another user's server on this machine may
    see one. It therefore does not contain the secret, and the API does not accept it.

    Args:
        secret: NAME:PASSWORD of the server.
    """

    def __init__(self, secret: str) -> None:
        self._key = hashlib.sha256(b"dg4d artifacts\0" + secret.encode()).digest()

    @property
    def cookie(self) -> str:
        """Name of the cookie; servers on other ports have other names."""
        return f"dg4d-{self._sign('name')[:12]}"

    def issue(self, now: float | None = None) -> str:
        """Return the value of a cookie that is valid for `SESSION_S` seconds."""
        expires = int((time.time() if now is None else now) + SESSION_S)
        return f"{expires}.{self._sign(str(expires))}"

    def is_valid(self, value: str | None, now: float | None = None) -> bool:
        """Check signature and expiry of a cookie."""
        expires, _, signature = (value or "").partition(".")
        if not hmac.compare_digest(signature.encode(), self._sign(expires).encode()):
            return False
        return int(expires) > (time.time() if now is None else now)

    def _sign(self, text: str) -> str:
        return hmac.new(self._key, text.encode(), hashlib.sha256).hexdigest()
