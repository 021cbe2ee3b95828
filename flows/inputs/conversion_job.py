"""Conversion requests by path, and conversion jobs by content."""

import re
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.rasterizer.backends import backend_name, require_backend
from flows.inputs import models, naming, sources
from flows.inputs.given_views import ViewsRequest
from flows.inputs.signing_key import certificate_digest
from steps.catalog import STEPS
from steps.contract import LARGEST_SEED, ArtifactRef, Frozen, digest_of
from steps.profiles import PipelineSettings, is_read, profile
from steps.runtime.installed_code import catalog, request_version
from steps.runtime.weights import identities, license_of, require_weights, weights_in, without_paths
from steps.sources.media_types import is_video
from steps.store.artifact_store import ArtifactStore

LONGEST_NAME = 60  # characters of a name made from a prompt
SHAPE_STEPS = {"draw_picture", "prepare_views", "generate_views", "fit_gaussians", "fit_motion"}  # not with `--asset`
MESH_STEPS = {"plan_mesh", "extract_mesh"}  # not with a mesh as `--asset`
NAMES = {"item", "profile", "source_name", "picture_name"}  # display names; not part of the digest


class ConversionRequest(Frozen):
    """Conversion request of a user, by paths.

    Attributes:
        item: name of the asset.
        picture: picture or video; None with `text`.
        text: prompt for a text-to-image model.
        video: driving video or folder of frames; then `picture` only names the asset.
        bank: folder of ground-truth views, for the oracle prior.
        mask: picture, or folder of frames for a video, that is white where the subject is.
        depth: picture of the depth of the first frame.
        layers: picture of the order of parts in depth in the first frame.
        given_views: pictures of other sides.
        asset: model of the user's own, a mesh or splats, that is set in motion.
        commercial_only: refuse weights whose license forbids commercial use.
    """

    item: str
    picture: Path | None = None
    text: str = ""
    video: Path | None = None
    bank: Path | None = None
    mask: Path | None = None
    depth: Path | None = None
    layers: Path | None = None
    given_views: ViewsRequest = ViewsRequest()
    asset: Path | None = None
    profile: str = "preview"
    settings: PipelineSettings
    seed: int = 0
    commercial_only: bool = False

    @property
    def source_name(self) -> str:
        """Name of the source, for people."""
        path = self._footage or self.asset
        return path.name if path else f'"{self.text}"'

    @property
    def has_motion(self) -> bool:
        """True if the source is a video, whose motion is followed."""
        return self._must_move or (self._footage is not None and is_video(self._footage))

    def unused(self) -> list[str]:
        """Return notes about inputs and settings that have no effect."""
        found = []
        if self.picture is not None and self.video is not None:
            found.append(f"{self.picture.name} only names the asset: the subject is that of {self.video.name}")
        if self.has_motion and self.settings.driving != profile(self.profile).driving:
            found.append(f"driving.* settings have no effect: the motion is that of {self.source_name}")
        if self.asset is not None and (names := self._unread(self.asset)):
            found.append(f"settings without an effect: {', '.join(names)}; {self.asset.name} keeps its own shape")
        return found

    def _unread(self, asset: Path) -> list[str]:
        """Return the changed settings that no step reads if the user's own model is animated; whole sections as `*`."""
        steps = STEPS.keys() - SHAPE_STEPS - (set() if models.holds_splats(asset) else MESH_STEPS)
        before = dict(_leaves(profile(self.profile).model_dump(mode="json")))
        now = dict(_leaves(self.settings.model_dump(mode="json")))
        read = {name.partition(".")[0] for name in now if is_read(name, steps)}
        changed = [name for name, value in now.items() if before.get(name) != value and not is_read(name, steps)]
        sections = [(name, name.partition(".")[0]) for name in changed]
        return list(dict.fromkeys(name if section in read else f"{section}.*" for name, section in sections))

    def check(self) -> None:
        """Validate the request before any work.

        Raises:
            BadInput: says what is wrong and what to do.
            BackendUnavailable: the chosen rasterizer cannot run here, or weights are missing.
        """
        self.check_names()
        if not 0 <= self.seed <= LARGEST_SEED:
            raise BadInput(f"the seed {self.seed} is out of range; use 0 to {LARGEST_SEED}")
        require_backend(self.settings.rasterizer)
        if (self.settings.pack.lods or self.settings.pack.gltf.meshopt) and not find_spec("meshoptimizer"):
            raise BackendUnavailable("pack.lods and pack.gltf.meshopt need meshoptimizer: `deploy/install.sh meshopt`")
        if self.asset is not None:
            self._check_asset(self.asset)
        self._check_source()
        if self.mask is not None:
            sources.check_option(self.mask, "--mask", "give a picture, or a folder of frames for a video")
        self._check_depth()
        self.given_views.check(self._footage)
        if self.given_views and self.text:
            raise BadInput("--view, --turntable and --cameras show the sides of a picture; --text has none to show")
        if self.bank is not None:
            sources.check_bank(self.bank)
        oracle = self.settings.prior.kind == "oracle"
        if oracle and self.bank is None:
            raise BadInput("prior.kind=oracle needs ground-truth views: --bank DIR")
        if not oracle and self.bank is not None:
            raise BadInput("only the oracle prior reads --bank: add --set prior.kind=oracle")
        if self.settings.pack.fps and self.settings.mesh.mode == "per_frame" and self.asset is None:
            raise BadInput(
                f"pack.fps={self.settings.pack.fps:g} resamples the motion of one mesh, and mesh.mode=per_frame makes "
                "a mesh per frame of the driving video; leave pack.fps (--fps) out, or add --set mesh.mode=tracked"
            )
        self.check_licenses()
        require_weights(self._weights())

    def check_names(self) -> None:
        """Refuse names that folders, records or pages cannot hold.

        Raises:
            BadInput: says which and why.
        """
        for path in filter(None, (self.picture, self.video, self.asset)):
            naming.check_text(path.name, "the file name")
        for path in filter(None, (self.picture, self.video, self.bank, self.mask, self.depth, self.layers, self.asset)):
            naming.check_path(path)
        naming.check_text(self.text, "the text")
        naming.check_name(self.item, "rename the file" if self._footage or self.asset else "choose a shorter name")

    def check_licenses(self) -> None:
        """Refuse weights that forbid commercial use if `commercial_only` is set.

        Raises:
            BadInput: names them and their licenses.
        """
        licenses = {name: license_of(name) for name in self._weights()} if self.commercial_only else {}
        if refused := [f"{name} ({its})" for name, its in licenses.items() if not its.allows_commercial_use]:
            raise BadInput(
                f"--commercial-only: the settings name weights that may not be used commercially: {'; '.join(refused)}"
            )

    def license_conditions(self) -> list[str]:
        """Return a sentence for all weights of the request whose license allows commercial use under conditions."""
        licenses = {name: license_of(name) for name in self._weights()}
        return [f"license of {name}: {its}" for name, its in licenses.items() if its.commercial == "conditions"]

    def to_job(self, store: ArtifactStore) -> "ConversionJob":
        """Put the files into the store and return the job.

        Raises:
            BadInput: a file cannot be read, or the disk is full.
        """
        footage = self._footage
        try:
            asset = models.put_model(self.asset, store) if self.asset is not None else None
            return ConversionJob(
                item=self.item,
                source=self._put_source(asset, store),
                asset=asset,
                text=sources.single_spaced(self.text),
                moving=self._must_move,
                bank=sources.put_bank(self.bank, store) if self.bank is not None else None,
                mask=sources.put_source(self.mask, store) if self.mask is not None else None,
                depth=sources.put_still(self.depth, store) if self.depth is not None else None,
                layers=sources.put_still(self.layers, store) if self.layers is not None else None,
                views=self.given_views.put(store, footage),
                profile=self.profile,
                settings=PipelineSettings.model_validate(without_paths(self.settings.model_dump(mode="json"))),
                seed=self.seed,
                commercial_only=self.commercial_only,
                source_name=self.source_name,
                picture_name=self.picture.name if self.picture and self.video else "",
            )
        except OSError as error:
            raise BadInput(f"{footage} cannot be read: {error.strerror or error}") from error

    def _put_source(self, asset: ArtifactRef | None, store: ArtifactStore) -> ArtifactRef:
        """Store picture, video or prompt; a model without any is its own source."""
        if self._footage is not None:
            return sources.put_source(self._footage, store)
        return asset or sources.put_text(self.text, store)

    @property
    def _footage(self) -> Path | None:
        """File or folder that is read."""
        return self.video or self.picture

    @property
    def _must_move(self) -> bool:
        """True if a source that turns out to be a single picture is refused."""
        return self.video is not None or (
            self.picture is not None and self.picture.suffix.lower() in sources.ALWAYS_MOVING
        )

    def _check_asset(self, asset: Path) -> None:
        models.check_model(asset)
        if self.text:
            raise BadInput("--asset is moved by a picture, a video, or a motion of its own; leave --text out")
        if self.given_views:
            raise BadInput(
                f"--asset: {asset.name} has all sides of the subject, and --view, --turntable or --cameras show them, "
                "too; give the model, or the pictures, not both"
            )
        if self.mask is not None and self._footage is None:
            raise BadInput("--mask marks the subject of a picture or video, and --asset is given alone; leave it out")

    def _check_depth(self) -> None:
        """Check a depth picture or layers: one of them, for a picture whose depth is a guess."""
        given = {option: path for option, path in (("--depth", self.depth), ("--layers", self.layers)) if path}
        for option, path in given.items():
            sources.check_still_file(path, option)
            if self.text:
                raise BadInput(f"{option} shows the depth of a picture or video of yours, and --text has none")
            if self.asset is not None or self.given_views:
                other = "--asset" if self.asset is not None else "--view, --turntable or --cameras"
                raise BadInput(
                    f"{option} cannot be combined with {other}, from which the shape is known already; leave one out"
                )
        if len(given) > 1:
            raise BadInput(
                "--depth and --layers cannot be combined; keep --depth if it is accurate, otherwise --layers"
            )

    def _check_source(self) -> None:
        if self.text:
            sources.check_text(self.text)
            if self.mask is not None:
                raise BadInput("--mask marks the subject of a picture or video of yours, and --text has none")
            if self.picture is not None or self.video is not None:
                raise BadInput("--text makes the picture; give a prompt, or a picture or video, not both")
            if not self.settings.text.weights:
                raise BadInput(
                    "--text needs a text-to-image pipeline: --set text.weights=FOLDER (in the layout of diffusers), or "
                    "the id of a Hugging Face repository"
                )
            return
        if self.video is not None:
            sources.check_option(self.video, "--video")
        if self.picture is not None:
            sources.check_file(self.picture)
        elif self.video is None and self.asset is None:
            raise BadInput("nothing to make: give a picture, a video or --text")

    def _weights(self) -> list[str]:
        """Return the weights that some step will load: text and driving models only if a step uses them."""
        tree = self.settings.model_dump(mode="json")
        if not self.text:
            del tree["text"]
        if self.has_motion:
            del tree["driving"]
        return list(weights_in(tree))


class ConversionJob(Frozen):
    """Conversion job, by content; names are for people and not part of its digest.

    Attributes:
        source: picture, video, or frames; the prompt if `generates_picture`.
        text: that prompt.
        views: pictures of other sides.
        moving: True if `source` is certainly a video.
        mask: picture or frames that mark the subject, if given.
        depth: picture of the depth of the first frame, if given.
        layers: picture of the order of its parts in depth, if given.
        asset: model of the user's own; equal to `source` if nothing else was given.
    """

    item: str
    source: ArtifactRef
    text: str = ""
    moving: bool = False
    bank: ArtifactRef | None = None
    mask: ArtifactRef | None = None
    depth: ArtifactRef | None = None
    layers: ArtifactRef | None = None
    views: ArtifactRef | None = None
    asset: ArtifactRef | None = None
    profile: str
    settings: PipelineSettings
    seed: int = Field(ge=0, le=LARGEST_SEED)
    commercial_only: bool = False
    source_name: str = ""
    picture_name: str = ""

    @property
    def generates_picture(self) -> bool:
        """True if a text-to-image model generates the picture."""
        return bool(self.text)

    def given(self) -> dict[str, ArtifactRef]:
        """Return the artifacts that the user gave, by role."""
        roles = ("source", "bank", "mask", "depth", "layers", "views", "asset")
        found = {role: getattr(self, role) for role in roles}
        return {role: ref for role, ref in found.items() if ref is not None}

    def recipe(self) -> dict[str, Any]:
        """Return all inputs that determine the package with given code, as JSON, without names for people."""
        recipe = self.model_dump(mode="json", exclude=NAMES)
        return recipe | {"settings": {**recipe["settings"], "rasterizer": backend_name(self.settings.rasterizer)}}

    def digest(self) -> str:
        """Return a digest that is equal for jobs with the same package under the installed code and signing key."""
        recipe = self.recipe()
        return digest_of(
            {
                **recipe,
                "weights": identities(weights_in(recipe["settings"])),
                "steps": {name: request_version(spec) for name, spec in catalog().items()},
                "certificate": certificate_digest(),
            }
        )


def job_from_record(
    record: Mapping[str, Any],
    store: ArtifactStore,
    source: Path | None = None,
    bank: Path | None = None,
    mask: Path | None = None,
    depth: Path | None = None,
    layers: Path | None = None,
    asset: Path | None = None,
) -> ConversionJob:
    """Return the job that made a package.

    Args:
        record: provenance of the package.
        store: has the source, or receives it.
        source: picture, video or folder of frames; this and the next five are needed if the store no longer has them.
        bank: folder of ground-truth views.
        mask: picture or folder of frames that marks the subject.
        depth: picture of its depth.
        layers: picture of the order of its parts in depth.
        asset: model of the user's own.

    Raises:
        BadInput: the record has another format, a file is needed, or a given file differs from the recorded one.
    """
    try:
        names = {name: record[name] for name in NAMES & set(record)}
        job = ConversionJob.model_validate({**record["recipe"], **record["run"].get("names", {}), **names})
    except (KeyError, TypeError, AttributeError, ValidationError) as error:
        reason = f"{type(error).__name__}: {error}"
        if isinstance(error, ValidationError):
            reason = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise BadInput(
            f"the record of this package was written by another version of dg4d ({reason}); make the asset again from "
            "its source"
        ) from error
    require_backend(job.settings.rasterizer)
    if job.text:
        sources.put_text(job.text, store)
    for option, path, ref, put in (
        ("--asset", asset, job.asset, models.put_model),  # may be the source, too
        ("--source", source, job.source, sources.put_source),
        ("--bank", bank, job.bank, sources.put_bank),
        ("--mask", mask, job.mask, sources.put_source),
        ("--depth", depth, job.depth, sources.put_still),
        ("--layers", layers, job.layers, sources.put_still),
    ):
        if ref is None:
            continue
        if path is not None and (given := put(path, store).digest) != ref.digest:
            raise BadInput(f"{path} is not the source of this package: its digest is {given}, recorded {ref.digest}")
        if not store.has(ref):
            raise BadInput(f"the source of this package ({ref.digest}) is not in the store: give it with {option}")
    if job.views is not None and not store.has(job.views):
        raise BadInput(
            f"the views of this package ({job.views.digest}) are not in the store; make the asset again with its "
            "--view, --turntable or --cameras"
        )
    return job


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested settings with their dotted names."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def name_from_text(text: str) -> str:
    """Return a name for an asset and its folder: "A red dragon!" becomes a-red-dragon."""
    name = "-".join(re.findall(r"\w+", text.lower()))[:LONGEST_NAME].strip("-")
    return name or "asset"
