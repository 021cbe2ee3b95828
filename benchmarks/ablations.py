"""Ablations of the paper on objects with ground truth: `python -m benchmarks.ablations NAME ...`.

Every variant changes settings of the pipeline. The prior is the oracle, a bank of ground-truth views that excludes the
scored ones; `--imperfect` perturbs it with blur, a pose error per view, and a shift and a gain per view and frame, the
same for all variants. `--set prior.kind=zero123` takes a diffusion model instead, which needs its weights. Objects are
our own, or those of a data set (`--data DIR`): a folder per object with input/, view_AZIMUTH/ and bank/, as `dg4d bench
--bank` reads them. The table has means over objects and seeds, with the standard deviation after +-; the sentence below
compares pairs of the same object and seed. `--quick` is a smoke test.

The paper's fits per frame are the rows "every frame from ...": separate Gaussians for every frame, optimized by the
static stage for as many iterations as the dynamic stage has. The rows "frame-wise ..." are ours: one set of Gaussians
with shared, frozen colors and opacities, and a table of displacements of mean, scale and rotation per frame, fitted by
the dynamic stage like the other rows.

Unlike a diffusion model, an oracle is consistent over iterations. Claims of the paper that depend on this cannot be
tested here; their `caveat` states this.
"""

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from rich.console import Console
from rich.table import Column, Table
from scipy.stats import t as student

from benchmarks.fits import Figures, fits_per_frame, moving_fit, score, static_fit
from benchmarks.measure import new_console, parser_of, write_rows
from benchmarks.objects.specimens import OBJECTS, Specimen, read_specimen, render_specimen
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from flows.inputs.manifest import parse_changes
from steps.artifacts.ground_truth import find_ground_truths
from steps.profiles import PipelineSettings, revise

DIGITS = {"psnr": 2, "psnr_obj": 2, "iou": 3, "terr": 3, "flicker": 2}
LESS_IS_BETTER = {"terr", "flicker"}
CONFIDENCE = 0.95  # confidence level of the interval of a gain, Student's t over the pairs
NEGLIGIBLE = {"psnr": 0.1, "psnr_obj": 0.1, "iou": 0.005, "terr": 0.01}  # invisible gains (ours)
SHARES = ("subject.max_frames", "deformation.temporal")  # a float in these is a fraction of the frames

SMALL: dict[str, Any] = {  # the paper's schedule scaled to seconds on a CPU: fewer iterations, larger learning rates
    "prior.kind": "oracle",
    "static.iterations": 150,
    "static.views": 8,
    "static.start.points": 2000,
    "motion.iterations": 100,
    "motion.views": 2,
    "motion.plane_lr": 0.0128,
    "motion.network_lr": 0.00128,
}
SIZES = {
    "seeds": "fits of every variant and object",
    "frames": "largest number of frames",
    "size": "pixels of the fits and of our own objects' views",
}
FULL, SMOKE = {"seeds": 2, "frames": 16, "size": 96}, {"seeds": 1, "frames": 4, "size": 48}
QUICK: dict[str, Any] = {"static.iterations": 30, "static.start.points": 500, "motion.iterations": 10}
IMPERFECT: dict[str, Any] = {"prior.blur": 1.0, "prior.color_gain": 0.2, "prior.pose_deg": 4.0, "prior.shift": 1.5}
FINE: dict[str, Any] = {"deformation.scales": [1, 4]}
TUNED: dict[str, Any] = {"motion.fine_tune": True}
LONGER: dict[str, float] = {"motion.iterations": 2}  # factors
LONGER_STATIC: dict[str, float] = {"static.iterations": 2}
RELEASE: dict[str, Any] = {  # dynamic stage of the public code's first release, apart from its planes
    "motion.t_max_start": 1.0,
    "motion.t_max_end": 0.0,
    "motion.t_max_limit": 0.5,
    "motion.guidance_weight": 4.0,
    "motion.alpha_weight": 0.0,
}
RELEASE_PLANES: dict[str, Any] = {
    "deformation.spatial": 64,
    "deformation.temporal": 25,
    "deformation.scales": [1, 2, 4, 8],
    "deformation.half_side": 1.6,
}
PUBLIC_BOX: dict[str, Any] = {"deformation.half_side": 1.6}
SMOOTH: dict[str, Any] = {"deformation.smoothness_weight": 0.01}


@dataclass(frozen=True)
class Variant:
    """Row of a table.

    Attributes:
        changes: of the settings, by dotted name.
        per_frame: fit every frame separately with the static stage, from a random ball.
        from_static: these fits start from the Gaussians of the static stage instead.
        factors: multiply settings that all variants share, by dotted name.
    """

    changes: Mapping[str, Any] = field(default_factory=dict)
    per_frame: bool = False
    from_static: bool = False
    factors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Claim:
    """Claim that one variant beats another in a metric, or (`alike`) by a negligible gain at most."""

    better: str
    other: str
    figure: str
    alike: bool = False


@dataclass(frozen=True)
class Ablation:
    """Comparison of variants.

    Attributes:
        statement: claim of the paper, in our words.
        variants: by name, in the order of the table.
        claims: conditions for the claim.
        still: run the static stage only.
        caveat: limitation of the oracle for this claim.
    """

    statement: str
    variants: Mapping[str, Variant]
    claims: tuple[Claim, ...]
    still: bool = False
    caveat: str = ""


ABLATIONS: dict[str, Ablation] = {
    "static": Ablation(
        "16 views over white (DreamGaussianHD) give a better static object than 1 view over black or white",
        {
            "1 view, random": Variant({"static.views": 1, "static.background": "random"}),
            "1 view, white": Variant({"static.views": 1}),
            "16 views, random": Variant({"static.views": 16, "static.background": "random"}),
            "16 views, white": Variant({"static.views": 16}),
        },
        (
            Claim("16 views, white", "1 view, white", "psnr"),
            Claim("16 views, white", "16 views, random", "psnr"),
            Claim("16 views, white", "1 view, random", "psnr"),
        ),
        still=True,
        caveat="the oracle's images are over white, as Zero-1-to-3's are: renders over black learn a white "
        "shell, which `psnr_obj` does not measure",
    ),
    "representation": Ablation(
        "HexPlane gives better motion than an MLP and than a fit per frame, and a static start helps the latter",
        {
            "HexPlane": Variant(),
            "MLP": Variant({"deformation.kind": "mlp"}),
            "frame-wise, static start": Variant({"deformation.kind": "framewise"}),
            "frame-wise, scattered": Variant({"deformation.kind": "framewise", "deformation.start": "scattered"}),
            "every frame from the static stage": Variant(per_frame=True, from_static=True),
            "every frame from a blob": Variant(per_frame=True),
        },
        (
            Claim("HexPlane", "MLP", "psnr_obj"),
            Claim("HexPlane", "MLP", "terr"),
            Claim("HexPlane", "every frame from the static stage", "psnr_obj"),
            Claim("HexPlane", "every frame from the static stage", "terr"),
            Claim("HexPlane", "every frame from a blob", "terr"),
            Claim("every frame from the static stage", "every frame from a blob", "psnr_obj"),
        ),
        caveat="the oracle is consistent over iterations, and without --imperfect over frames: no flicker is left to "
        "regularize",
    ),
    "resolution": Ablation(
        "a resolution of 32 in space and time is best",
        {
            "S 32, T 32": Variant(),
            "S 8, T 32": Variant({"deformation.spatial": 8}),
            "S 16, T 32": Variant({"deformation.spatial": 16}),
            "S 64, T 32": Variant({"deformation.spatial": 64}),
            "S 128, T 32": Variant({"deformation.spatial": 128}),
            "S 32, T 4": Variant({"deformation.temporal": 4}),
            "S 32, T 8": Variant({"deformation.temporal": 8}),
            "S 32, T 16": Variant({"deformation.temporal": 16}),
            "S 32, T 64": Variant({"deformation.temporal": 64}),
        },
        tuple(
            Claim("S 32, T 32", other, "psnr_obj") for other in ("S 8, T 32", "S 128, T 32", "S 32, T 4", "S 32, T 64")
        ),
        caveat="planes finer than the motion do no harm if the prior is consistent over time",
    ),
    "zero-start": Ablation(
        "heads that start at zero lead to a better motion than random ones",
        {"zero": Variant(), "random": Variant({"deformation.zero_start": False})},
        (Claim("zero", "random", "psnr_obj"),),
        caveat="the oracle has a unique optimum, which any start reaches; zero heads only start to learn later",
    ),
    "noise": Ablation(
        "in the dynamic stage T_max = 0.5 is better than 0.98",
        {"T_max 0.5": Variant({"motion.t_max_start": 0.5}), "T_max 0.98": Variant({"motion.t_max_start": 0.98})},
        (Claim("T_max 0.5", "T_max 0.98", "psnr_obj"),),
        caveat="an exact denoiser is exact at every timestep: T_max only scales its gradient",
    ),
    "release": Ablation(
        "the first release's guidance (weight 4, T_max 0.5 for half of the fit, no alpha loss) beats the paper's",
        {
            "paper": Variant(),
            "T_max clipped": Variant({name: RELEASE[name] for name in RELEASE if ".t_max" in name}),
            "weight 4": Variant({"motion.guidance_weight": 4.0}),
            "no alpha loss": Variant({"motion.alpha_weight": 0.0}),
            "release": Variant(RELEASE),
            "release, its planes": Variant({**RELEASE, **RELEASE_PLANES}),
        },
        (Claim("release", "paper", "psnr_obj"), Claim("release", "paper", "terr")),
        caveat="an exact denoiser is exact at every timestep, so that both readings only weigh guidance against the "
        "input view",
    ),
    "box": Ablation(
        "ours, not the paper's: planes over the Gaussians' bounding box are better than over the public code's 1.6",
        {
            "bounding box": Variant(),
            "1.6": Variant(PUBLIC_BOX),
            "1.6, S 86": Variant({**PUBLIC_BOX, "deformation.spatial": 86}),
            "bounding box, S 12": Variant({"deformation.spatial": 12}),
        },
        (Claim("bounding box", "1.6", "psnr_obj"), Claim("bounding box", "1.6", "terr")),
    ),
    "fine-tuning": Ablation(
        "freezing the static Gaussians in the dynamic stage, the paper's default, costs nothing",
        {"frozen": Variant(), "fine-tuned": Variant({"motion.fine_tune": True})},
        (Claim("fine-tuned", "frozen", "psnr_obj", alike=True),),
    ),
    "rigidity": Ablation(
        "the local rigidity loss brings no significant improvement",
        {
            "off": Variant(),
            "weight 300": Variant({"motion.rigidity_weight": 300.0}),
            "weight 3000": Variant({"motion.rigidity_weight": 3000.0}),
        },
        (
            Claim("weight 300", "off", "psnr_obj", alike=True),
            Claim("weight 300", "off", "terr", alike=True),
        ),
    ),
    "fast": Ablation(
        "all frames with four views each (Ours) beat half of them with one view (Ours-Fast)",
        {
            "Ours": Variant({"motion.views": 4, **SMOOTH}),
            "Ours-Fast": Variant({"motion.views": 1, "subject.max_frames": 0.5, **SMOOTH}),
        },
        (Claim("Ours", "Ours-Fast", "psnr_obj"), Claim("Ours", "Ours-Fast", "terr")),
    ),
    "regularizers": Ablation(
        "ours, not the paper's: time planes finer than the fitted frames, half of all, need smoothness in between",
        {
            "off": Variant({"subject.max_frames": 0.5}),
            "smoothness 0.01": Variant({"subject.max_frames": 0.5, **SMOOTH}),
            "smoothness 100": Variant({"subject.max_frames": 0.5, "deformation.smoothness_weight": 100.0}),
            "variation 0.0001": Variant({"subject.max_frames": 0.5, "deformation.variation_weight": 1e-4}),
            "sparsity 0.0001": Variant({"subject.max_frames": 0.5, "deformation.sparsity_weight": 1e-4}),
            "T = frames": Variant({"subject.max_frames": 0.5, "deformation.temporal": 0.5}),
        },
        (Claim("smoothness 0.01", "off", "terr"), Claim("smoothness 0.01", "off", "psnr_obj")),
    ),
    "recipe": Ablation(
        "ours, not the paper's: finer planes, fine-tuned Gaussians and longer fits are worth their time",
        {
            "paper": Variant(),
            "S 96": Variant({"deformation.spatial": 96}),
            "scales 1, 4": Variant(FINE),
            "fine-tuned": Variant(TUNED),
            "scales 1, 4, fine-tuned": Variant({**FINE, **TUNED}),
            "and twice as long": Variant({**FINE, **TUNED}, factors=LONGER),
            "and a longer static stage": Variant({**FINE, **TUNED}, factors={**LONGER, **LONGER_STATIC}),
        },
        (
            Claim("and a longer static stage", "paper", "psnr_obj"),
            Claim("and a longer static stage", "paper", "terr"),
            Claim("scales 1, 4", "S 96", "psnr_obj"),
        ),
    ),
}


@dataclass(frozen=True)
class Row:
    """Result of one fit; figures are a dataclass with names from `DIGITS`."""

    ablation: str
    variant: str
    specimen: str
    seed: int
    figures: Any


def settings_of(
    changes: Mapping[str, Any], size: int, frames: int, factors: Mapping[str, float] | None = None
) -> PipelineSettings:
    """Return the small schedule with changes and factors applied; fractions of `SHARES` become numbers of frames."""
    schedule = [{"until": 1.0, "size": size}]
    sizes = {
        f"{stage}.{name}": value
        for stage in ("static", "motion")
        for name, value in (("resolution_schedule", schedule), ("reference_size", size))
    }
    merged = {**SMALL, **sizes, "subject.max_frames": 1.0, **changes}
    counts = {key: max(2, round(merged[key] * frames)) for key in SHARES if isinstance(merged.get(key), float)}
    scaled = {key: factor * merged[key] for key, factor in (factors or {}).items()}
    return revise(PipelineSettings(), {**merged, **counts, **scaled})


class Laboratory:
    """Runner of fits, with a cache of static clouds and of figures of equal settings."""

    def __init__(self, base: Mapping[str, Any], size: int) -> None:
        self.base, self.size = base, size
        self._rest: dict[tuple[str, int, str], Gaussians] = {}
        self._figures: dict[tuple[str, int, bool, bool, bool, str], Figures] = {}

    def figures(self, specimen: Specimen, variant: Variant, seed: int, still: bool) -> Figures:
        """Return the figures of a variant."""
        settings = settings_of({**self.base, **variant.changes}, self.size, len(specimen.cutouts), variant.factors)
        key = (specimen.name, seed, still, variant.per_frame, variant.from_static, settings.model_dump_json())
        if key not in self._figures:
            self._figures[key] = score(specimen, self._states(specimen, variant, settings, seed, still))
        return self._figures[key]

    def _states(
        self, specimen: Specimen, variant: Variant, settings: PipelineSettings, seed: int, still: bool
    ) -> list[Gaussians]:
        if variant.per_frame:
            start = self._static(specimen, settings, seed) if variant.from_static else None
            return fits_per_frame(specimen, settings, seed, start)
        rest = self._static(specimen, settings, seed)
        return [rest] if still else moving_fit(specimen, rest, settings, seed)

    def _static(self, specimen: Specimen, settings: PipelineSettings, seed: int) -> Gaussians:
        key = (specimen.name, seed, settings.static.model_dump_json() + settings.prior.model_dump_json())
        if key not in self._rest:
            self._rest[key] = static_fit(specimen, settings, seed)
        return self._rest[key]


def verdict(ablation: Ablation, rows: Sequence[Row]) -> str:
    """Return a sentence: outcome of the claim, and the gains."""
    found = {(row.variant, row.specimen, row.seed): row.figures for row in rows}
    pairs = sorted({(row.specimen, row.seed) for row in rows})
    parts, outcomes = [], []
    for claim in ablation.claims:
        sign = -1 if claim.figure in LESS_IS_BETTER else 1
        gains = [
            sign
            * (getattr(found[claim.better, *pair], claim.figure) - getattr(found[claim.other, *pair], claim.figure))
            for pair in pairs
        ]
        gain, error = mean(gains), stdev(gains) / math.sqrt(len(gains)) if len(gains) > 1 else math.inf
        outcomes.append(_outcome(claim, gain, error, len(pairs)))
        digits = DIGITS[claim.figure]
        parts.append(f"{claim.better} against {claim.other}: {gain:+.{digits}f} +- {error:.{digits}f} {claim.figure}")
    word = {"yes": "Reproduced", "open": "Not decided", "no": "Not reproduced"}
    outcome = word["no" if "no" in outcomes else "open" if "open" in outcomes else "yes"]
    caveat = f" (but {ablation.caveat})" if ablation.caveat else ""
    return f"{outcome}{caveat}: {ablation.statement}; gains: {'; '.join(parts)}."


def _outcome(claim: Claim, gain: float, error: float, pairs: int) -> str:
    """Return the outcome of one claim; a single pair decides nothing."""
    if pairs < 2:
        return "open"
    reach = float(student.ppf((1 + CONFIDENCE) / 2, pairs - 1)) * error
    bound = NEGLIGIBLE[claim.figure] if claim.alike else 0.0
    if gain - reach <= bound <= gain + reach:
        return "open"
    return "yes" if (gain > bound) != claim.alike else "no"


def table(title: str, rows: Sequence[Row]) -> Table:
    """Return means and standard deviations over objects and seeds."""
    names = [field.name for field in fields(rows[0].figures)]
    result = Table(Column("variant", no_wrap=True), *names, title=title)
    for variant in dict.fromkeys(row.variant for row in rows):
        result.add_row(
            variant, *(_cell([row.figures for row in rows if row.variant == variant], name) for name in names)
        )
    return result


def _cell(figures: Sequence[Any], name: str) -> str:
    values = [value for one in figures if (value := getattr(one, name)) is not None]
    if not values:
        return ""
    spread = stdev(values) if len(values) > 1 else 0.0
    return f"{mean(values):.{DIGITS[name]}f} +- {spread:.{DIGITS[name]}f}"


def main() -> None:
    parser = parser_of(__doc__, "one seed, four frames, a few iterations")
    parser.add_argument("names", nargs="+", choices=list(ABLATIONS), metavar="NAME", help=", ".join(ABLATIONS))
    parser.add_argument(
        "--objects",
        type=lambda names: names.split(","),  # one argument: with nargs="+" it would also take NAME
        metavar="NAME[,NAME]",
        help=f"{', '.join(OBJECTS)}, or objects of DIR; default: all",
    )
    parser.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        help="data set with banks, instead of our own objects; all ablations need videos but those of the static "
        f"stage ({', '.join(name for name, one in ABLATIONS.items() if one.still)}), which take pictures, too; "
        "those of the refinement: experiments.oracle_refinement, and with weights benchmarks.refinement",
    )
    for name, about in SIZES.items():
        help_text = f"{about}; default: {FULL[name]}, with --quick {SMOKE[name]}"
        parser.add_argument(f"--{name}", type=int, default=None, metavar="N", help=help_text)
    parser.add_argument("--imperfect", action="store_true", help="perturb the oracle")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="setting of all variants")
    options = parser.parse_args()
    try:
        run(options, new_console())
    except (BadInput, BackendUnavailable) as error:
        parser.error(str(error))


def run(options: argparse.Namespace, console: Console) -> None:
    """Run the requested ablations and print their tables.

    Raises:
        BadInput: a data set, an object, a number, a setting or a prior's weights cannot be used.
        BackendUnavailable: the prior's weights are not installed.
    """
    for name, default in (SMOKE if options.quick else FULL).items():
        if getattr(options, name) is None:
            setattr(options, name, default)
        if (value := getattr(options, name)) < 1:
            raise BadInput(f"--{name} is {value}; give at least 1")
    base = {
        **(QUICK if options.quick else {}),
        **(IMPERFECT if options.imperfect else {}),
        **parse_changes(options.set),
    }
    has_oracle = {**SMALL, **base}["prior.kind"] == "oracle"
    laboratory, rows = Laboratory(base, options.size), list[Row]()
    specimens = find_specimens(options.data, options.objects, options.frames, options.size)
    pictures = [specimen.name for specimen in specimens if len(specimen.cutouts) < 2]
    moving = [name for name in options.names if not ABLATIONS[name].still]
    if pictures and moving:
        raise BadInput(f"{', '.join(moving)}: needs videos; {', '.join(pictures)} has one frame only")
    scale = f"{options.seeds} seeds, {len(specimens[0].cutouts)} frames, {options.size} px"
    about = f"{', '.join(specimen.name for specimen in specimens)}; {scale}"
    for name in options.names:
        ablation, mine = ABLATIONS[name], list[Row]()
        for specimen in specimens:
            for seed in range(options.seeds):
                for title, variant in ablation.variants.items():
                    figures = laboratory.figures(specimen, variant, seed, ablation.still)
                    mine.append(Row(name, title, specimen.name, seed, figures))
        console.print(table(f"{name}: {about}", mine))
        asked = ablation if has_oracle else replace(ablation, caveat="")
        console.print(verdict(asked, mine), soft_wrap=True)
        rows += mine
        if options.json:
            write_rows(options.json, rows)


def find_specimens(data: Path | None, names: Sequence[str] | None, frames: int, size: int) -> list[Specimen]:
    """Return our own objects, or those of a data set.

    Raises:
        BadInput: the data set cannot be used, or does not have all that are named.
    """
    known: dict[str, Callable[[], Specimen]] = {name: partial(render_specimen, name, frames, size) for name in OBJECTS}
    if data is not None:
        known = {truth.name: partial(read_specimen, truth, frames) for truth in find_ground_truths(data)}
    if unknown := sorted(set(names or ()) - set(known)):
        raise BadInput(f"unknown objects {', '.join(unknown)}; choose from {', '.join(known)}")
    return [known[name]() for name in names or known]


if __name__ == "__main__":
    main()
