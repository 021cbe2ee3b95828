"""What a user asks for, with the files already in the store: enough to make an asset, and to know if it is made."""

from pathlib import Path

from dg4d_lib.errors import BadInput
from flows import sources
from steps.contract import ArtifactRef, Frozen, digest_of
from steps.main import catalog, request_version
from steps.profiles import PipelineSettings
from steps.store import ArtifactStore


class Wish(Frozen):
    """What a user asks for, by paths.

    Attributes:
        item: name of the asset.
        picture: a picture or a video.
        video: a video or a folder of frames that the asset follows; then `picture` only names it.
        bank: a folder of true views, for the oracle prior.
    """

    item: str
    picture: Path
    video: Path | None = None
    bank: Path | None = None
    profile: str = "preview"
    settings: PipelineSettings
    seed: int = 0

    def check(self) -> None:
        """Refuse what cannot work, before any work.

        Raises:
            BadInput: says what is wrong and what to do.
        """
        sources.check_file(self.picture)
        if self.video is not None:
            sources.check_video(self.video)
        if self.bank is not None:
            sources.check_bank(self.bank)
        oracle = self.settings.prior.kind == "oracle"
        if oracle and self.bank is None:
            raise BadInput("prior.kind=oracle needs the true views: --bank DIR")
        if not oracle and self.bank is not None:
            raise BadInput("--bank is read by the oracle prior only: add --set prior.kind=oracle")

    def order(self, store: ArtifactStore) -> "Order":
        """Put the files into the store.

        Raises:
            BadInput: a file cannot be read, or there is no room.
        """
        footage = self.video or self.picture
        try:
            return Order(
                item=self.item,
                source=sources.put_source(footage, store),
                moving=self.video is not None or footage.suffix.lower() in sources.ALWAYS_MOVING,
                bank=sources.put_bank(self.bank, store) if self.bank is not None else None,
                profile=self.profile,
                settings=self.settings,
                seed=self.seed,
                source_name=footage.name,
                picture_name=self.picture.name if self.video is not None else "",
            )
        except OSError as error:
            raise BadInput(f"{footage} cannot be read: {error.strerror or error}") from error


class Order(Frozen):
    """What a user asks for, by content; names are for people and do not count."""

    item: str
    source: ArtifactRef
    moving: bool
    bank: ArtifactRef | None = None
    profile: str
    settings: PipelineSettings
    seed: int
    source_name: str = ""
    picture_name: str = ""

    def digest(self) -> str:
        """Equal for orders that give the same package with the code that is installed here."""
        return digest_of(
            {
                "source": self.source.digest,
                "moving": self.moving,
                "bank": self.bank.digest if self.bank else None,
                "settings": self.settings.model_dump(mode="json"),
                "seed": self.seed,
                "steps": {name: request_version(spec) for name, spec in catalog().items()},
            }
        )
