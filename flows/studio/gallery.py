"""Assets of the studio page: finished versions in the store, their verdicts, small pictures and files."""

import functools
import io
import json
import zipfile
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

from pydantic import Field, ValidationError

from dg4d_lib.errors import DG4DError
from flows import home
from flows.engine.versions import FOLDER, Version
from flows.inputs.package_record import record_of
from flows.serving.addresses import VIEWER_ADDRESS
from flows.studio.submission import output_folder
from flows.ui import pages
from steps.contract import ArtifactRef, Frozen
from steps.profiles import PipelineSettings
from steps.store.artifact_store import ArtifactStore, object_name
from steps.store.files import DiskFull, write_atomically

PAGE = 60  # assets on one page of the gallery
THUMBNAIL_SIZES, THUMBNAIL_QUALITIES, THUMBNAIL_BYTES = (384, 256, 128), (80, 60, 40), 40_000
PICTURES = ("preview.webp", "contact_sheet.png")  # of a package, the first that is there
DAYS = {"day": 1, "week": 7, "month": 30}
DOWNLOADS = (  # files of a package that are offered one by one
    "asset.glb", "asset_rigged.glb", "asset_playback.glb", "asset.usdz", "preview.mp4", "turntable.mp4", "preview.webp",
    "contact_sheet.png",
)  # fmt: skip
_versions: dict[tuple[str, float], Version | None] = {}  # by name and time of the record


class Filter(Frozen):
    """Choices of the gallery.

    Attributes:
        search: words that the name contains.
        profile: of the newest version; empty: any.
        verdict: of the newest version; empty: any.
        since: age of the newest version; empty: any.
        page: from 1 on.
    """

    search: str = Field("", max_length=200)
    profile: str = Field("", max_length=40)
    verdict: Literal["", "accepted", "failed", "unknown"] = ""
    since: Literal["", "day", "week", "month"] = ""
    page: int = Field(1, ge=1, le=10_000)

    def takes(self, asset: "Asset", now: datetime) -> bool:
        """Return true if an asset matches the filter."""
        newest = asset.newest
        words = self.search.lower().split()
        return (
            all(word in newest.version.item.lower() for word in words)
            and self.profile in {"", newest.version.profile}
            and self.verdict in {"", newest.verdict}
            and (not self.since or newest.finished > now - timedelta(days=DAYS[self.since]))
        )


@dataclass(frozen=True)
class Shown:
    """One version as the pages show it."""

    version: Version

    @property
    def key(self) -> str:
        """Short name of the version in addresses."""
        return self.version.order.removeprefix("sha256:")[:16]

    @property
    def finished(self) -> datetime:
        """Time at which it was finished."""
        return datetime.fromisoformat(self.version.finished).astimezone(UTC)

    @property
    def thumbnail(self) -> str:
        """Address of a small picture."""
        package = self.version.package
        return f"/dg4d/studio/thumbnails/{package.digest.removeprefix('sha256:')}/{package.size_bytes}"

    @property
    def viewer(self) -> str:
        """Address of the viewer."""
        title = quote(self.version.item.rpartition("/")[2], safe="")
        return pages.address(title, self.version.package, ".html", VIEWER_ADDRESS)

    @property
    def package(self) -> str:
        """Address of the whole package."""
        return pages.address(pages.key("asset", self.version.item), self.version.package, ".zip")

    @property
    def gates(self) -> dict[str, Any] | None:
        """Verdict of the gates; None if it is gone."""
        return _output(self.version, "check_asset", "gates")

    @property
    def verdict(self) -> str:
        """Outcome of the gates: accepted, failed or unknown."""
        gates = self.gates
        return "unknown" if gates is None else "accepted" if gates["accepted"] else "failed"


@dataclass(frozen=True)
class Asset:
    """All versions of one asset, the newest first."""

    versions: tuple[Shown, ...]

    @property
    def newest(self) -> Shown:
        """Version that was finished last."""
        return self.versions[0]

    @property
    def item(self) -> str:
        """Name of the asset."""
        return self.newest.version.item

    @property
    def key(self) -> str:
        """Name of the asset in addresses."""
        return pages.key("asset", self.item)


def assets(store: ArtifactStore) -> list[Asset]:
    """Return all assets of a store, the newest first; damaged records are left out."""
    by_item: dict[str, list[Version]] = {}
    for version in _all_versions(store):
        by_item.setdefault(version.item, []).append(version)
    found = [
        Asset(tuple(Shown(each) for each in sorted(group, key=lambda version: version.finished, reverse=True)))
        for group in by_item.values()
    ]
    return sorted(found, key=lambda asset: asset.newest.version.finished, reverse=True)


def find(store: ArtifactStore, key: str) -> Asset:
    """Return an asset by its name in addresses.

    Raises:
        LookupError: there is none.
    """
    found = next((asset for asset in assets(store) if asset.key == key), None)
    if found is None:
        raise LookupError("there is no such asset; it may have been removed from the store")
    return found


def filtered(found: Sequence[Asset], wanted: Filter) -> list[Asset]:
    """Return the assets that match a filter."""
    now = datetime.now(UTC)
    return [asset for asset in found if wanted.takes(asset, now)]


def page_of(found: Sequence[Asset], number: int) -> Sequence[Asset]:
    """Return the assets of one page."""
    return found[(number - 1) * PAGE : number * PAGE]


def profiles(found: Iterable[Asset]) -> list[str]:
    """Return the profiles of the newest versions."""
    return sorted({asset.newest.version.profile for asset in found})


def thumbnail(ref: ArtifactRef, store: ArtifactStore) -> Path | None:
    """Return a small picture of a package, kept under the studio's folder; None if the package shows none.

    Raises:
        ArtifactMissing: the package is gone.
    """
    small = home.studio() / "thumbnails" / f"{ref.digest.removeprefix('sha256:')}.webp"
    if small.is_file():
        return small
    package = store.path(ref)
    small.parent.mkdir(parents=True, exist_ok=True)
    try:
        with zipfile.ZipFile(package) as archive:
            name = next((name for name in PICTURES if name in archive.namelist()), None)
            picture = io.BytesIO(archive.read(name)) if name else None
        content = picture and pages.small_webp(picture, THUMBNAIL_BYTES, THUMBNAIL_SIZES, THUMBNAIL_QUALITIES)
        if not content:
            return None
        write_atomically(small, content)
    except (zipfile.BadZipFile, DiskFull, OSError):
        return None
    return small


def downloads(version: Shown, store: ArtifactStore) -> list[tuple[str, int]]:
    """Return the files of a package that are offered one by one, with their sizes; none if the package is gone."""
    with (
        suppress(DG4DError, zipfile.BadZipFile, OSError),
        zipfile.ZipFile(store.path(version.version.package)) as archive,
    ):
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
        return [(name, sizes[name]) for name in DOWNLOADS if name in sizes]
    return []


def settings_of(version: Version) -> tuple[PipelineSettings, Path] | None:
    """Return the settings of a version that the page made, and its folder; None for other versions."""
    folders = output_folder(version.item)
    for folder in sorted(folders.iterdir()) if folders.is_dir() else ():
        record = record_of(folder)
        if record is not None and record.get("order") == version.order:
            with suppress(ValidationError, KeyError, TypeError):
                return PipelineSettings.model_validate(record["recipe"]["settings"]), folder
    return None


def _all_versions(store: ArtifactStore) -> list[Version]:
    """Read the records of versions; unchanged ones are parsed once."""
    found = []
    for entry in store.entries(FOLDER):
        key = entry.name, entry.modified
        if key not in _versions:
            content = store.read(entry.name)
            try:
                _versions[key] = None if content is None else Version.model_validate_json(content)
            except ValidationError:  # damaged, or of another version of the program
                _versions[key] = None
        if (version := _versions[key]) is not None:
            found.append(version)
    return found


def _output(version: Version, step: str, port: str) -> dict[str, Any] | None:
    digest = next((each.outputs[port] for each in version.steps if each.label == step and port in each.outputs), None)
    if digest is not None:
        with suppress(ValueError, DG4DError, OSError):
            return _json(home.store().address, digest)
    return None


@functools.lru_cache(4096)
def _json(_store: str, digest: str) -> dict[str, Any]:
    """Return a small JSON artifact; failures are raised, for the cache would keep a returned None.

    Raises:
        ValueError: it is gone or damaged.
        DG4DError: the store does not answer.
    """
    content = home.store().read(object_name(digest))
    tree = None if content is None else json.loads(content)
    if not isinstance(tree, dict):
        raise ValueError(f"{digest} is missing, or is not a JSON object")
    return tree
