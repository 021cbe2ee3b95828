"""What a user asks for, with the files already in the store: enough to make an asset, and to know if it is made."""

import re
from pathlib import Path

from dg4d_lib.errors import BadInput
from dg4d_lib.rasterizer.choice import backend_name, require_backend
from flows import sources
from steps.contract import ArtifactRef, Frozen, digest_of
from steps.main import catalog, request_version
from steps.profiles import PipelineSettings
from steps.store import ArtifactStore
from steps.weights import identities, license_of, open_weights, weights_in, without_paths

LONGEST_NAME = 60  # characters of a name made out of words


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
        require_backend(self.settings.rasterizer)
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
                drawn=bool(self.text),
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
        moving: whether `source` is a video for certain.
    """

    item: str
    source: ArtifactRef
    drawn: bool = False
    moving: bool = False
    bank: ArtifactRef | None = None
    profile: str
    settings: PipelineSettings
    seed: int
    commercial_only: bool = False
    source_name: str = ""
    picture_name: str = ""

    def digest(self) -> str:
        """Equal for orders that give the same package with the code that is installed here."""
        tree = self.settings.model_dump(mode="json")
        return digest_of(
            {
                "source": self.source.digest,
                "drawn": self.drawn,
                "moving": self.moving,
                "bank": self.bank.digest if self.bank else None,
                "settings": tree,
                "weights": identities(weights_in(tree)),
                "rasterizer": backend_name(self.settings.rasterizer),
                "seed": self.seed,
                "commercial_only": self.commercial_only,
                "steps": {name: request_version(spec) for name, spec in catalog().items()},
            }
        )


def name_of(text: str) -> str:
    """A name of an asset, and of its folder, out of words: "A red dragon!" becomes a-red-dragon."""
    name = "-".join(re.findall(r"\w+", text.lower()))[:LONGEST_NAME].strip("-")
    return name or "asset"
