"""Verification of packages: every digest, every record, every signature; behind `dg4d verify`."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows.exit_status import EXIT_BAD_INPUT, EXIT_MISSING
from flows.inputs.json_text import loads
from flows.inputs.package_record import FORMAT, RECORD, check_is_folder, record_of
from flows.inputs.signing_key import CERTIFICATE
from flows.packages.crate import CRATE, crate_digest, files_in, render_crate, stated_digest
from flows.packages.credentials import check_signature, sidecar_name
from flows.packages.publish import file_digest
from steps.contract import RUN_ONLY, Frozen, digest_of
from steps.store.files import require_regular

State = Literal["whole", "altered", "missing", "extra", "trusted", "untrusted", "invalid", "unsigned", "unchecked"]
FAULTS = frozenset(["altered", "missing", "invalid", "unsigned"])
MISMATCH = "digest mismatch: the content differs from its recorded digest"


class Check(Frozen):
    """Result of one check.

    Attributes:
        kind: of the checked object.
        name: of the file or the record.
        state: "extra": not recorded, which is not a fault.
        detail: reason, for people.
    """

    kind: Literal["file", "record", "signature"]
    name: str
    state: State
    detail: str = ""

    @property
    def fault(self) -> bool:
        """True if the check found a difference from the recorded package."""
        return self.state in FAULTS


class Verification(Frozen):
    """Result of `verify`."""

    package: str
    checks: tuple[Check, ...]

    @property
    def exit_code(self) -> int:
        """Exit status: 0 if nothing is at fault, 65 if something is, 69 if signatures could not be checked."""
        if any(check.fault for check in self.checks):
            return EXIT_BAD_INPUT
        return EXIT_MISSING if any(check.state == "unchecked" for check in self.checks) else 0

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """Yield name, state and detail of every failed check, and one row per kind for the passed ones."""
        for kind, one in (("file", "file"), ("record", "step record"), ("signature", "signature")):
            checks = [check for check in self.checks if check.kind == kind]
            if count := sum(check.state == "whole" for check in checks):
                yield f"{count} {one}{'s' * (count != 1)}", "unchanged", ""
            yield from ((check.name, check.state, check.detail) for check in checks if check.state != "whole")


def verify(folder: Path, anchors: Path | None = None) -> Verification:
    """Check every byte of a package against its records, the records against each other, and the signatures.

    Args:
        folder: a package.
        anchors: PEM file with trusted CA certificates; requires the package to be signed.

    Raises:
        BadInput: there is no package, its record has another format, or the anchors cannot be read.
    """
    check_is_folder(folder)
    record = record_of(folder)
    if record is None:
        raise BadInput(f"{folder} is not an asset: it has no valid {RECORD}; give a folder that `dg4d make` wrote")
    if (written := record.get("format")) != FORMAT:
        raise BadInput(
            f"{folder} has a {RECORD} of format {written!r}; this version checks format {FORMAT}: "
            "check it with the version that made it, or make it again"
        )
    trusted = _read_anchors(anchors) if anchors else ""
    try:
        checks = [*_files(folder, record), *_records(record), *_signatures(folder, record, trusted)]
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        checks = [Check(kind="file", name=RECORD, state="altered", detail=f"unknown format ({error!r})")]
    return Verification(package=str(folder), checks=tuple(checks))


def _files(folder: Path, record: Mapping[str, Any]) -> Iterator[Check]:
    """Check every file that exists or should exist."""
    facts = dict(record["files"])
    beside = {name for name in record["beside"] if name not in (CRATE, sidecar_name(CRATE))} | {RECORD}
    if CRATE in record["beside"]:
        listed, check = _crate(folder / CRATE)
        yield check
        for name in sorted({*facts, *beside} ^ set(listed) if listed else ()):
            yield Check(kind="file", name=CRATE, state="altered", detail=f"contradicts {RECORD} on {name}")
        facts |= {name: listed[name] for name in beside & set(listed)}
    for name, fact in facts.items():
        yield _file(folder, name, fact)
    for name in sorted(beside - set(facts) - {RECORD}):
        if not os.path.isfile(folder / name):  # noqa: PTH113  # False for a path that is too long, without an error
            yield Check(kind="file", name=name, state="missing")
    recorded = {*facts, *beside, *record["beside"]}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name not in recorded and (path.is_file() or path.is_symlink()):
            yield Check(kind="file", name=name, state="extra", detail="not in any record")


def _file(folder: Path, name: str, fact: Mapping[str, Any]) -> Check:
    path = folder / name
    state: State = "altered"
    try:
        if path.is_symlink():
            detail = "it is a link"
        elif (now := file_digest(path)) == fact:
            state, detail = "whole", ""
        else:
            detail = f"{now['size_bytes']} bytes {now['digest']}, recorded {fact['size_bytes']} bytes {fact['digest']}"
    except FileNotFoundError:
        state, detail = "missing", ""
    except OSError as error:
        detail = f"it cannot be read: {error.strerror}"
    return Check(kind="file", name=name, state=state, detail=detail)


def _crate(path: Path) -> tuple[dict[str, dict[str, Any]], Check]:
    """Return digest and size of the files that the crate lists, and its own check."""
    try:
        require_regular(path)
        text = path.read_text(encoding="utf-8")
        document = loads(text)
        whole = text == render_crate(document) and stated_digest(document) == crate_digest(document)
        listed = {name: {"digest": digest, "size_bytes": size} for name, (digest, size) in files_in(document).items()}
    except FileNotFoundError:
        return {}, Check(kind="file", name=CRATE, state="missing")
    except (OSError, ValueError, LookupError, TypeError) as error:
        return {}, Check(kind="file", name=CRATE, state="altered", detail=f"it cannot be read ({error})")
    return listed, _digest_check("file", CRATE, whole)


def _digest_check(kind: Literal["file", "record"], name: str, whole: bool) -> Check:
    return Check(kind=kind, name=name, state="whole" if whole else "altered", detail="" if whole else MISMATCH)


def _records(record: Mapping[str, Any]) -> Iterator[Check]:
    """Check the step records against their digests, and redundant fields against each other."""
    made = set[str]()
    for number, step in enumerate(record["steps"], 1):
        covered = {name: value for name, value in step.items() if name != "digest" and name not in RUN_ONLY}
        yield _digest_check("record", f"{number}. {step['step']}", digest_of(covered) == step["digest"])
        made |= set(step["outputs"].values())
    for what in ("source", "seed", "commercial_only"):
        recipe = record["recipe"][what]
        if record[what] != (recipe["digest"] if what == "source" else recipe):
            yield Check(kind="record", name=what, state="altered", detail="differs from the recipe")
    if record["package"] not in made:
        yield Check(kind="record", name="package", state="altered", detail="not an output of any step")


def _signatures(folder: Path, record: Mapping[str, Any], anchors: str) -> Iterator[Check]:
    """Check every signature that the record names; with anchors, an untrusted signer is a fault."""
    signed: Mapping[str, Any] = record["signatures"].get("files", {})
    sidecars: dict[str, str | None] = {name: how.get("sidecar") for name, how in signed.items()}
    if record["signatures"]:
        sidecars[CRATE] = sidecar_name(CRATE)
    elif anchors:
        yield Check(kind="signature", name="the package", state="unsigned", detail="it has no signatures")
    for name, sidecar in sidecars.items():
        state: State
        try:
            found = check_signature(folder / name, folder / sidecar if sidecar else None, anchors)
            state, detail = found.state, found.detail or f"signed by {found.signer}"
        except BackendUnavailable as error:
            state, detail = "unchecked", str(error)
        except OSError as error:
            state, detail = "invalid", f"it cannot be read: {error.strerror}"
        if state == "untrusted":
            state = "invalid" if anchors else "untrusted"
            detail += ", not by a trusted certificate" if anchors else "; give trusted certificates with --trust"
        yield Check(kind="signature", name=name, state=state, detail=detail)


def _read_anchors(path: Path) -> str:
    try:
        text = path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"the trusted certificates {path} cannot be read: {error}") from error
    if "-----BEGIN CERTIFICATE-----" not in text:
        raise BadInput(f"{path} holds no certificate in PEM; give trusted CA certificates, as in ${CERTIFICATE}")
    return text
