"""A user's file from a path, a web server or an object store, on this machine for a while.

Web servers are reached directly: a proxy would look names up by itself, after they were checked.
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
from flows.inputs.sources import LARGEST_FILE_BYTES
from steps.sources.media_types import SNIFFED_BYTES, check_head
from steps.store.files import NO_SPACE, room_for

ANSWER_S = 60.0  # for a web server to connect, and each time it is asked for more
FETCH_S = 600.0  # for a whole file, with every redirect
MOST_REDIRECTS = 5
REDIRECTS = {301, 302, 303, 307, 308}
CHUNK = 1 << 20  # bytes
SCHEMES = {"http": 80, "https": 443}
LONGEST_NAME = 255  # bytes, of a file
UNQUOTED = "/%:@!$&'()*+,;=~"  # RFC 3986, section 3.3


@contextmanager
def local_copy(address: str) -> Iterator[Path]:
    """Give the file at an address, on this machine as long as the block runs.

    Args:
        address: a path; `https://...` or `http://...`; or `s3://BUCKET/KEY`, with the usual AWS_* variables.

    Raises:
        BadInput: there is no such file, it is too large or no picture or video, its host is private, or the address
            is of no known kind.
        BackendUnavailable: the object store refuses access, or does not answer.
    """
    if "://" not in address:
        yield Path(address)
        return
    shown = without_secrets(address)
    parts = _split(address)
    name = PurePosixPath(unquote(parts.path)).name
    fits = bool(name) and "\0" not in name and len(name.encode(errors="replace")) <= LONGEST_NAME
    if parts.scheme not in {*SCHEMES, "s3"} or not parts.hostname or not fits:
        raise BadInput(f"{shown} names no file: give a path, https://HOST/FILE or s3://BUCKET/KEY")
    if parts.scheme == "s3":
        folder, _, key = address.rpartition("/")
        with listing.fetched(folder, key, name) as path:
            yield path
        return
    with tempfile.TemporaryDirectory(prefix="dg4d-fetched-") as scratch, room_for(Path(scratch)):
        path = Path(scratch) / name
        _Download(FETCH_S).fetch(address, path)
        yield path


def without_secrets(address: str) -> str:
    """Return the address as people may see it, with neither a password nor a signature."""
    if "://" not in address:
        return address
    try:
        parts = _split(address)
    except BadInput:
        return "an address that cannot be"
    return f"{parts.scheme}://{parts.hostname}{parts.path}"


class _Download:
    """One file of a web server, within a time for all of it.

    Args:
        limit_s: seconds, after which the connection is cut, whatever it waits for.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._late = threading.Event()
        self._connection: _Checked | None = None

    def fetch(self, address: str, path: Path) -> None:
        """Write the file at `address` to `path`; raises BadInput."""
        shown = without_secrets(address)
        timer = threading.Timer(self._limit_s, self._cut)
        timer.daemon = True
        timer.start()
        try:
            self._follow(address, path)
        except BadInput as error:
            raise BadInput(f"{shown} cannot be fetched: {error}") from error
        except (OSError, http.client.HTTPException, ValueError) as error:  # ValueError: no name of a host
            if isinstance(error, OSError) and error.errno in NO_SPACE:
                raise
            reason = f"it took more than {self._limit_s:g} s" if self._late.is_set() else error
            raise BadInput(f"{shown} cannot be fetched: {reason}") from error
        finally:
            timer.cancel()

    def _follow(self, address: str, path: Path) -> None:
        for _ in range(MOST_REDIRECTS + 1):
            parts = _split(address)
            if parts.scheme not in SCHEMES or not parts.hostname:
                raise BadInput(f"it leads to {without_secrets(address)}, which is neither https://... nor http://...")
            with closing(_Checked(parts, self._late)) as self._connection:
                self._connection.request("GET", _place(parts), headers=_headers(parts))
                with self._connection.getresponse() as answer:
                    if answer.status not in REDIRECTS:
                        self._keep(answer, path)
                        return
                    address = urljoin(address, answer.headers.get("Location", ""))
        raise BadInput(f"it was redirected more than {MOST_REDIRECTS} times")

    def _keep(self, answer: http.client.HTTPResponse, path: Path) -> None:
        """Write what a server answers, once its first bytes are those of a picture or a video."""
        if answer.status != http.client.OK:
            raise BadInput(f"{answer.status} {answer.reason}")
        if (answer.length or 0) > LARGEST_FILE_BYTES:
            raise BadInput(f"it has {answer.length} bytes; at most {LARGEST_FILE_BYTES} are read: give a shorter one")
        chunk = b""
        while len(chunk) < SNIFFED_BYTES and (more := self._read(answer, SNIFFED_BYTES)):
            chunk += more
        check_head(chunk)
        size_bytes = 0
        with path.open("wb") as file:
            while chunk:
                size_bytes += len(chunk)
                if size_bytes > LARGEST_FILE_BYTES:
                    raise BadInput(f"it has more than {LARGEST_FILE_BYTES} bytes; give a shorter one")
                file.write(chunk)
                chunk = self._read(answer, CHUNK)

    def _read(self, answer: http.client.HTTPResponse, most: int) -> bytes:
        """Return what has arrived; nothing at the end of the file."""
        chunk = answer.read1(most)
        if not chunk and (self._late.is_set() or answer.length):
            raise http.client.IncompleteRead(b"", answer.length)
        return chunk

    def _cut(self) -> None:
        """End whatever the download waits for."""
        self._late.set()
        if self._connection is not None:
            self._connection.cut()


class _Checked(http.client.HTTPConnection):
    """A connection to an address that was checked, and to no other that its name may mean by now.

    Args:
        parts: of the address of a file.
        late: set when there is no more time.
    """

    def __init__(self, parts: SplitResult, late: threading.Event) -> None:
        self.default_port = SCHEMES[parts.scheme]
        super().__init__(parts.hostname or "", parts.port or self.default_port, timeout=ANSWER_S)
        self._tls = ssl.create_default_context() if parts.scheme == "https" else None
        self._late = late
        self._used: socket.socket | None = None  # `sock` is given away where a server says that it will close

    def connect(self) -> None:
        """Connect to the first address that answers; certificates are checked against the name."""
        self._use(self._reached())
        if self._tls is not None:
            name = self.host.rstrip(".")
            wrapped = self._tls.wrap_socket(self.sock, server_hostname=name, do_handshake_on_connect=False)
            self._use(wrapped)
            wrapped.do_handshake()

    def cut(self) -> None:
        """Have the other thread, which reads or writes, find the connection closed."""
        if self._used is not None:
            with suppress(OSError):
                socket.socket.shutdown(self._used, socket.SHUT_RDWR)  # that of TLS changes what the other thread uses

    def _reached(self) -> socket.socket:
        trouble = OSError("no address answers")
        for address in hosts.resolve(self.host, self.port):
            try:
                return socket.create_connection((address, self.port), ANSWER_S)
            except OSError as error:
                trouble = error
        raise trouble

    def _use(self, sock: socket.socket) -> None:
        self.sock = self._used = sock
        if self._late.is_set():  # `cut` may have come before there was anything to cut
            raise TimeoutError


def _split(address: str) -> SplitResult:
    try:
        parts = urlsplit(address)
        _ = parts.port
    except ValueError as error:
        raise BadInput(f"an address is https://HOST/FILE or s3://BUCKET/KEY; this one cannot be: {error}") from error
    return parts


def _place(parts: SplitResult) -> str:
    """Return path and query, as a request has them."""
    path, query = quote(parts.path or "/", safe=UNQUOTED), quote(parts.query, safe=UNQUOTED + "?")
    return f"{path}?{query}" if query else path


def _headers(parts: SplitResult) -> dict[str, str]:
    """Return the headers of a request; name and password of an address are for its own host only."""
    headers = {"User-Agent": "dg4d"}
    if parts.username is not None:
        login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
        headers["Authorization"] = f"Basic {base64.b64encode(login.encode()).decode()}"
    return headers
