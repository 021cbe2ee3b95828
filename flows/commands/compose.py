"""Packages become one animated scene; behind `dg4d compose`."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path, PurePath

from pydantic import ValidationError

from dg4d_lib.assets.scenes.scene import Scene, SceneItem
from dg4d_lib.errors import BadInput
from flows.inputs.package_record import record_of
from flows.packages.publish import check_writable, whole
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
    """Write a scene of packages: side by side on the ground, or as a scene file says.

    Args:
        packages: folders, in the order in which they stand from left to right; none with a scene file.
        out: the scene, ending in .glb or .usdz; it is written whole or not at all.
        scene: a scene file, JSON (`Scene`).
        spacing: room between neighbors without a scene file, world units.
        preview: also write a film, beside the scene and under its name.
        progress: called with pictures of the film done and their number.

    Returns:
        Notes for the user.

    Raises:
        BadInput: neither or both of packages and scene file, a broken scene file, a package with missing or altered
            files (says which), or an output that cannot be written.
        BackendUnavailable: something needed is not installed.
        DiskFull: there is no room.
    """
    _check_out(out)
    if bool(packages) == (scene is not None):
        raise BadInput("give the folders of packages, or a scene file with --scene, and not both")
    if scene is not None:
        plan = read_scene(scene)
        folders = [scene.parent / item.package for item in plan.items]
    else:
        plan = Scene(items=tuple(SceneItem(package=str(folder)) for folder in packages))
        folders = list(packages)
    for folder in dict.fromkeys(folders):
        whole(folder)
    from steps.compose_scene import SceneWriter

    cast = SceneWriter(folders, plan.items, _names(folders, plan.items))
    if scene is None:
        cast.in_a_row(spacing)
    write = cast.write_glb if out.suffix.lower() == ".glb" else cast.write_usdz
    notes = _written(out, lambda path: write(path, plan.duration_s))
    if preview:
        _written(out.with_suffix(".mp4"), lambda path: cast.write_preview(path, plan, progress=progress))
    return notes


def read_scene(path: Path) -> Scene:
    """A scene file.

    Raises:
        BadInput: it cannot be read, or something in it is wrong; says what and where.
    """
    try:
        scene = Scene.model_validate_json(path.read_bytes())
    except OSError as error:
        raise BadInput(f"the scene file {path} cannot be read: {error.strerror}") from error
    except ValidationError as error:
        lines = [f"{'.'.join(map(str, e['loc'])) or 'JSON'}: {e['msg']}" for e in error.errors()]
        raise BadInput(f"the scene file {path} cannot be used: {'; '.join(lines)}") from error
    for number, item in enumerate(scene.items):
        place = PurePath(item.package)
        if place.is_absolute() or ".." in place.parts:
            raise BadInput(
                f"{path}: items.{number}.package leads outside of the scene file's folder: {item.package}; "
                "put the scene file above its packages"
            )
    return scene


def _check_out(out: Path) -> None:
    if out.suffix.lower() not in SUFFIXES:
        raise BadInput(f"a scene is written as {' or '.join(SUFFIXES)}; given -o {out}")
    if out.is_dir():
        raise BadInput(f"{out} is a folder; name a file with -o")
    if out.name in (record_of(out.parent) or {"files": {}})["files"]:
        raise BadInput(f"{out} belongs to a package; write the scene elsewhere with -o")
    check_writable(out.parent)


def _names(folders: Sequence[Path], items: Sequence[SceneItem]) -> list[str]:
    """A name of its own for every item: the given one or that of its folder, with a number if it is taken."""
    wanted = [item.name or folder.resolve().name for folder, item in zip(folders, items, strict=True)]
    names: list[str] = []
    for name in wanted:
        candidate, number = name, 1
        while candidate in names or (number > 1 and candidate in wanted):
            number += 1
            candidate = f"{name} {number}"
        names.append(candidate)
    return names


def _written(out: Path, write: Callable[[Path], tuple[str, ...] | None]) -> tuple[str, ...]:
    """What `write` gives, which writes a file that appears whole or not at all."""
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
