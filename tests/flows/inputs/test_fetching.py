"""Sources from web servers: files arrive, and nothing is asked of this machine or of a private network."""

import datetime
import ipaddress
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from fake_steps import PNG

from dg4d_lib.errors import BadInput
from flows.inputs import fetching, hosts
from flows.inputs.fetching import item_name, local_copy


class Site:
    """A web server on this machine that remembers what it was asked.

    Attributes:
        files: content by path.
        leads: where to, by path.
        drip_s: seconds between two bytes of an answer, headers included; 0: at once.
        says_length: before the content; without it, the end of the connection is the end of the file.
        sent: bytes of files that went out.
        asked: path and headers of every request.
    """

    def __init__(self, tls: ssl.SSLContext | None = None) -> None:
        self.files: dict[str, bytes] = {"/a%20b.png": PNG}
        self.leads: dict[str, str] = {}
        self.drip_s, self.says_length, self.sent = 0.0, True, 0
        self.asked: list[tuple[str, dict[str, str]]] = []
        self.server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (Handler,), {"site": self}))
        self.server.daemon_threads = True
        self.port = self.server.server_port
        if tls is not None:
            self.server.socket = tls.wrap_socket(self.server.socket, server_side=True)
        threading.Thread(target=self.server.serve_forever, args=(0.02,), daemon=True).start()


class Handler(BaseHTTPRequestHandler):
    site: Site

    def log_message(self, *_: object) -> None:
        return

    def do_GET(self) -> None:
        self.site.asked.append((self.path, dict(self.headers)))
        path = self.path.partition("?")[0]
        content = self.site.files.get(path)
        if content is None and path not in self.site.leads:
            self.send_error(404)
            return
        length = b"Content-Length: %d\r\n" % len(content or b"") if self.site.says_length else b""
        head = b"HTTP/1.1 200 OK\r\n" + length + b"\r\n"
        if path in self.site.leads:
            head = f"HTTP/1.1 302 Found\r\nLocation: {self.site.leads[path]}\r\n\r\n".encode()
        answer = head + (content or b"")
        step = 1 if self.site.drip_s else 65536
        try:
            for start in range(0, len(answer), step):
                self.wfile.write(answer[start : start + step])
                self.site.sent += step
                time.sleep(self.site.drip_s)
        except OSError:  # the other side has gone
            return


@pytest.fixture
def private() -> Iterator[Site]:
    """A server that nobody allowed."""
    site = Site()
    yield site
    site.server.shutdown()
    site.server.server_close()


@pytest.fixture
def site(private: Site, monkeypatch: pytest.MonkeyPatch) -> Site:
    """A server on an address that is allowed."""
    monkeypatch.setenv(hosts.ALLOW, "127.0.0.0/8")
    return private


def at(site: Site, path: str = "/a%20b.png", host: str = "127.0.0.1") -> str:
    return f"http://{host}:{site.port}{path}"


def refused(address: str, says: str) -> str:
    with pytest.raises(BadInput, match=says) as caught, local_copy(address):
        pass
    return str(caught.value)


def test_a_path_stays_where_it_is(tmp_path: Path) -> None:
    with local_copy(str(tmp_path / "a.png")) as path:
        assert path == tmp_path / "a.png"


def test_a_file_of_a_web_server_is_here_under_its_name_for_a_while(site: Site) -> None:
    with local_copy(at(site, "/a%20b.png?signature=1")) as path:
        assert path.name == "a b.png" and path.read_bytes() == PNG
    assert not path.exists()
    assert [place for place, _ in site.asked] == ["/a%20b.png?signature=1"]


def test_name_and_password_of_an_address_are_for_its_host_only(site: Site) -> None:
    site.leads["/first.png"] = at(site)
    with local_copy(at(site, "/first.png", "user:pass%20word@127.0.0.1")):
        pass
    sent = [headers.get("Authorization") for _, headers in site.asked]
    assert sent == ["Basic dXNlcjpwYXNzIHdvcmQ=", None]


@pytest.mark.parametrize("address", ["ftp://host/a.png", "file:///etc/passwd", "https://host/", "s3://bucket",
                                     "https:///a.png", f"https://host/{'a' * 256}.png"])  # fmt: skip
def test_other_addresses_are_refused(address: str) -> None:
    refused(address, "names no file")


@pytest.mark.parametrize("address", ["http://[::1/a.png", "http://host:port/a.png", "http://host:99999/a.png"])
def test_what_is_no_address_is_refused(address: str) -> None:
    refused(address, "this one is invalid")


@pytest.mark.parametrize("host", ["nowhere.invalid", "a..b", f"{'a' * 64}.invalid"])
def test_a_host_that_is_none_is_refused(host: str) -> None:
    refused(f"http://{host}/a.png", "cannot be fetched")


def test_what_is_not_there_is_said_without_its_signature(site: Site) -> None:
    assert "secret" not in refused(at(site, "/no.png?secret=1"), r"no\.png cannot be fetched: 404 Not Found")


# Private hosts


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1", "localhost", "localhost.", "LOCALHOST", "127.1", "0x7f000001", "0x7f.1", "2130706433", "017700000001",
     "0", "0.0.0.0", "[::ffff:127.0.0.1]", "[::ffff:7f00:1]", "[::1]", "[::]", "[64:ff9b::127.0.0.1]",
     "[2002:7f00:1::]", "127.0.0.1.", "127.0.0.255", "[::127.0.0.1]"],
)  # fmt: skip
def test_no_request_reaches_this_machine_however_it_is_written(private: Site, host: str) -> None:
    refused(at(private, host=host), "private network|cannot be fetched")
    assert private.asked == []


@pytest.mark.parametrize(
    "address",
    ["10.0.0.1", "172.16.0.1", "192.168.1.1", "169.254.169.254", "100.64.0.1", "224.0.0.1", "239.255.255.250",
     "240.0.0.1", "255.255.255.255", "0.0.0.0", "192.0.2.1", "198.18.0.1", "127.8.8.8",
     "::", "::1", "fe80::1", "fc00::1", "fec0::1", "ff02::1", "ff0e::1", "2001:db8::1", "100::1", "64:ff9b:1::1",
     "::ffff:10.0.0.1", "64:ff9b::10.0.0.1", "64:ff9b::a9fe:a9fe", "2002:0a00:0001::1", "2001:0:7f00:1::"],
)  # fmt: skip
def test_an_address_that_not_anybody_can_have_is_not_public(address: str) -> None:
    assert not hosts.is_public(ipaddress.ip_address(address))


@pytest.mark.parametrize("address", ["8.8.8.8", "2606:4700::1111", "::ffff:8.8.8.8", "64:ff9b::808:808"])
def test_addresses_of_the_internet_are_public(address: str) -> None:
    assert hosts.is_public(ipaddress.ip_address(address))


def test_a_host_with_one_private_address_among_others_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    names = {"mixed.test": ["8.8.8.8", "10.0.0.1"], "open.test": ["8.8.8.8", "2606:4700::1111"]}
    known(monkeypatch, names)
    assert hosts.resolve("open.test", 80) == names["open.test"]
    with pytest.raises(BadInput, match=r"mixed\.test is on this machine.*set DG4D_FETCH_ALLOW"):
        hosts.resolve("mixed.test", 80)


def known(monkeypatch: pytest.MonkeyPatch, names: dict[str, list[str]]) -> list[str]:
    """Have names mean these addresses; the names that are looked up, as they come."""
    looked_up: list[str] = []
    real = socket.getaddrinfo

    def getaddrinfo(host: str, port: int, *arguments: Any, **options: Any) -> Any:
        if host not in names:
            return real(host, port, *arguments, **options)
        looked_up.append(host)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)) for address in names[host]]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    return looked_up


def test_the_address_that_was_checked_is_the_one_that_is_asked(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    names = {"rebind.test": ["127.0.0.1"]}
    looked_up = known(monkeypatch, names)
    with local_copy(at(site, host="rebind.test")) as path:
        assert path.read_bytes() == PNG
    assert looked_up == ["rebind.test"]  # a second answer of the name server would not be checked
    assert site.asked[0][1]["Host"] == f"rebind.test:{site.port}"


@pytest.mark.parametrize("leads", ["http://localhost:{port}/a%20b.png", "http://10.0.0.1/a.png", "//[::1]/a.png"])
def test_a_redirect_to_a_private_host_is_refused(site: Site, monkeypatch: pytest.MonkeyPatch, leads: str) -> None:
    names = {"open.test": ["127.0.0.1"]}
    known(monkeypatch, names)
    monkeypatch.setenv(hosts.ALLOW, "open.test")
    site.leads["/x.png"] = leads.format(port=site.port)
    refused(at(site, "/x.png", "open.test"), "private network")
    assert [path for path, _ in site.asked] == ["/x.png"]


@pytest.mark.parametrize("leads", ["file:///etc/passwd", "ftp://host/a.png", "gopher://127.0.0.1:1/x", "s3://b/a.png"])
def test_a_redirect_to_another_scheme_is_refused(site: Site, leads: str) -> None:
    site.leads["/x.png"] = leads
    refused(at(site, "/x.png"), "neither https://... nor http://...")


def test_five_redirects_are_followed_and_a_sixth_is_not(site: Site) -> None:
    site.leads |= {f"/{i}.png": f"{i - 1}.png" for i in range(2, 7)} | {"/1.png": "a%20b.png"}
    with local_copy(at(site, "/5.png")) as path:
        assert path.read_bytes() == PNG
    refused(at(site, "/6.png"), "redirected more than 5 times")


@pytest.mark.parametrize("allow", ["localhost", "LocalHost.", "127.0.0.1", "10.0.0.0/8, 127.0.0.0/8", "127.0.0.1/8"])
def test_what_is_allowed_is_fetched(private: Site, monkeypatch: pytest.MonkeyPatch, allow: str) -> None:
    monkeypatch.setenv(hosts.ALLOW, allow)
    with local_copy(at(private, host="localhost")) as path:
        assert path.read_bytes() == PNG


@pytest.mark.parametrize("allow", ["", " , ", "host", "notlocalhost", "10.0.0.0/8", "128.0.0.0/1"])
def test_what_is_allowed_besides_allows_nothing_else(
    private: Site, monkeypatch: pytest.MonkeyPatch, allow: str
) -> None:
    monkeypatch.setenv(hosts.ALLOW, allow)
    refused(at(private, host="localhost"), "private network")
    assert private.asked == []


@pytest.mark.parametrize("allow", ["10.0.0.0/40", "localhost:80", "http://localhost"])
def test_an_allow_list_that_cannot_be_read_is_refused(
    private: Site, monkeypatch: pytest.MonkeyPatch, allow: str
) -> None:
    monkeypatch.setenv(hosts.ALLOW, allow)
    refused(at(private), "DG4D_FETCH_ALLOW has")


def test_proxies_of_the_environment_are_not_used(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    with local_copy(at(site)) as path:
        assert path.read_bytes() == PNG


# Bounds


@pytest.mark.parametrize(("says_length", "says"), [(True, "at most 30 are read"), (False, "more than 30 bytes")])
def test_what_is_too_large_is_refused(
    site: Site, monkeypatch: pytest.MonkeyPatch, says_length: bool, says: str
) -> None:
    monkeypatch.setattr(fetching, "LARGEST_FILE_BYTES", 30)
    site.says_length = says_length
    refused(at(site), says)


def test_of_a_file_that_is_no_picture_only_the_beginning_is_fetched(site: Site) -> None:
    site.files["/secret.png"] = b"root:x:0:0\n" * 2**21
    refused(at(site, "/secret.png"), "the file is a text file, whatever its name says; give pictures")
    assert site.sent < 2**24  # what the buffers of two sockets took


def test_an_empty_answer_is_no_picture(site: Site) -> None:
    site.files["/none.png"] = b""
    refused(at(site, "/none.png"), "empty")


def test_an_answer_that_breaks_off_is_refused(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def cut(self: Handler) -> None:
        self.wfile.write(b"HTTP/1.1 200 OK\r\nContent-Length: 1000\r\n\r\n" + PNG)

    monkeypatch.setattr(Handler, "do_GET", cut)
    refused(at(site), "IncompleteRead")


@pytest.mark.parametrize("says_length", [True, False])
@pytest.mark.parametrize("drip_s", [0.002, 0.05])  # the limit comes within the content, and within the headers
def test_a_server_that_sends_a_byte_now_and_then_ends_at_the_limit(
    site: Site, monkeypatch: pytest.MonkeyPatch, drip_s: float, says_length: bool
) -> None:
    monkeypatch.setattr(fetching, "FETCH_S", 0.5)
    site.files["/slow.png"] = PNG + bytes(100_000)
    site.drip_s, site.says_length = drip_s, says_length
    begun = time.monotonic()
    refused(at(site, "/slow.png"), r"it took more than 0\.5 s")
    assert time.monotonic() - begun < 60  # no byte was late; all of them would take minutes


def test_a_server_that_says_nothing_during_a_handshake_ends_at_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetching, "FETCH_S", 0.5)
    monkeypatch.setenv(hosts.ALLOW, "127.0.0.1")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        refused(f"https://127.0.0.1:{silent.getsockname()[1]}/a.png", r"it took more than 0\.5 s")


# Certificates


def issued(name: str, folder: Path) -> Path:
    """A certificate for a host that vouches for itself, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.datetime.now(datetime.UTC)
    builder = x509.CertificateBuilder(subject, subject, key.public_key(), 1, now, now + datetime.timedelta(days=1))
    builder = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
    file = folder / f"{name}.pem"
    file.write_bytes(
        builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
        + key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    return file


def test_certificates_are_checked_against_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = {"pictures.test": ["127.0.0.1"], "other.test": ["127.0.0.1"]}
    known(monkeypatch, names)
    monkeypatch.setenv(hosts.ALLOW, "127.0.0.1")
    certificate = issued("pictures.test", tmp_path)
    tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    tls.load_cert_chain(certificate)
    site = Site(tls)
    try:
        address = f"https://pictures.test:{site.port}/a%20b.png"
        refused(address, "CERTIFICATE_VERIFY_FAILED")
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        with local_copy(address) as path:
            assert path.read_bytes() == PNG
        refused(address.replace("pictures", "other"), "CERTIFICATE_VERIFY_FAILED.*other.test")
        assert len(site.asked) == 1
    finally:
        site.server.shutdown()
        site.server.server_close()


@pytest.mark.parametrize(
    ("address", "name"),
    [
        ("in/bear #2.png", "bear #2"),
        ("in/what?.png", "what?"),
        ("in/100%25.png", "100%25"),
        ("s3://bucket/in/bear #2.png", "bear #2"),
        ("s3://bucket/in/a%20fox.png", "a%20fox"),
        ("https://host/in/a%20fox.png?key=1#top", "a fox"),
        ("https://host/", "asset"),
    ],
)
def test_a_number_sign_or_question_mark_is_part_of_the_name_of_a_file_and_not_of_a_page(
    address: str, name: str
) -> None:
    assert item_name(address) == name


def test_a_folder_of_frames_keeps_its_dots(tmp_path: Path) -> None:
    (tmp_path / "walk.v2").mkdir()
    assert item_name(str(tmp_path / "walk.v2")) == "walk.v2"


def test_an_object_with_a_number_sign_in_its_key_is_fetched_under_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    @contextmanager
    def fetch(*of: str) -> Iterator[Path]:
        asked.append(of)
        yield Path(of[2])

    monkeypatch.setattr("flows.inputs.listing.fetch_object", fetch)
    with local_copy("s3://bucket/in/bear #2.png") as path:
        assert path.name == "bear #2.png"
    assert asked == [("s3://bucket/in", "bear #2.png", "bear #2.png")]
