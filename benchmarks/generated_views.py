"""Quality of the profile `open` with imperfect views of frame 0 in place of generated ones.

    python -m benchmarks.generated_views FOLDER [--only panda mage] [--spoil 2] [--sheet sheet.png]

FOLDER is a data set of `steps.artifacts.ground_truth` whose objects also have `static/az_AZIMUTH.png`, frame 0 from
other sides, and `bank/`. True views of frame 0 from eight azimuths and two elevations are blurred, tinted, shifted and
given wrong angles (the knobs of the oracle prior), then placed, judged and weighted as `generate_views` does, and the
fits of `open` run on them. `--spoil` also turns some views upside down, which the judgment has to find.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import mean as average

from benchmarks.measure import parser_of
from benchmarks.true_views import Figures, Subject, line, mean, prepared, read_subjects, score_fit, write_sheet

import torch  # isort: skip
from torch import Tensor

from benchmarks.inputs import score_first
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance.oracle import Bank, perturb
from dg4d_lib.images import resize
from dg4d_lib.settings import OraclePriorSettings
from dg4d_lib.visual_hull.agreement import smaller
from dg4d_lib.visual_hull.known import KnownView, known_view
from flows.inputs.manifest import parse_changes
from steps.artifacts.media import read_png
from steps.fitting.priors import known_views, read_bank_folder
from steps.generate_views import weighted_views
from steps.profiles import PipelineSettings, profile, revise

STEP_DEG = 45
SIZE = 256  # pixels of a view
ABOVE_DEG = 20.0  # of the bank's second elevation
ERRORS = OraclePriorSettings(blur=1.0, color_gain=0.05, pose_deg=3.0, shift=2.0)  # pixels of `SIZE`
WITHOUT_MODELS = {"driving.kind": "warp", "views.kind": "none"}


def imperfect_bank(subject: Subject, errors: OraclePriorSettings, spoil: int = 0) -> Bank:
    """Return views of frame 0 from eight azimuths and two elevations, with errors; of the input, only from above."""
    assert subject.truth is not None and subject.truth.bank is not None, f"{subject.name} has no bank"
    folder, bank = subject.truth.inputs[0].parents[1] / "static", read_bank_folder(subject.truth.bank)
    pairs = [
        (
            OrbitCamera(0, azimuth, width=SIZE, height=SIZE),
            resize(read_png(folder / f"az_{azimuth:03d}.png")[None], (SIZE, SIZE))[0],
        )
        for azimuth in range(STEP_DEG, 360, STEP_DEG)
    ]
    first = bank.frames.index(0)
    for row, camera in enumerate(bank.cameras):
        if camera.elevation_deg == ABOVE_DEG and camera.azimuth_deg % STEP_DEG == 0:
            picture = resize(bank.pictures[row, first][None].float() / 255, (SIZE, SIZE))[0]
            pairs.append((replace(camera, width=SIZE, height=SIZE), picture))
    pictures = torch.stack([(picture.clamp(0, 1) * 255).round().to(torch.uint8) for _, picture in pairs])[:, None]
    found = perturb(Bank(tuple(camera for camera, _ in pairs), (0,), pictures), errors, _generator(0))
    for index in torch.randperm(len(pairs), generator=_generator(1))[:spoil].tolist():
        found.pictures[index] = found.pictures[index].flip(1)
    return found


def weighted_bank(bank: Bank, front: KnownView, min_weight: float) -> Bank:
    """Return the bank as `generate_views` writes it: placed, judged, weighted."""
    views = [smaller(view, front.camera.width) for view in known_views(bank)]
    kept, judgments, notes = weighted_views(front, views, min_weight)
    weights = [one.weight for one in judgments]
    sys.stderr.write(f"{len(kept)} of {len(weights)} views kept, weights {min(weights):.2f} to {max(weights):.2f}, ")
    sys.stderr.write(f"mean {average(weights):.2f} {' '.join(notes)}\n")
    cutouts = torch.stack([view.cutout for view in kept]).clamp(0, 1)
    pictures = (cutouts * 255).round().to(torch.uint8)[:, None]
    return Bank(tuple(view.camera for view in kept), (0,), pictures, tuple(view.weight for view in kept))


def score(subject: Subject, settings: PipelineSettings, sides: Bank, first: bool = False) -> tuple[Figures, Tensor]:
    """Fit the subject with imperfect views and compare unseen ones; or only the shape of frame 0."""
    return score_first(subject, settings, sides) if first else score_fit(subject, settings, sides=sides)


def main(arguments: Sequence[str] | None = None) -> None:
    """Score the profile `open` on the objects of a data set."""
    parser = parser_of(__doc__)
    parser.add_argument("objects", type=Path, help="folder of objects")
    parser.add_argument("--only", nargs="+", default=(), help="names of objects")
    parser.add_argument("--first", action="store_true", help="score the shape of frame 0 alone, without a fit")
    parser.add_argument("--perfect", action="store_true", help="views without errors")
    parser.add_argument("--spoil", type=int, default=0, metavar="N", help="views that are turned upside down")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting")
    parser.add_argument("--sheet", type=Path, help="picture: unseen views over time, above the ground truth")
    given = parser.parse_args(arguments)
    min_weight = getattr(profile("open").views, "min_weight", 0.0)
    changes = parse_changes(given.set)
    settings = revise(profile("open"), {**WITHOUT_MODELS, **changes})
    errors = OraclePriorSettings() if given.perfect else ERRORS
    found: dict[str, Figures] = {}
    strips = []
    for subject in read_subjects(given.objects, given.only):
        front = known_view(prepared(subject, settings)[0])
        sides = weighted_bank(imperfect_bank(subject, errors, given.spoil), front, min_weight)
        found[subject.name], strip = score(subject, settings, sides, given.first)
        strips.append(strip)
        sys.stdout.write(line(subject.name, {"open": found[subject.name]}))
        sys.stdout.flush()
    sys.stdout.write(line("mean", {"open": mean(list(found.values()))}))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))
    if given.sheet:
        write_sheet(given.sheet, strips)


def _generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


if __name__ == "__main__":
    main()
