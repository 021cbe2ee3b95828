"""Pictures, conversions and page of the gallery: `python -m examples.gallery.make_gallery [NAME ...]`.

Names choose entries; the others keep their files and times. Packages lie in out/gallery.
"""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from PIL import Image
from torch import Tensor

import dg4d
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.images import over_white
from dg4d_lib.mesh.render import LitRenderer
from dg4d_lib.rasterizer.interface import get_rasterizer
from examples.gallery.pictures import write_picture
from flows.inputs.manifest import parse_changes
from steps.artifacts.packages import read_manifest
from steps.artifacts.rendering import mesh_at, read_states, read_surface

ROOT = Path(__file__).parents[2]
PAGE, FOLDER, PACKAGES = ROOT / "docs" / "gallery.md", ROOT / "docs" / "gallery", ROOT / "out" / "gallery"
TIMES = FOLDER / "times.json"
PANEL = 200  # pixels of a side: lit mesh, splats
FPS, LOOPS, SWAY_DEG = 10, 2, 35.0
DISTANCE = 2.2  # of the camera; 2 would cut off what sways towards it
QUALITIES = (60, 50, 40, 30)  # of WebP; the first by which a film is small enough
MOST_BYTES = 150_000
HEAD = """# Gallery

Ten assets of the default profile, `preview`: no GPU, no pretrained generator, one picture each. First the input, then
the lit mesh and the splats while the camera sways by 35 degrees to both sides. Backs and hidden parts are guesses,
and the motion is one of the six loops that need no model.

`make gallery` draws the inputs (`examples/gallery`), converts them and writes this page. Times are those of the
conversions shown, on two cores with some work beside: about a minute where the mesh follows the motion of the splats,
twice that where it follows the video. The pictures are Apache-2.0, as the rest of the project.
"""


@dataclass(frozen=True)
class Entry:
    """Picture of the gallery and its conversion.

    Attributes:
        picture: file in docs/gallery.
        title: subject and kind of input.
        changes: settings, as of `--set`.
        seed: of every step.
    """

    picture: str
    title: str
    changes: tuple[str, ...]
    seed: int = 0

    @property
    def name(self) -> str:
        """Name of the asset."""
        return self.picture.split(".", maxsplit=1)[0]

    @property
    def command(self) -> str:
        """Command that converts the picture."""
        words = ["dg4d make", f"docs/gallery/{self.picture}", *(f"--set {change}" for change in self.changes)]
        return " ".join(words + [f"--seed {self.seed}"] * bool(self.seed))


@dataclass(frozen=True)
class Result:
    """Figures of one conversion.

    Attributes:
        seconds: of the whole conversion.
        failing: quality gates that the asset fails.
    """

    seconds: float
    failing: list[str]


ENTRIES = (
    Entry("elephant.webp", "Animal: an elephant", ("driving.motion=bounce",)),
    Entry("robot.webp", "Biped: a robot", ("driving.motion=wave",)),
    Entry("toucan.webp", "Bird: a toucan", ("driving.motion=sway",)),
    Entry("fish.webp", "Fish: a clownfish", ("driving.motion=wave",)),
    Entry("cactus.webp", "Plant: a cactus in a pot", ("driving.motion=bend",)),
    Entry("car.webp", "Vehicle: a loaded car", ("driving.motion=bounce",)),
    Entry("armchair.webp", "Furniture: an armchair", ("driving.motion=breathe",)),
    Entry("rings.webp", "Toy: stacking rings", ("driving.motion=sway",)),
    Entry("octopus.webp", "Flat drawing on paper, cut out by its plain background", ("driving.motion=wave",)),
    Entry("duck.jpg", "Photograph of a rendered scene, cut out by U2-Netp", ("driving.motion=turn",)),
)


def main(arguments: Sequence[str]) -> None:
    """Make the chosen entries, or all, and write the page."""
    parser = argparse.ArgumentParser(prog="python -m examples.gallery.make_gallery", description=__doc__)
    names = [entry.name for entry in ENTRIES]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"entries to make again: {', '.join(names)}")
    wanted = parser.parse_args(arguments).names
    if unknown := [name for name in wanted if name not in names]:
        parser.error(f"unknown: {', '.join(unknown)}; choose from {', '.join(names)}")
    chosen = [entry for entry in ENTRIES if not wanted or entry.name in wanted]
    results = read_results()
    for entry in chosen:
        results[entry.name] = make_entry(entry)
        TIMES.write_text(json.dumps({name: asdict(one) for name, one in results.items()}, indent=1) + "\n")
    PAGE.write_text(page(results), encoding="utf-8")


def make_entry(entry: Entry) -> Result:
    """Draw, convert and film one entry."""
    picture = FOLDER / entry.picture
    picture.parent.mkdir(exist_ok=True)
    write_picture(entry.name, picture)
    settings = parse_changes(list(entry.changes))
    asset = dg4d.make(picture, out=PACKAGES / entry.name, seed=entry.seed, force=True, **settings)
    write_film(asset.folder, FOLDER / f"{entry.name}_film.webp")
    return Result(asset.report["wall_s"], asset.failing or [])


def write_film(package: Path, path: Path) -> None:
    """Write lit mesh and splats side by side while the camera sways."""
    manifest = read_manifest(package)
    states, surface = read_states(package, manifest), read_surface(package, manifest)
    rasterize = get_rasterizer("auto")
    renderer = LitRenderer()
    count = round(LOOPS * manifest.frames / manifest.fps * FPS)
    pictures = []
    for k in range(count):
        position = torch.tensor([k * LOOPS * manifest.frames / count % manifest.frames], dtype=torch.float64)
        camera = OrbitCamera(8.0, SWAY_DEG * math.sin(2 * math.pi * k / count), DISTANCE, width=PANEL, height=PANEL)
        splats = rasterize(states(position), [camera], torch.ones(3)).color[0]
        mesh = over_white(torch.cat(renderer.render(mesh_at(surface, position[0]), camera), -1))
        pictures.append(Image.fromarray(np.concatenate([_bytes(mesh), _bytes(splats)], axis=1)))
    for quality in QUALITIES:
        pictures[0].save(
            path, save_all=True, append_images=pictures[1:], duration=1000 // FPS, loop=0, quality=quality, method=6
        )
        if path.stat().st_size <= MOST_BYTES:
            break


def read_results() -> dict[str, Result]:
    """Return the figures of earlier runs by name."""
    if not TIMES.is_file():
        return {}
    return {name: Result(**one) for name, one in json.loads(TIMES.read_text(encoding="utf-8")).items()}


def page(results: dict[str, Result]) -> str:
    """Return the page of the gallery."""
    return HEAD + "".join(_section(entry, results[entry.name]) for entry in ENTRIES if entry.name in results)


def _section(entry: Entry, result: Result) -> str:
    gates = (
        f"fails {', '.join(f'`{gate}`' for gate in result.failing)}" if result.failing else "passes all quality gates"
    )
    return (
        f"\n## {entry.title}\n\n"
        f"![Input: {entry.name}](gallery/{entry.picture}) "
        f"![Animation: {entry.name}](gallery/{entry.name}_film.webp)\n\n"
        f"```\n{entry.command}\n```\n\n"
        f"{result.seconds:.0f} s; {gates}.\n"
    )


def _bytes(picture: Float[Tensor, "h w 3"]) -> ndarray:
    return (picture.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


if __name__ == "__main__":
    main(sys.argv[1:])
