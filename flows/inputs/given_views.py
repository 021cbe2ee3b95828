"""Pictures of other sides that a user gives: `--view`, `--turntable` and `--cameras`, checked and stored."""

import tempfile
from collections.abc import Iterable
from pathlib import Path

from dg4d_lib.errors import BadInput
from flows.inputs import naming, sources
from steps.catalog import VIEWS
from steps.contract import ArtifactRef, Frozen
from steps.sources.views import (
    MOST_VIEWS,
    VIEWS_JSON,
    GivenView,
    GivenViews,
    Transforms,
    TransformsFrame,
    check_apart,
    parse_view,
    read_transforms,
)
from steps.store.artifact_store import ArtifactStore

SEVERAL = ";"  # separates views in a cell of a manifest


class ViewFile(Frozen):
    """Picture from one direction.

    Attributes:
        azimuth: degrees, 0 is the input view, 90 the side that it shows on the right.
        elevation: degrees, positive above.
        path: file.
    """

    azimuth: float
    elevation: float = 0.0
    path: Path


class ViewsRequest(Frozen):
    """Views beside the input, by paths.

    Attributes:
        views: pictures and their directions.
        turntable: video, or folder of frames, of the still subject turned once; starts in front.
        cameras: transforms.json of nerfstudio, with pictures or synchronized videos.
    """

    views: tuple[ViewFile, ...] = ()
    turntable: Path | None = None
    cameras: Path | None = None

    def __bool__(self) -> bool:
        return bool(self.views or self.turntable or self.cameras)

    def files(self) -> tuple[Path, ...]:
        """Return the files that are read; those that `cameras` names are in or below its folder."""
        named = (*(view.path for view in self.views), self.turntable, self.cameras)
        return tuple(path for path in named if path is not None)

    def check(self, source: Path | None) -> None:
        """Validate files and directions.

        Args:
            source: file of the input.

        Raises:
            BadInput: says what is wrong and what to do.
        """
        if self.cameras is not None and (self.views or self.turntable):
            raise BadInput("--cameras says where every picture was taken; give it without --view and --turntable")
        if len(self.views) > MOST_VIEWS:
            raise BadInput(f"{len(self.views)} views are given; at most {MOST_VIEWS} are used")
        for path in self.files():
            naming.check_text(path.name, "the file name")
            naming.check_path(path)
        for view in self.views:
            sources.check_file(view.path, "give a picture")
        check_apart([(view.azimuth, view.elevation, view.path.name) for view in self.views])
        if self.turntable is not None:
            sources.check_option(self.turntable, "--turntable")
        if self.cameras is not None:
            for path, _ in _frames(self.cameras):
                naming.check_text(path.name, "the file name")
                sources.check_file(path)
            self._cameras(source)

    def put(self, store: ArtifactStore, source: Path | None) -> ArtifactRef | None:
        """Store the files with their directions; None without any.

        Args:
            store: destination.
            source: file of the input. Its camera is that of the same file, else of the only file with its name, else
                the first one.
        """
        if not self:
            return None
        given = self._given(source)
        with tempfile.TemporaryDirectory(prefix="dg4d-views-") as scratch:
            about = Path(scratch) / VIEWS_JSON
            files = {VIEWS_JSON: about}
            paths = [path for path, _ in self._cameras(source)[1]] if self.cameras else [v.path for v in self.views]
            files |= {view.file: path for view, path in zip(given.views, paths, strict=True)}
            if self.turntable is not None:
                files[given.turntable] = _one_file(self.turntable, store)
            about.write_text(given.model_dump_json(), encoding="utf-8")
            return sources.put_zip(files, VIEWS.media_type, store)

    def _given(self, source: Path | None) -> GivenViews:
        if self.cameras is not None:
            transforms = read_transforms(self.cameras)
            reference, others = self._cameras(source)
            return GivenViews(
                views=tuple(
                    GivenView(file=f"{i:03d}", name=path.name, camera=transforms.camera(frame))
                    for i, (path, frame) in enumerate(others)
                ),
                input_camera=transforms.camera(reference),
            )
        views = tuple(
            GivenView(file=f"{i:03d}", name=view.path.name, azimuth=view.azimuth, elevation=view.elevation)
            for i, view in enumerate(self.views)
        )
        return GivenViews(views=views, turntable="turntable" if self.turntable else "")

    def _cameras(self, source: Path | None) -> tuple[TransformsFrame, list[tuple[Path, TransformsFrame]]]:
        """Return the frame of the input and those of the other cameras, with their files.

        Raises:
            BadInput: several cameras may be that of the input.
        """
        assert self.cameras is not None
        frames = _frames(self.cameras)
        found: list[int] = []
        if source is not None:
            same = [i for i, (path, _) in enumerate(frames) if path.resolve() == source.resolve()]
            found = same[:1] or [i for i, (path, _) in enumerate(frames) if path.name == source.name]
            if len(found) > 1:
                raise BadInput(
                    f"{self.cameras.name} names {len(found)} files {source.name}, and the input has their name but "
                    "is not one of them; give one of them as the input, or rename it"
                )
        own = found[0] if found else 0
        return frames[own][1], frames[:own] + frames[own + 1 :]


def parse_views(texts: Iterable[str]) -> tuple[ViewFile, ...]:
    """Parse values of `--view`, each `AZIMUTH[,ELEVATION]=FILE`.

    Raises:
        BadInput: one is not of this form.
    """
    parsed = [parse_view(text) for text in texts]
    return tuple(ViewFile(azimuth=azimuth, elevation=up, path=Path(file)) for azimuth, up, file in parsed)


def views_in_cell(text: str, root: Path) -> tuple[ViewFile, ...]:
    """Parse the column `views` of a manifest, `90=right.png; 180=back.png`, with files below its folder.

    Raises:
        BadInput: it is not of this form, or a file leads out of the folder.
    """
    parsed = [parse_view(part) for part in text.split(SEVERAL) if part.strip()]
    return tuple(
        ViewFile(azimuth=azimuth, elevation=up, path=sources.resolve_inside(root, file, "views"))
        for azimuth, up, file in parsed
    )


def _frames(cameras: Path) -> list[tuple[Path, TransformsFrame]]:
    """Return the files of a transforms.json, below its folder, with their cameras."""
    transforms: Transforms = read_transforms(cameras)
    return [
        (_existing(sources.resolve_inside(cameras.parent, frame.file_path, "file_path")), frame)
        for frame in transforms.frames
    ]


def _existing(path: Path) -> Path:
    """Return the file, with .png added where the name has no suffix, as in synthetic NeRF data."""
    return path if path.suffix or path.exists() else path.with_suffix(".png")


def _one_file(path: Path, store: ArtifactStore) -> Path:
    """Return a video, or a folder of frames as one zip."""
    if not path.is_dir():
        return path
    return store.path(sources.put_source(path, store))
