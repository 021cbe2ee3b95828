"""Ground-truth datasets on disk: frames of the input and of other views. Imports no torch.

An object is a folder in one of three layouts:

  ours           input/, view_<azimuth>/ ..., optionally mesh.npz and bank/
  Consistent4D   eval_0/ ... eval_3/, and the input in a folder beside them, or directly in the object's folder
  input only     one picture, or a folder of frames, without other views

Frames are pictures whose names end in their number, best as RGBA; in opaque ones the subject is all that is not white.
"""

import json
import re
from pathlib import Path

from dg4d_lib.errors import BadInput
from steps.contract import Frozen

CONSISTENT4D_AZIMUTHS_DEG = (-75.0, 15.0, 105.0, 195.0)  # of eval_0 to eval_3 (readme.txt of its test data)
PICTURES = frozenset([".png", ".jpg", ".jpeg", ".webp"])
OURS, THEIRS = re.compile(r"view_(-?\d+(?:\.\d+)?)"), re.compile(r"eval_(\d+)")
INPUT, MESH, BANK, CAMERAS = "input", "mesh.npz", "bank", "cameras.json"
# camera of all views; equals that of dg4d_lib/cameras/orbit.py, which imports torch
CAMERA = {"elevation": 0.0, "radius": 2.0, "fovy": 49.1}  # degrees, world units, degrees
CLOSE = 0.01  # tolerance, in the units of the above


class TrueView(Frozen):
    """Frames of one view at elevation 0.

    Attributes:
        azimuth_deg: azimuth of the camera; 0 is the input view.
        frames: pictures in order of time.
    """

    azimuth_deg: float
    frames: tuple[Path, ...]

    @property
    def name(self) -> str:
        """Azimuth in folder names and scores, for example "-75"."""
        return f"{self.azimuth_deg + 0.0:g}"


class GroundTruth(Frozen):
    """Ground truth of one object.

    Attributes:
        name: name of the object.
        inputs: frames of the input; one if it is a picture.
        views: other views; as many frames as the input, if that has more than one.
        mesh: NumPy archive of `vertices` [t v 3], `faces` [f 3] and optionally `face_weight` [f].
        bank: folder of views for the oracle prior.
    """

    name: str
    inputs: tuple[Path, ...]
    views: tuple[TrueView, ...] = ()
    mesh: Path | None = None
    bank: Path | None = None

    @property
    def pictures(self) -> tuple[Path, ...]:
        """Frames of the input and of every view."""
        return (*self.inputs, *(frame for view in self.views for frame in view.frames))

    @property
    def files(self) -> tuple[Path, ...]:
        """Pictures, the mesh and the folder of the bank."""
        return (*self.pictures, *(path for path in (self.mesh, self.bank) if path is not None))


def find_ground_truth(place: Path) -> GroundTruth:
    """Return the ground truth of the object in a folder, or of a picture.

    Raises:
        BadInput: there is none, or it is not complete; says what is missing.
    """
    if place.is_file() and place.suffix.lower() in PICTURES:
        return GroundTruth(name=place.stem, inputs=(place,))
    if not place.is_dir():
        raise BadInput(f"{place} is not ground truth: give a folder of an object, or a picture")
    views = [TrueView(azimuth_deg=azimuth, frames=tuple(_pictures(path))) for azimuth, path in _view_folders(place)]
    truth = GroundTruth(
        name=place.absolute().name,
        inputs=tuple(_inputs(place)),
        views=tuple(sorted(views, key=lambda view: view.azimuth_deg)),
        mesh=place / MESH if (place / MESH).is_file() else None,
        bank=place / BANK if (place / BANK / "bank.json").is_file() else None,
    )
    _check(truth, place)
    return truth


def find_ground_truths(dataset: Path) -> list[GroundTruth]:
    """Return the objects of a data set, which are folders or pictures in it or in its folder `gt/`.

    Raises:
        BadInput: there are none, or one of them is not complete.
    """
    if not dataset.is_dir():
        raise BadInput(f"{dataset} is not a data set: give a folder that holds a folder per object")
    root = dataset / "gt" if (dataset / "gt").is_dir() else dataset
    if _view_folders(root) or (root / INPUT).is_dir():
        return [find_ground_truth(root)]
    folders = [path for path in sorted(root.iterdir()) if path.is_dir() and not path.name.startswith(".")]
    objects = [path for path in folders if _view_folders(path) or (path / INPUT).is_dir()]
    found = [find_ground_truth(path) for path in objects or _pictures(root)]
    if not found:
        raise BadInput(
            f"{dataset} holds no objects: an object is a folder with input/ and view_<azimuth>/, or, as in "
            "Consistent4D, with eval_0/ to eval_3/; or a single picture"
        )
    return found


def _view_folders(folder: Path) -> list[tuple[float, Path]]:
    """Return azimuth and folder of every view."""
    found = []
    for path in sorted(folder.iterdir()):
        ours, theirs = OURS.fullmatch(path.name), THEIRS.fullmatch(path.name)
        if not path.is_dir() or not (ours or theirs):
            continue
        if ours:
            found.append((float(ours.group(1)), path))
        elif theirs and int(theirs.group(1)) < len(CONSISTENT4D_AZIMUTHS_DEG):
            found.append((CONSISTENT4D_AZIMUTHS_DEG[int(theirs.group(1))], path))
        else:
            raise BadInput(f"{path}: Consistent4D has the views eval_0 to eval_3; name others view_<azimuth>")
    return found


def _inputs(folder: Path) -> list[Path]:
    """Return the frames in `input/`, else those directly in the folder, else those of the only other picture folder."""
    if (folder / INPUT).is_dir():
        return _pictures(folder / INPUT)
    if direct := _pictures(folder):
        return direct
    known = {path for _, path in _view_folders(folder)} | {folder / BANK, folder / "static"}
    others = [path for path in sorted(folder.iterdir()) if path.is_dir() and path not in known and _pictures(path)]
    if len(others) != 1:
        named = f", and several folders could be the input: {', '.join(path.name for path in others)}" if others else ""
        raise BadInput(f"{folder} has no {INPUT}/{named}; put the input frames into {folder / INPUT}")
    return _pictures(others[0])


def _pictures(folder: Path) -> list[Path]:
    """Return the pictures directly in a folder, sorted by the last number in their names."""
    found = [p for p in folder.iterdir() if p.suffix.lower() in PICTURES and p.is_file() and p.name[0] != "."]
    return sorted(found, key=lambda path: (int((re.findall(r"\d+", path.stem) or ["0"])[-1]), path.name))


def _check(truth: GroundTruth, folder: Path) -> None:
    if not truth.inputs:
        raise BadInput(f"{folder} has no input frames: put them into {folder / INPUT}")
    counts = {f"view_{view.name}": len(view.frames) for view in truth.views}
    if len(truth.inputs) > 1:
        counts = {INPUT: len(truth.inputs), **counts}
    if len(set(counts.values())) > 1 or 0 in counts.values():
        listed = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise BadInput(f"the views of {folder} must have equal numbers of frames; they have: {listed}")
    if len({view.azimuth_deg for view in truth.views}) < len(truth.views):
        raise BadInput(f"{folder} has two folders of one view; keep one")
    if (folder / CAMERAS).is_file():
        _check_cameras(folder / CAMERAS, truth)


def _check_cameras(path: Path, truth: GroundTruth) -> None:
    """Refuse views of another elevation, radius or field of view."""
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        cameras = {name: given[name] for name in (INPUT, *(f"view_{view.name}" for view in truth.views))}
        wrong = [
            f"{name}: {what} {camera[what]}"
            for name, camera in cameras.items()
            for what, value in CAMERA.items()
            if abs(float(camera[what]) - value) > CLOSE
        ]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadInput(f"{path} does not give the camera of every view: {error!r}") from error
    if wrong:
        expected = ", ".join(f"{what} {value:g}" for what, value in CAMERA.items())
        raise BadInput(f"{path}: views must be taken with {expected}; {'; '.join(wrong)}")
