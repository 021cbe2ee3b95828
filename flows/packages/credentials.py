"""Content credentials (C2PA): signed statements on the origin of a file, which also detect changes.

They are embedded in pictures and videos; other formats, and the crate, which holds the digest of every file of the
package, have a sidecar file. Nothing is fetched or sent over the network; there are no time stamps.
"""

import io
import json
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO, Literal

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows.inputs.signing_key import CERTIFICATE, KEY, certificate_digest, read_pem
from flows.packages.publish import Files, file_digest
from steps.store.files import require_regular

EMBEDDED = {".mp4": "video/mp4", ".png": "image/png", ".webp": "image/webp"}  # formats with embedded credentials
BESIDE = (".glb", ".usdz")  # embedded credentials would break the 64-byte alignment of USDZ entries
ANY_BYTES = "application/octet-stream"
SOURCE_TYPES = "http://cv.iptc.org/newscodes/digitalsourcetype/"
TRAINED, ALGORITHMIC = f"{SOURCE_TYPES}trainedAlgorithmicMedia", f"{SOURCE_TYPES}algorithmicMedia"
ALGORITHMS = {
    "secp256r1": "es256",
    "secp384r1": "es384",
    "secp521r1": "es512",
    "RSAPrivateKey": "ps256",
    "Ed25519PrivateKey": "ed25519",
}  # by curve, or by class of the key
SETTINGS = {
    "builder": {"thumbnail": {"enabled": False}},
    "verify": {"remote_manifest_fetch": False, "ocsp_fetch": False},
}

State = Literal["trusted", "untrusted", "invalid", "missing"]


@dataclass(frozen=True)
class Claim:
    """Claim that is signed.

    Attributes:
        trained: True if a generative model made some of the asset.
        about: one or two sentences for people.
    """

    trained: bool
    about: str

    def manifest(self, name: str) -> str:
        """Return the claim about a file as a C2PA manifest."""
        agent = {"name": "dg4d", "version": version("dg4d")}
        action = {
            "action": "c2pa.created",
            "digitalSourceType": TRAINED if self.trained else ALGORITHMIC,
            "softwareAgent": agent,
            "description": self.about,
        }
        assertion = {"label": "c2pa.actions.v2", "data": {"actions": [action]}}
        return json.dumps({"claim_generator_info": [agent], "title": name, "assertions": [assertion]})


@dataclass(frozen=True)
class Signature:
    """Result of checking a signature.

    Attributes:
        state: "untrusted": valid, but the signer is not among the trusted certificates.
        signer: subject of the certificate.
        detail: reason why it is invalid.
    """

    state: State
    signer: str = ""
    detail: str = ""


@dataclass(frozen=True)
class Signer:
    """Signing key with its certificates.

    Attributes:
        key: PEM, PKCS #8.
        chain: certificates in PEM, the key's own first.
        algorithm: name in C2PA.
        subject: of the certificate.
    """

    key: bytes = field(repr=False)
    chain: bytes = field(repr=False)
    algorithm: str
    subject: str

    def sign_package(self, folder: Path, files: Files, claim: Claim) -> tuple[Files, dict[str, dict[str, Any]]]:
        """Sign the top-level files of a package: pictures, videos and assets.

        Args:
            folder: of the files, which may change.
            files: their digests.
            claim: to sign.

        Returns:
            Digests after signing, with sidecars; and for every signed file its digest before signing, or the name of
            its sidecar.

        Raises:
            BadInput: the certificate cannot be used for signing.
        """
        now, signed = dict(files), dict[str, dict[str, Any]]()
        for name in files:
            path = folder / name
            if path.parent != folder:
                continue
            if path.suffix in EMBEDDED:
                self._embed(path, claim)
                signed[name] = {"unsigned": files[name]}
                now[name] = file_digest(path)
            elif path.suffix in BESIDE:
                sidecar = self.sign_sidecar(path, claim)
                signed[name] = {"sidecar": sidecar.name}
                now[sidecar.name] = file_digest(sidecar)
        return now, signed

    def sign_sidecar(self, path: Path, claim: Claim) -> Path:
        """Write the credentials of a file to its sidecar; return its path.

        Raises:
            BadInput: the certificate cannot be used for signing.
        """
        sidecar = path.with_name(sidecar_name(path.name))
        with path.open("rb") as source:
            sidecar.write_bytes(self._signed(path, claim, ANY_BYTES, source, io.BytesIO(), embed=False))
        return sidecar

    def _embed(self, path: Path, claim: Claim) -> None:
        draft = path.with_name(f".{path.name}.signed")
        with path.open("rb") as source, draft.open("w+b") as target:
            self._signed(path, claim, EMBEDDED[path.suffix], source, target)
        draft.replace(path)

    def _signed(
        self, path: Path, claim: Claim, media_type: str, source: BinaryIO, target: BinaryIO, embed: bool = True
    ) -> bytes:
        """Copy a file with embedded credentials, or only compute them; return the credentials."""
        library = _library()
        info = library.C2paSignerInfo(self.algorithm.encode(), self.chain, self.key, None)
        try:
            builder = library.Builder(claim.manifest(path.name), _context())
            if not embed:
                builder.set_no_embed()
            content: bytes = builder.sign(library.Signer.from_info(info), media_type, source, target)
        except library.C2paError as error:
            raise BadInput(
                f"{path.name} could not be signed with ${CERTIFICATE} ({error}); the certificate must be valid today, "
                "allow digital signatures and have the extended usage emailProtection or documentSigning"
            ) from error
        return content


def configured_signer() -> Signer | None:
    """Return the signer of `$DG4D_SIGNING_KEY` and `$DG4D_SIGNING_CERTIFICATE`; None if neither is set.

    Raises:
        BadInput: one of them is not set, cannot be read or has the wrong format, or they do not match.
        BackendUnavailable: signing is not installed.
    """
    if certificate_digest() is None:
        return None
    _library()
    serialization: Any = import_module("cryptography.hazmat.primitives.serialization")
    x509: Any = import_module("cryptography.x509")
    chain = read_pem(CERTIFICATE)
    try:
        key = serialization.load_pem_private_key(read_pem(KEY), None)
        own = x509.load_pem_x509_certificates(chain)[0]
    except (ValueError, TypeError) as error:
        raise BadInput(
            f"${KEY} must name a PEM file with a private key without a password, and ${CERTIFICATE} one with its "
            f"certificate and then those of its issuers; one of them is something else ({error})"
        ) from error
    kind = getattr(getattr(key, "curve", None), "name", type(key).__name__)
    if kind not in ALGORITHMS:
        raise BadInput(f"a key of type {kind} cannot sign; use one of: {', '.join(ALGORITHMS)}")
    if key.public_key() != own.public_key():
        raise BadInput(f"the key in ${KEY} does not match the first certificate in ${CERTIFICATE}; give its own")
    plain = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return Signer(plain, chain, ALGORITHMS[kind], own.subject.rfc4514_string())


def sidecar_name(name: str) -> str:
    """Return the name of a file's sidecar: asset.c2pa for asset.glb, NAME.c2pa for other files."""
    return f"{name.removesuffix('.glb')}.c2pa"


def check_signature(path: Path, sidecar: Path | None = None, anchors: str = "") -> Signature:
    """Check the signature of a file.

    Args:
        path: signed file.
        sidecar: file with its credentials; None: they are embedded.
        anchors: trusted CA certificates in PEM.

    Raises:
        BackendUnavailable: signing is not installed.
        OSError: a file cannot be read.
    """
    library = _library()
    for read in filter(None, (path, sidecar)):
        require_regular(read)
    media_type = EMBEDDED[path.suffix] if sidecar is None else ANY_BYTES
    manifest = None if sidecar is None else sidecar.read_bytes()
    try:
        with path.open("rb") as file:
            found = json.loads(library.Reader(media_type, file, manifest, context=_context(anchors)).json())
    except library.C2paError as error:
        missing = str(error).startswith("ManifestNotFound")
        return Signature("missing" if missing else "invalid", detail="" if missing else str(error))
    active = found["manifests"][found["active_manifest"]].get("signature_info", {})
    signer = ", ".join(str(active[key]) for key in ("common_name", "issuer") if active.get(key))
    if found["validation_state"] == "Trusted":
        return Signature("trusted", signer)
    failures = found.get("validation_results", {}).get("activeManifest", {}).get("failure", ())
    codes = sorted({failure["code"] for failure in failures} - {"signingCredential.untrusted"})
    if found["validation_state"] != "Valid" or codes:
        return Signature("invalid", signer, ", ".join(codes))
    return Signature("untrusted", signer)


def _context(anchors: str = "") -> Any:
    library = _library()
    trust = {"trust": {"user_anchors": anchors}} if anchors else {}
    return library.Context(library.Settings.from_dict({**SETTINGS, **trust}))


def _library() -> Any:
    try:
        return import_module("c2pa")
    except ImportError as error:
        raise BackendUnavailable("content credentials need c2pa-python; run `make setup`") from error
