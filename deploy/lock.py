"""Lock files of deploy/locks: exact versions with the SHA-256 of every file, one lock per place of installation.

    out/tools/bin/python deploy/lock.py [OPTION OF uv ...]      # --upgrade, --upgrade-package NAME

A single resolution of pyproject.toml for Python 3.11 and 3.12 fills all locks, so a package has the same version in
each. Versions stay as they are unless an option says otherwise. PyTorch's own index is queried for the CPU build of
torch only, and only when the version of torch changes. `make lock` runs this with the uv of deploy/locks/tools.txt.
"""

import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
LOCKS = ROOT / "deploy" / "locks"
SCRATCH = ROOT / "out" / "lock"
UV = Path(sys.executable).with_name("uv")
COMPILE = ("pip", "compile", "-", "--universal", "--python-version", "3.11", "--no-header", "--no-annotate", "--quiet")
TORCH_INDEX = os.environ.get("TORCH_INDEX") or "https://download.pytorch.org/whl/cpu"
GPU_ONLY = re.compile(r"torch|triton|(nvidia|cuda)-.+")  # replaced by, or absent from, the CPU build of torch
TOOLS = ("pip-audit", "uv")
HEADER = "# Written by `make lock`; do not edit.\n"

Blocks = dict[str, str]  # a package's canonical name: its requirement with all hashes


def main(options: list[str]) -> None:
    """Write all locks; `options` go to uv."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras: dict[str, list[str]] = project["project"]["optional-dependencies"]
    core, dev = project["project"]["dependencies"], project["dependency-groups"]["dev"]
    imported = (ROOT / "deploy" / "images" / "steps.txt").read_text(encoding="utf-8").splitlines()
    every_extra = [line for lines in extras.values() for line in lines]
    known = ("steps", "flows", "cuda", "dev", "meshopt")
    every = resolve("all", [*core, *every_extra, *dev, *project["build-system"]["requires"]], known, options)

    def closure(*groups: Iterable[str]) -> set[str]:
        return set(parse(uv([line for group in groups for line in group], "--constraints", pins(every))))

    gpu = {name for name in every if GPU_ONLY.fullmatch(name)}
    steps = closure(imported, ["torch"], project["build-system"]["requires"]) - gpu
    flows = closure(core, *(extras[name] for name in ("cluster", "s3", "signing"))) - gpu - steps
    cuda = closure(["torch"], extras["cuda"], extras["diffusion"]) - steps
    meshopt = {"meshoptimizer"}
    rest = closure(core, dev, *(lines for name, lines in extras.items() if name != "cuda"))
    for name, packages in {
        "steps": steps,
        "flows": flows,
        "cuda": cuda,
        "dev": rest - gpu - steps - flows - meshopt,
        "meshopt": meshopt,
    }.items():
        write(name, {package: every[package] for package in packages})
    write("tools", resolve("tools", TOOLS, ("tools",), options))
    write("docs", resolve("docs", project["dependency-groups"]["docs"], ("docs",), options))
    write_torch(every["torch"].split()[0].removeprefix("torch=="))


def resolve(name: str, wanted: Iterable[str], known: Iterable[str], options: list[str]) -> Blocks:
    """Resolve requirements to versions with hashes, starting from those of the locks `known`."""
    SCRATCH.mkdir(parents=True, exist_ok=True)
    output = SCRATCH / f"{name}.txt"
    earlier: Blocks = {}
    for path in (LOCKS / f"{lock}.txt" for lock in known):
        if path.exists():
            earlier |= parse(path.read_text(encoding="utf-8"))
    output.write_text("".join(earlier.values()), encoding="utf-8")
    uv(wanted, "--generate-hashes", "--output-file", str(output), *options)
    return parse(output.read_text(encoding="utf-8"))


def uv(wanted: Iterable[str], *options: str) -> str:
    """Run `uv pip compile` on requirements and return what it writes."""
    command = [str(UV), *COMPILE, *options]
    return subprocess.run(command, input="\n".join(wanted), stdout=subprocess.PIPE, text=True, check=True).stdout


def parse(text: str) -> Blocks:
    """Split a requirements file into one block for each package."""
    blocks = re.findall(r"^[A-Za-z0-9].*\n(?:[ ]+.*\n)*", text, re.MULTILINE)
    return {re.split(r"==|[\[ @;]", block, maxsplit=1)[0].lower(): block for block in blocks}


def pins(blocks: Blocks) -> str:
    """Write the versions of a resolution without hashes, and return the path."""
    path = SCRATCH / "pins.txt"
    path.write_text("".join(block.split(" \\\n")[0] + "\n" for block in blocks.values()), encoding="utf-8")
    return str(path)


def write(name: str, blocks: Blocks, note: str = "") -> None:
    """Write a lock, sorted by name, unless it has this text already: what is made of it stays as it is."""
    path, text = LOCKS / f"{name}.txt", HEADER + note + "".join(block for _, block in sorted(blocks.items()))
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def write_torch(version: str) -> None:
    """Write the lock of torch's CPU build, unless it has this version already."""
    path = LOCKS / "torch.txt"
    if path.exists() and f"\ntorch=={version}+cpu " in path.read_text(encoding="utf-8"):
        return
    found = uv([f"torch=={version}+cpu"], "--no-deps", "--generate-hashes", "--default-index", TORCH_INDEX)
    write(
        "torch",
        parse(found),
        "# Not on PyPI: from https://download.pytorch.org/whl/cpu, which is asked for nothing else.\n",
    )


if __name__ == "__main__":
    main(sys.argv[1:])
