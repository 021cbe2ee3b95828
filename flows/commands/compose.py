"""Composition of packages to one animated scene; behind `dg4d compose`."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path, PurePath

from pydantic import ValidationError

from dg4d_lib.assets.scenes.scene import Scene, SceneItem
from dg4d_lib.errors import BadInput, quoted
from flows.inputs.package_record import record_of
from flows.packages.publish import check_writable, load_verified
from steps.store.files import room_for

SUFFIXES = (".glb", ".usdz")


def compose(
    packages: Sequence[Path],
    out: Path,
    scene: Path | None = None,
    spacing: float = 0.25,
    preview: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[str, ...]:
    """Write a scene of packages: side by side on the ground, or as a scene file places them.

    Args:
        packages: folders, from left to right; none with a scene file.
        out: scene, ending in .glb or .usdz; written atomically.
        scene: scene file, JSON (`Scene`).
        spacing: between neighbors without a scene file, meters.
        preview: also render a video, beside the scene and under its name.
        progress: called with the number of rendered frames and their total.

    Returns:
        Notes for the user.

    Raises:
        BadInput: neither or both of packages and scene file, an invalid scene file, a package with missing or altered
            files, or an output that cannot be written.
        BackendUnavailable: a library is not installed.
        DiskFull: the disk is full.
    """
    _check_out(out)
    if bool(packages) == (scene is not None):
        raise BadInput("give either the folders of packages, or a scene file with --scene")
    if scene is not None:
        plan = read_scene(scene)
        folders = [scene.parent / item.package for item in plan.items]
    else:
        plan = Scene(items=tuple(SceneItem(package=str(folder)) for folder in packages))
        folders = list(packages)
    for folder in dict.fromkeys(folders):
        load_verified(folder)
    from steps.compose_scene import SceneWriter

    names = [item.name or folder.resolve().name for folder, item in zip(folders, plan.items, strict=True)]
    cast = SceneWriter(folders, plan.items, _unique(names))
    if scene is None:
        cast.in_a_row(spacing)
    write = cast.write_glb if out.suffix.lower() == ".glb" else cast.write_usdz
    notes = _written(out, lambda path: write(path, plan.duration_s))
    if preview:
        _written(out.with_suffix(".mp4"), lambda path: cast.write_preview(path, plan, progress=progress))
    return notes


def read_scene(path: Path) -> Scene:
    """Read a scene file.

    Raises:
        BadInput: it cannot be read, or a field is invalid.
    """
    try:
        scene = Scene.model_validate_json(path.read_bytes())
    except OSError as error:
        raise BadInput(f"the scene file {path} cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise BadInput(f"the scene file {path} cannot be used: {_problems(error)}") from error
    for number, item in enumerate(scene.items):
        place = PurePath(item.package)
        if place.is_absolute() or ".." in place.parts:
            raise BadInput(
                f"{path}: items[{number}].package leads outside of the scene file's folder: {item.package}; "
                "put the scene file above its packages"
            )
    return scene


def _problems(error: ValidationError) -> str:
    """Return the errors of a scene file, field by field."""
    lines = []
    for each in error.errors(include_url=False):
        *above, last = each["loc"] or ("",)
        place = _path(above) or "the scene"
        if each["type"] == "extra_forbidden":
            allowed = ", ".join((SceneItem if above else Scene).model_fields)
            lines.append(f"{place} has an unknown field {quoted(last)}; allowed: {allowed}")
        elif each["type"] == "missing":
            lines.append(f"{place} has no {last}, which is required")
        elif each["type"] != "too_short" or not each["input"]:  # invalid items do not count towards the length
            given = f"{_path(each['loc'])} = {quoted(each['input'])}: " if each["loc"] else ""
            lines.append(given + each["msg"])
    return "; ".join(lines)


def _path(location: Sequence[int | str]) -> str:
    """Return the name of a field, for example items[0].scale."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).removeprefix(".")


def _check_out(out: Path) -> None:
    if out.suffix.lower() not in SUFFIXES:
        raise BadInput(f"a scene is written as {' or '.join(SUFFIXES)}; given -o {out}")
    if out.is_dir():
        raise BadInput(f"{out} is a folder; name a file with -o")
    if out.name in (record_of(out.parent) or {"files": {}})["files"]:
        raise BadInput(f"{out} belongs to a package; write the scene elsewhere with -o")
    check_writable(out.parent)


def _unique(wanted: list[str]) -> list[str]:
    """Append numbers to names that occur twice."""
    names: list[str] = []
    for name in wanted:
        candidate, number = name, 1
        while candidate in names or (number > 1 and candidate in wanted):
            number += 1
            candidate = f"{name} {number}"
        names.append(candidate)
    return names


def _written(out: Path, write: Callable[[Path], tuple[str, ...] | None]) -> tuple[str, ...]:
    """Write a file atomically by `write`, and return its notes."""
    draft = out.with_name(f".{os.getpid()}.{out.name}")
    try:
        with room_for(out):
            out.parent.mkdir(parents=True, exist_ok=True)
            notes = write(draft)
            draft.replace(out)
    except OSError as error:
        raise BadInput(f"{out} cannot be written: {error.strerror or error}; choose another with -o") from error
    finally:
        draft.unlink(missing_ok=True)
    return notes or ()
