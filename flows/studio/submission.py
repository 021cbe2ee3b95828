"""Submissions of the studio page: a draft and choices become a deployment with its parameters."""

import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import Motion
from flows import home
from flows.inputs.manifest import parse_changes
from flows.inputs.naming import check_name, clean_name
from flows.studio.drafts import Draft, Upload
from flows.ui import pages
from steps.contract import LARGEST_SEED, Frozen
from steps.profiles import ProfileName, profile, revise

MOST_VIEWS = 63
GPU = " on a GPU"
Setting = Annotated[str, Field(pattern=r"^\s*[a-z_]+(\.[a-z_0-9]+)*\s*=", max_length=1000)]


class SideView(Frozen):
    """Picture of another side.

    Attributes:
        file: name of a file of the draft.
        azimuth: degrees; 0 is the input view, positive to the subject's left.
        elevation: degrees.
    """

    file: str
    azimuth: float = Field(ge=-360, le=360, allow_inf_nan=False)
    elevation: float = Field(0.0, ge=-90, le=90, allow_inf_nan=False)


class Submission(Frozen):
    """Choices on the page of a draft.

    Attributes:
        name: of the asset; empty: that of the file.
        masked: true if the matte that the page drew is used.
        batch: true for an asset of every file.
    """

    name: str = Field("", max_length=200)
    profile: ProfileName = "preview"
    seed: int = Field(0, ge=0, le=LARGEST_SEED)
    motion: Motion | None = None
    box: tuple[Annotated[int, Field(ge=0, le=1_000_000)], ...] = Field((), max_length=4)
    masked: bool = False
    views: tuple[SideView, ...] = Field((), max_length=MOST_VIEWS)
    settings: tuple[Setting, ...] = Field((), max_length=100)
    commercial_only: bool = False
    batch: bool = False


class RunRequest(NamedTuple):
    """Run to be started.

    Attributes:
        deployment: FLOW/NAME.
        name: of the run.
        parameters: of the flow.
        tags: of the run, besides that of the page.
    """

    deployment: str
    name: str
    parameters: dict[str, Any]
    tags: tuple[str, ...]


def convert(draft: Draft, wanted: Submission) -> RunRequest:
    """Return the run that converts a draft.

    Raises:
        BadInput: the draft has no files, or choices contradict each other.
        LookupError: a view is not among the files.
        DiskFull: there is no room.
    """
    revise(profile(wanted.profile), parse_changes(_lines(wanted)))  # refuses settings before a run starts
    if wanted.batch:
        return _batch(draft, wanted)
    first, key = draft.first(), secrets.token_hex(6)
    item = _item(wanted.name or first.path.stem)
    # always with a suffix, because the name of the asset is the file's without it, and may have dots
    source = str(draft.link(key, item + (first.path.suffix or f".{first.kind}"), first.path))
    parameters: dict[str, Any] = {"out": str(output_folder(item) / key)}
    parameters["options"] = _options(wanted, with_motion=first.kind != "video")
    flow, title = f"{first.kind}-to-4d", first.kind.capitalize()
    parameters[first.kind] = source
    if first.kind == "model":
        companion = next((each for each in draft.uploads() if each.kind != "model"), None)
        if companion is not None:
            parameters["picture"] = str(draft.link(key, f"picture-{companion.name}", companion.path))
    else:
        parameters["cutout"] = {"mask": _mask(draft, wanted, first, key)}
        parameters["sides"] = {"views": [_view(draft, view, first, key) for view in wanted.views]}
    return RunRequest(_deployment(flow, title, wanted.profile), item, parameters, (draft_tag(draft), asset_tag(item)))


def _batch(draft: Draft, wanted: Submission) -> RunRequest:
    """Return the run that makes an asset of every file."""
    files = draft.uploads()
    if any(each.kind == "model" for each in files):
        raise BadInput("a batch takes pictures and videos; drop models one at a time")
    if not files:
        raise BadInput("this draft has no files yet; drop a folder of pictures")
    name, key = _item(wanted.name or f"batch of {len(files)}"), secrets.token_hex(6)
    parameters = {
        "inputs": str(draft.write_manifest(key)),
        "out": str(home.studio_assets() / f"batch-{key}"),
        "options": _options(wanted, with_motion=True),
    }
    return RunRequest(_deployment("catalog-to-4d", "Catalog", wanted.profile), name, parameters, (draft_tag(draft),))


def repetition(run: Mapping[str, Any], settings: tuple[str, ...], seed: int | None = None) -> RunRequest:
    """Return a repetition of an earlier run with changed settings, into a folder of its own.

    Args:
        run: flow run that the page started.
        settings: NAME=VALUE, which win over those of the run.
        seed: other seed.
    """
    parameters = {**run["parameters"]}
    options = dict(parameters.get("options") or {})
    names = {line.partition("=")[0].strip() for line in settings}
    kept = [line for line in options.get("settings", ()) if line.partition("=")[0].strip() not in names]
    options["settings"] = [*kept, *settings]
    if seed is not None:
        options["seed"] = seed
    parameters["options"] = options
    parameters["out"] = str(Path(parameters["out"]).with_name(secrets.token_hex(6)))
    return _same_deployment(run, parameters)


def retry(run: Mapping[str, Any]) -> RunRequest:
    """Return a run equal to an earlier one; it resumes after the last finished step."""
    return _same_deployment(run, dict(run["parameters"]))


def output_folder(item: str) -> Path:
    """Return the folder of all conversions of an asset that the page started."""
    return home.studio_assets() / pages.key("asset", item)


def draft_tag(draft: Draft) -> str:
    """Return the tag of runs that convert a draft."""
    return f"draft-{draft.identifier}"


def asset_tag(item: str) -> str:
    """Return the tag of runs that make an asset."""
    return pages.key("asset", item)


def _same_deployment(run: Mapping[str, Any], parameters: dict[str, Any]) -> RunRequest:
    source = next(name for name in ("model", "picture", "video", "inputs") if name in parameters)
    flow = "catalog" if source == "inputs" else source
    deployment = _deployment(f"{flow}-to-4d", flow.capitalize(), parameters["options"]["profile"])
    tags = tuple(tag for tag in run["tags"] if tag.startswith(("draft-", "asset-")))
    item = str(run["name"]) if source == "inputs" else Path(parameters[source]).stem
    return RunRequest(deployment, item, parameters, tags)


def _deployment(flow: str, title: str, profile_name: str) -> str:
    """Return the deployment of a flow; profiles other than `preview` need a GPU."""
    return f"{flow}/{title} to 4D{'' if profile_name == 'preview' else GPU}"


def _options(wanted: Submission, with_motion: bool) -> dict[str, Any]:
    options: dict[str, Any] = {
        "profile": wanted.profile,
        "seed": wanted.seed,
        "commercial_only": wanted.commercial_only,
        "settings": _lines(wanted),
    }
    return options | ({"motion": wanted.motion} if wanted.motion and with_motion else {})


def _lines(wanted: Submission) -> list[str]:
    """Return the settings as `--set` takes them; a matte has been drawn within the box already."""
    box = [f"subject.box=[{','.join(map(str, wanted.box))}]"] if wanted.box and not wanted.masked else []
    return [*box, *wanted.settings]


def _mask(draft: Draft, wanted: Submission, first: Upload, key: str) -> str:
    """Return the path of the mask for one conversion; empty if there is none."""
    if not wanted.masked:
        return ""
    if first.kind != "picture":
        raise BadInput("the brush works on pictures only; draw a box, which applies to all frames of a video")
    return str(draft.link(key, "mask.png", draft.saved_mask()))


def _view(draft: Draft, view: SideView, first: Upload, key: str) -> str:
    """Return a view as `--view` takes it."""
    upload = draft.upload(view.file)
    if upload.path == first.path or upload.kind != "picture":
        raise BadInput(f"{view.file} is not a picture of another side")
    path = draft.link(key, f"view-{upload.name}", upload.path)
    return f"{view.azimuth:g},{view.elevation:g}={path}"


def _item(name: str) -> str:
    """Return the name of an asset that a folder can have.

    Raises:
        BadInput: there is none.
    """
    item = clean_name(" ".join(name.replace("/", " ").split())).strip(". ")
    check_name(item)
    return item
