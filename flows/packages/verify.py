"""Whether a package is as it was made: every digest, every record, every signature; behind `dg4d verify`."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from dg4d_lib.errors import BackendUnavailable, BadInput
from flows.exit_status import EXIT_BAD_INPUT, EXIT_MISSING
from flows.inputs.json_text import loads
from flows.inputs.package_record import FORMAT, RECORD, record_of
from flows.inputs.signing_key import CERTIFICATE
from flows.packages.crate import CRATE, files_in, own_digest, rendered
from flows.packages.credentials import Signature, sidecar_of, signature_of
from flows.packages.publish import file_digest
from steps.contract import RUN_ONLY, Frozen, digest_of

State = Literal["whole", "altered", "missing", "extra", "trusted", "untrusted", "invalid", "unsigned", "unchecked"]
FAULTS = frozenset(["altered", "missing", "invalid", "unsigned"])


class Check(Frozen):
    """One thing that was looked at.

    Attributes:
        kind: what sort of thing.
        name: of the file or the record.
        state: how it is; "extra": nobody recorded it, which is no fault.
        detail: why, for people.
    """

    kind: Literal["file", "record", "signature"]
    name: str
    state: State
    detail: str = ""

    @property
    def fault(self) -> bool:
        """Whether the package is not as it was made."""
        return self.state in FAULTS


class Verdict(Frozen):
    """What `verify` found."""

    package: str
    checks: tuple[Check, ...]

    @property
    def exit_code(self) -> int:
        """0 if everything is as it was made, 65 if not, 69 if signatures could not be looked at."""
        if any(check.fault for check in self.checks):
            return EXIT_BAD_INPUT
        return EXIT_MISSING if any(check.state == "unchecked" for check in self.checks) else 0

    def rows(self) -> Iterator[tuple[str, str, str]]:
        """What, how it is, why: a row for everything that is not whole, and one for all that is, of each kind."""
        for kind, several in (("file", "files"), ("record", "records of steps"), ("signature", "signatures")):
            checks = [check for check in self.checks if check.kind == kind]
            whole = [check for check in checks if check.state == "whole"]
            if whole:
                yield f"{len(whole)} {kind if len(whole) == 1 else several}", "whole", ""
            yield from ((check.name, check.state, check.detail) for check in checks if check.state != "whole")


def verify(folder: Path, anchors: Path | None = None) -> Verdict:
    """Check every byte of a package against its records, the records against each other, and the signatures.

    Args:
        folder: a package.
        anchors: a PEM file with the certificates of those who are trusted to vouch for signers; with it, a package
            that nobody signed is at fault.

    Raises:
        BadInput: there is no package, its record is of another format, or the anchors cannot be read.
    """
    record = record_of(folder)
    if record is None:
        raise BadInput(f"{folder} is no asset: it has no sound {RECORD}; give a folder that `dg4d make` wrote")
    if (written := record.get("format")) != FORMAT:
        raise BadInput(
            f"{folder} has a {RECORD} of format {written!r}; this version checks format {FORMAT}: "
            "check it with the version that made it, or make it again"
        )
    trusted = _text(anchors) if anchors else ""
    try:
        checks = [*_files(folder, record), *_records(record), *_signatures(folder, record, trusted)]
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        checks = [Check(kind="file", name=RECORD, state="altered", detail=f"it has another form ({error!r})")]
    return Verdict(package=str(folder), checks=tuple(checks))


def _files(folder: Path, record: Mapping[str, Any]) -> Iterator[Check]:
    """Every file that is or should be there."""
    facts = dict(record["files"])
    beside = {name for name in record["beside"] if name not in (CRATE, sidecar_of(CRATE))} | {RECORD}
    if CRATE in record["beside"]:
        document, check = _crate(folder / CRATE)
        yield check
        listed = _listed(document)
        for name in sorted({*facts, *beside} ^ set(listed) if listed else ()):
            yield Check(kind="file", name=CRATE, state="altered", detail=f"it and {RECORD} do not agree on {name}")
        facts |= {name: listed[name] for name in beside & set(listed)}
    for name, fact in facts.items():
        yield _file(folder, name, fact)
    for name in sorted(beside - set(facts) - {RECORD}):
        if not os.path.isfile(folder / name):  # noqa: PTH113  # False for a path that is too long, without an error
            yield Check(kind="file", name=name, state="missing")
    ours = {*facts, *beside, *record["beside"]}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name not in ours and (path.is_file() or path.is_symlink()):
            yield Check(kind="file", name=name, state="extra", detail="no record names it")


def _file(folder: Path, name: str, fact: Mapping[str, Any]) -> Check:
    path = folder / name
    state: State = "altered"
    try:
        if path.is_symlink():
            detail = "it is a link"
        elif (now := file_digest(path)) == fact:
            state, detail = "whole", ""
        else:
            detail = (
                f"it has {now['size_bytes']} bytes {now['digest']}, not {fact['size_bytes']} bytes {fact['digest']}"
            )
    except FileNotFoundError:
        state, detail = "missing", ""
    except OSError as error:
        detail = f"it cannot be read: {error.strerror}"
    return Check(kind="file", name=name, state=state, detail=detail)


def _crate(path: Path) -> tuple[Any, Check]:
    """The crate as it is, and whether it is what was written."""
    try:
        text = path.read_text(encoding="utf-8")
        document = loads(text)
        whole = text == rendered(document) and document["@graph"][0]["sha256"] == own_digest(document)
    except FileNotFoundError:
        return None, Check(kind="file", name=CRATE, state="missing")
    except (OSError, ValueError, LookupError, TypeError) as error:
        return None, Check(kind="file", name=CRATE, state="altered", detail=f"it cannot be read ({error})")
    detail = "" if whole else "it does not have the digest that it names"
    return document, Check(kind="file", name=CRATE, state="whole" if whole else "altered", detail=detail)


def _listed(document: Any) -> dict[str, dict[str, Any]]:
    """The facts of the files that a crate names."""
    try:
        listed = files_in(document)
    except (LookupError, TypeError, ValueError):
        return {}
    return {name: {"digest": digest, "size_bytes": size} for name, (digest, size) in listed.items()}


def _records(record: Mapping[str, Any]) -> Iterator[Check]:
    """The records of the steps, each of which names its own digest; and what is said twice, or follows from them."""
    made = set[str]()
    for number, step in enumerate(record["steps"], 1):
        covered = {name: value for name, value in step.items() if name != "digest" and name not in RUN_ONLY}
        whole = digest_of(covered) == step["digest"]
        detail = "" if whole else "it does not have the digest that it names"
        name = f"{number}. {step['step']}"
        yield Check(kind="record", name=name, state="whole" if whole else "altered", detail=detail)
        made |= set(step["outputs"].values())
    for what in ("source", "seed", "commercial_only"):
        recipe = record["recipe"][what]
        if record[what] != (recipe["digest"] if what == "source" else recipe):
            yield Check(kind="record", name=what, state="altered", detail="the recipe names another")
    if record["package"] not in made:
        yield Check(kind="record", name="package", state="altered", detail="no step made it")


def _signatures(folder: Path, record: Mapping[str, Any], anchors: str) -> Iterator[Check]:
    """Every signature that the record names."""
    signed: Mapping[str, Any] = record["signatures"].get("files", {})
    places: dict[str, str | None] = {name: how.get("sidecar") for name, how in signed.items()}
    if record["signatures"]:
        places[CRATE] = sidecar_of(CRATE)
    elif anchors:
        yield Check(kind="signature", name="the package", state="unsigned", detail="nobody signed it")
    for name, sidecar in places.items():
        try:
            found = signature_of(folder / name, folder / sidecar if sidecar else None, anchors)
        except BackendUnavailable as error:
            yield Check(kind="signature", name=name, state="unchecked", detail=str(error))
        except OSError as error:
            yield Check(kind="signature", name=name, state="invalid", detail=f"it cannot be read: {error.strerror}")
        else:
            yield _signature(name, found, bool(anchors))


def _signature(name: str, found: Signature, strict: bool) -> Check:
    """With anchors, a signer whom none of them vouches for is a fault."""
    state: State = found.state
    detail = found.detail or f"signed by {found.signer}"
    if found.state == "untrusted":
        state = "invalid" if strict else "untrusted"
        detail += ", whom none of the given certificates vouches for" if strict else ", whom nothing here vouches for"
    return Check(kind="signature", name=name, state=state, detail=detail)


def _text(path: Path) -> str:
    try:
        text = path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"the trusted certificates {path} cannot be read: {error}") from error
    if "-----BEGIN CERTIFICATE-----" not in text:
        raise BadInput(f"{path} holds no certificate in PEM; give those of whoever you trust, as in ${CERTIFICATE}")
    return text
