"""Temporary local copies of source files from web servers and object stores.

Web servers are reached directly: a proxy would resolve host names itself, after they were checked.
"""

import base64
import http.client
import socket
import ssl
import tempfile
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path, PurePosixPath
from urllib.parse import SplitResult, quote, unquote, urljoin, urlsplit

from dg4d_lib.errors import BadInput
from flows.inputs import hosts, listing
from flows.inputs.naming import name_from_path
from flows.inputs.sources import LARGEST_FILE_BYTES
from steps.sources.media_types import SNIFFED_BYTES, check_head
from steps.store.files import NO_SPACE, room_for

ANSWER_S = 60.0  # seconds to connect, and for each read
FETCH_S = 600.0  # seconds for a whole file, with every redirect
MOST_REDIRECTS = 5
REDIRECTS = {301, 302, 303, 307, 308}
CHUNK = 1 << 20  # bytes
SCHEMES = {"http": 80, "https": 443}
LONGEST_NAME = 255  # bytes of a file name
UNQUOTED = "/%:@!$&'()*+,;=~"  # RFC 3986, section 3.3


@contextmanager
def local_copy(address: str) -> Iterator[Path]:
    """Yield a local path of the file at an address; a downloaded copy is removed afterwards.

    Args:
        address: a path; `https://...` or `http://...`; or `s3://BUCKET/KEY`, with the usual AWS_* variables.

    Raises:
        BadInput: the file does not exist, is too large or is not a picture or video, its host is private, or the
            scheme is not supported.
        BackendUnavailable: the object store refuses access, or does not answer.
    """
    if "://" not in address:
        yield Path(address)
        return
    shown = without_secrets(address)
    parts = _split(address)
    name = _file_name(parts, address)
    fits = bool(name) and "\0" not in name and len(name.encode(errors="replace")) <= LONGEST_NAME
    if parts.scheme not in {*SCHEMES, "s3"} or not parts.hostname or not fits:
        raise BadInput(f"{shown} names no file: give a path, https://HOST/FILE or s3://BUCKET/KEY")
    if parts.scheme == "s3":
        folder, _, key = address.rpartition("/")
        with listing.fetch_object(folder, key, name) as path:
            yield path
        return
    with tempfile.TemporaryDirectory(prefix="dg4d-fetched-") as scratch, room_for(Path(scratch)):
        path = Path(scratch) / name
        _Download().fetch(address, path)
        yield path


def item_name(address: str) -> str:
    """Return the name that the file, or the local folder of frames, at an address gives its asset.

    Raises:
        BadInput: the address is invalid.
    """
    if "://" not in address:
        return name_from_path(Path(address))
    return name_from_path(PurePosixPath(_file_name(_split(address), address)))


def without_secrets(address: str) -> str:
    """Return an address without its password and its signature, for messages."""
    if "://" not in address:
        return address
    try:
        parts = _split(address)
    except BadInput:
        return "an invalid address"
    return f"{parts.scheme}://{parts.hostname}{parts.path}"


class _Download:
    """Download of one file, which ends after `FETCH_S` seconds at the latest."""

    def __init__(self) -> None:
        self._late = threading.Event()
        self._connection: _Checked | None = None

    def fetch(self, address: str, path: Path) -> None:
        """Write the file at `address` to `path`; raises BadInput."""
        shown = without_secrets(address)
        timer = threading.Timer(FETCH_S, self._cut)
        timer.daemon = True
        timer.start()
        try:
            self._follow(address, path)
        except BadInput as error:
            raise BadInput(f"{shown} cannot be fetched: {error}") from error
        except (OSError, http.client.HTTPException, ValueError) as error:  # ValueError: an invalid host name
            if isinstance(error, OSError) and error.errno in NO_SPACE:
                raise
            reason = f"it took more than {FETCH_S:g} s" if self._late.is_set() else error
            raise BadInput(f"{shown} cannot be fetched: {reason}") from error
        finally:
            timer.cancel()

    def _follow(self, address: str, path: Path) -> None:
        for _ in range(MOST_REDIRECTS + 1):
            parts = _split(address)
            if parts.scheme not in SCHEMES or not parts.hostname:
                raise BadInput(f"it redirects to {without_secrets(address)}, neither https://... nor http://...")
            with closing(_Checked(parts, self._late)) as self._connection:
                self._connection.request("GET", _target(parts), headers=_headers(parts))
                with self._connection.getresponse() as answer:
                    if answer.status not in REDIRECTS:
                        self._save(answer, path)
                        return
                    address = urljoin(address, answer.headers.get("Location", ""))
        raise BadInput(f"it was redirected more than {MOST_REDIRECTS} times")

    def _save(self, answer: http.client.HTTPResponse, path: Path) -> None:
        """Write the body of a response if it begins as a picture or a video does."""
        if answer.status != http.client.OK:
            raise BadInput(f"{answer.status} {answer.reason}")
        if (answer.length or 0) > LARGEST_FILE_BYTES:
            raise BadInput(f"it has {answer.length} bytes; at most {LARGEST_FILE_BYTES} are read; give a shorter file")
        chunk = b""
        while len(chunk) < SNIFFED_BYTES and (more := self._read(answer, SNIFFED_BYTES)):
            chunk += more
        check_head(chunk)
        size_bytes = 0
        with path.open("wb") as file:
            while chunk:
                size_bytes += len(chunk)
                if size_bytes > LARGEST_FILE_BYTES:
                    raise BadInput(f"it has more than {LARGEST_FILE_BYTES} bytes; give a shorter file")
                file.write(chunk)
                chunk = self._read(answer, CHUNK)

    def _read(self, answer: http.client.HTTPResponse, most: int) -> bytes:
        """Return received bytes, none at the end of the file."""
        chunk = answer.read1(most)
        if not chunk and (self._late.is_set() or answer.length):
            raise http.client.IncompleteRead(b"", answer.length)
        return chunk

    def _cut(self) -> None:
        """Interrupt the download."""
        self._late.set()
        if self._connection is not None:
            self._connection.cut()


class _Checked(http.client.HTTPConnection):
    """Connection to a checked address of a host; the name is not resolved again.

    Args:
        parts: address of the file.
        late: set when the time is up.
    """

    def __init__(self, parts: SplitResult, late: threading.Event) -> None:
        self.default_port = SCHEMES[parts.scheme]
        super().__init__(parts.hostname or "", parts.port or self.default_port, timeout=ANSWER_S)
        self._tls = ssl.create_default_context() if parts.scheme == "https" else None
        self._late = late
        self._used: socket.socket | None = None  # `sock` moves to the response if the server closes

    def connect(self) -> None:
        """Connect to the first address that answers; check the certificate against the name."""
        self._use(self._open_socket())
        if self._tls is not None:
            name = self.host.rstrip(".")
            wrapped = self._tls.wrap_socket(self.sock, server_hostname=name, do_handshake_on_connect=False)
            self._use(wrapped)
            wrapped.do_handshake()

    def cut(self) -> None:
        """Close the connection under the thread that reads or writes."""
        if self._used is not None:
            with suppress(OSError):
                socket.socket.shutdown(self._used, socket.SHUT_RDWR)  # the TLS one is not thread-safe

    def _open_socket(self) -> socket.socket:
        failure = OSError("no address answers")
        for address in hosts.resolve(self.host, self.port):
            try:
                return socket.create_connection((address, self.port), ANSWER_S)
            except OSError as error:
                failure = error
        raise failure

    def _use(self, sock: socket.socket) -> None:
        self.sock = self._used = sock
        if self._late.is_set():  # `cut` may have been called before there was a socket
            raise TimeoutError


def _split(address: str) -> SplitResult:
    try:
        parts = urlsplit(address)
        _ = parts.port
    except ValueError as error:
        raise BadInput(f"an address is https://HOST/FILE or s3://BUCKET/KEY; this one is invalid: {error}") from error
    return parts


def _file_name(parts: SplitResult, address: str) -> str:
    """Return the last part of an address; the key of an object is literal, also with `#`, `?` and `%`."""
    key = address.partition("://")[2].partition("/")[2]
    return PurePosixPath(key if parts.scheme == "s3" else unquote(parts.path)).name


def _target(parts: SplitResult) -> str:
    """Return path and query of a request."""
    path, query = quote(parts.path or "/", safe=UNQUOTED), quote(parts.query, safe=UNQUOTED + "?")
    return f"{path}?{query}" if query else path


def _headers(parts: SplitResult) -> dict[str, str]:
    """Return the headers of a request; credentials in an address go to its own host only."""
    headers = {"User-Agent": "dg4d"}
    if parts.username is not None:
        login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
        headers["Authorization"] = f"Basic {base64.b64encode(login.encode()).decode()}"
    return headers
