"""What a user asks for, with the files already in the store: enough to make an asset, and to know if it is made."""

import re
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.rasterizer.backends import backend_name, require_backend
from flows.inputs import naming, sources
from flows.inputs.signing_key import certificate
from steps.contract import LARGEST_SEED, ArtifactRef, Frozen, digest_of
from steps.profiles import PipelineSettings
from steps.runtime.installed_code import catalog, request_version
from steps.runtime.weights import identities, license_of, open_weights, weights_in, without_paths
from steps.store.artifact_store import ArtifactStore

LONGEST_NAME = 60  # characters of a name made out of words
NAMES = {"item", "profile", "source_name", "picture_name"}  # of an order: for people, no part of its digest


class Wish(Frozen):
    """What a user asks for, by paths.

    Attributes:
        item: name of the asset.
        picture: a picture or a video; None where `text` says what to make.
        text: words, of which a picture is drawn.
        video: a video or a folder of frames that the asset follows; then `picture` only names it.
        bank: a folder of true views, for the oracle prior.
        commercial_only: refuse weights whose license forbids commercial use.
    """

    item: str
    picture: Path | None = None
    text: str = ""
    video: Path | None = None
    bank: Path | None = None
    profile: str = "preview"
    settings: PipelineSettings
    seed: int = 0
    commercial_only: bool = False

    @property
    def source_name(self) -> str:
        """What people call the source."""
        footage = self._footage()
        return footage.name if footage else f'"{self.text}"'

    def check(self) -> None:
        """Refuse what cannot work, before any work.

        Raises:
            BadInput: says what is wrong and what to do.
            BackendUnavailable: the rasterizer that was asked for cannot run here, or weights are missing.
        """
        self.check_names()
        if not 0 <= self.seed <= LARGEST_SEED:
            raise BadInput(f"the seed {self.seed} is out of range; use 0 to {LARGEST_SEED}")
        require_backend(self.settings.rasterizer)
        if (self.settings.pack.lods or self.settings.pack.gltf.meshopt) and not find_spec("meshoptimizer"):
            raise BackendUnavailable("pack.lods and pack.gltf.meshopt need meshoptimizer: `deploy/install.sh meshopt`")
        self._check_source()
        if self.bank is not None:
            sources.check_bank(self.bank)
        oracle = self.settings.prior.kind == "oracle"
        if oracle and self.bank is None:
            raise BadInput("prior.kind=oracle needs the true views: --bank DIR")
        if not oracle and self.bank is not None:
            raise BadInput("--bank is read by the oracle prior only: add --set prior.kind=oracle")
        self.check_licenses()
        for name in self._weights():
            open_weights(name)

    def check_names(self) -> None:
        """Refuse names that folders, records or pages could not hold.

        Raises:
            BadInput: says which and why.
        """
        for path in (self.picture, self.video):
            if path is not None:
                naming.check_text(path.name, "the file name")
        for path in (self.picture, self.video, self.bank):
            if path is not None:
                naming.check_path(path)
        naming.check_text(self.text, "the text")
        naming.check_name(self.item, "rename the file" if self.picture else "choose a shorter name")

    def check_licenses(self) -> None:
        """Refuse weights that forbid commercial use, where only what allows it is wanted.

        Raises:
            BadInput: says which, and what their licenses are.
        """
        licenses = {name: license_of(name) for name in self._weights()} if self.commercial_only else {}
        if refused := [f"{name} ({its})" for name, its in licenses.items() if not its.allows_commercial_use]:
            raise BadInput(
                f"--commercial-only: the settings name weights that may not be used commercially: {'; '.join(refused)}"
            )

    def order(self, store: ArtifactStore) -> "Order":
        """Put the files into the store.

        Raises:
            BadInput: a file cannot be read, or there is no room.
        """
        footage = self._footage()
        try:
            return Order(
                item=self.item,
                source=sources.put_source(footage, store) if footage else sources.put_text(self.text, store),
                text=sources.plain(self.text),
                moving=self._suffix() in sources.ALWAYS_MOVING or self.video is not None,
                bank=sources.put_bank(self.bank, store) if self.bank is not None else None,
                profile=self.profile,
                settings=PipelineSettings.model_validate(without_paths(self.settings.model_dump(mode="json"))),
                seed=self.seed,
                commercial_only=self.commercial_only,
                source_name=self.source_name,
                picture_name=self.picture.name if self.picture and self.video else "",
            )
        except OSError as error:
            raise BadInput(f"{footage} cannot be read: {error.strerror or error}") from error

    def _footage(self) -> Path | None:
        """The file or folder that is looked at."""
        return self.video or self.picture

    def _suffix(self) -> str:
        footage = self._footage()
        return footage.suffix.lower() if footage else ""

    def _check_source(self) -> None:
        if self.text:
            sources.check_text(self.text)
            if self.picture is not None or self.video is not None:
                raise BadInput("--text makes the picture; give words, or a picture or video, not both")
            if not self.settings.text.weights:
                raise BadInput(
                    "--text needs a text-to-image pipeline: --set text.weights=FOLDER (in the layout of diffusers), or "
                    "an id of the Hugging Face hub"
                )
            return
        if self.picture is None:
            raise BadInput("nothing to make: give a picture, a video or --text")
        sources.check_file(self.picture)
        if self.video is not None:
            sources.check_video(self.video)

    def _weights(self) -> list[str]:
        """The weights that some step will load: those for words and for made-up motions only where there are any."""
        tree = self.settings.model_dump(mode="json")
        if not self.text:
            del tree["text"]
        if self.video is not None or self._suffix() in sources.VIDEOS:
            del tree["driving"]
        return list(weights_in(tree))


class Order(Frozen):
    """What a user asks for, by content; names are for people and do not count.

    Attributes:
        source: a picture, a video, the frames of one; words if `drawn`.
        text: those words.
        moving: whether `source` is a video for certain.
    """

    item: str
    source: ArtifactRef
    text: str = ""
    moving: bool = False
    bank: ArtifactRef | None = None
    profile: str
    settings: PipelineSettings
    seed: int = Field(ge=0, le=LARGEST_SEED)
    commercial_only: bool = False
    source_name: str = ""
    picture_name: str = ""

    @property
    def drawn(self) -> bool:
        """Whether a model draws the picture out of words."""
        return bool(self.text)

    def recipe(self) -> dict[str, Any]:
        """Everything that the same code needs to make the same package, as JSON; names for people are left out."""
        recipe = self.model_dump(mode="json", exclude=NAMES)
        return recipe | {"settings": {**recipe["settings"], "rasterizer": backend_name(self.settings.rasterizer)}}

    def digest(self) -> str:
        """Equal for orders that give the same package with the code and the signing key that are here."""
        recipe = self.recipe()
        return digest_of(
            {
                **recipe,
                "weights": identities(weights_in(recipe["settings"])),
                "steps": {name: request_version(spec) for name, spec in catalog().items()},
                "certificate": certificate(),
            }
        )


def order_again(
    record: Mapping[str, Any], store: ArtifactStore, source: Path | None = None, bank: Path | None = None
) -> Order:
    """The order that a package was made from.

    Args:
        record: the provenance of the package.
        store: where the source is, or goes.
        source: the picture, the video or the folder of frames; needed where the store does not have it.
        bank: the folder of true views; likewise.

    Raises:
        BadInput: the record is of another version, something is needed, or what was given is something else; says what.
    """
    try:
        names = {name: record[name] for name in NAMES & set(record)}
        order = Order.model_validate({**record["recipe"], **record["run"].get("names", {}), **names})
    except (KeyError, TypeError, AttributeError, ValidationError) as error:
        reason = f"{type(error).__name__}: {error}"
        if isinstance(error, ValidationError):
            reason = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise BadInput(
            f"the record of this package was written by another version of dg4d ({reason}); "
            "make the asset again from its source"
        ) from error
    require_backend(order.settings.rasterizer)
    if order.text:
        sources.put_text(order.text, store)
    if source is not None:
        sources.check_video(source)
        _require_same(source, sources.put_source(source, store), order.source)
    if bank is not None and order.bank is not None:
        sources.check_bank(bank)
        _require_same(bank, sources.put_bank(bank, store), order.bank)
    for option, ref in (("--source", order.source), ("--bank", order.bank)):
        if ref is not None and not store.has(ref):
            raise BadInput(f"what this package was made from ({ref.digest}) is not in the store: give it with {option}")
    return order


def _require_same(path: Path, given: ArtifactRef, recorded: ArtifactRef) -> None:
    if given.digest != recorded.digest:
        raise BadInput(
            f"{path} is not what this package was made from: its digest is {given.digest}, "
            f"that in the record {recorded.digest}"
        )


def name_of(text: str) -> str:
    """A name of an asset, and of its folder, out of words: "A red dragon!" becomes a-red-dragon."""
    name = "-".join(re.findall(r"\w+", text.lower()))[:LONGEST_NAME].strip("-")
    return name or "asset"
