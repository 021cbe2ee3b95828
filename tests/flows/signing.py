"""Certificates made for tests, as a company would: a root that vouches for a leaf, which signs."""

import datetime
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519, rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

MAKERS: dict[str, Any] = {
    "es256": lambda: ec.generate_private_key(ec.SECP256R1()),
    "es384": lambda: ec.generate_private_key(ec.SECP384R1()),
    "es512": lambda: ec.generate_private_key(ec.SECP521R1()),
    "ps256": lambda: rsa.generate_private_key(65537, 2048),
    "ed25519": ed25519.Ed25519PrivateKey.generate,
}


@dataclass(frozen=True)
class Identity:
    """PEM files."""

    key: Path
    chain: Path
    root: Path

    @contextmanager
    def configured(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("DG4D_SIGNING_KEY", str(self.key))
            patch.setenv("DG4D_SIGNING_CERTIFICATE", str(self.chain))
            yield


def identity(folder: Path, kind: str = "es256", usage: bool = True, own: bool = False) -> Identity:
    """Keys and certificates in a folder; `usage`: the extended one that C2PA asks for; `own`: signed by itself."""
    folder.mkdir(parents=True, exist_ok=True)
    root_key, key = MAKERS["es256"](), MAKERS[kind]()
    root = _certificate("Test root", root_key, "Test root", root_key, leaf=False, usage=False)
    leaf = _certificate(
        "Test studio", key, "Test studio" if own else "Test root", key if own else root_key, leaf=True, usage=usage
    )
    made = Identity(folder / "key.pem", folder / "chain.pem", folder / "root.pem")
    made.key.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    made.root.write_bytes(root.public_bytes(serialization.Encoding.PEM))
    made.chain.write_bytes(leaf.public_bytes(serialization.Encoding.PEM) + (b"" if own else made.root.read_bytes()))
    return made


def _certificate(subject: str, key: Any, issuer: str, issuer_key: Any, leaf: bool, usage: bool) -> x509.Certificate:
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(_name(subject))
        .issuer_name(_name(issuer))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=30))
        .add_extension(x509.BasicConstraints(ca=not leaf, path_length=None), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key.public_key()), critical=False)
        .add_extension(
            x509.KeyUsage(
                digital_signature=True,
                key_cert_sign=not leaf,
                crl_sign=not leaf,
                content_commitment=False,
                key_encipherment=False,
                data_encipherment=False,
                key_agreement=False,
                encipher_only=False,
                decipher_only=False,
            ),
            critical=True,
        )
    )
    if usage:
        builder = builder.add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.EMAIL_PROTECTION]), critical=False)
    hashed = None if isinstance(issuer_key, ed25519.Ed25519PrivateKey) else hashes.SHA256()
    return builder.sign(issuer_key, hashed)


def _name(common: str) -> x509.Name:
    return x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, "Test company"),
            x509.NameAttribute(NameOID.COMMON_NAME, common),
        ]
    )
