"""Training of the shape prior: resumable, deterministic for a seed and a thread count, on processors.

python -m training.shape_prior.train out/shape_prior --samples 600000
"""

import argparse
import ctypes
import json
import logging
import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from pickle import UnpicklingError
from threading import Event
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn

from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
from dg4d_lib.shape_prior.network import (
    ShapePriorConfig,
    ShapePriorNetwork,
    channels_last,
    load_network,
    not_finite,
    save_network,
)
from training.shape_prior.batches import Batch, batches, make_batch
from training.shape_prior.curves import draw_curves
from training.shape_prior.losses import LOWER_LR, training_losses, validation_figures
from training.shape_prior.muon import Muon

UNREADABLE = (OSError, EOFError, AttributeError, LookupError, TypeError, ValueError, RuntimeError, UnpicklingError)
VALIDATION_SEED = 1_000_003  # no training run uses it
CPU = torch.device("cpu")
CHECKPOINT, WEIGHTS, CURVES = "checkpoint.pt", "network.safetensors", "curves"
M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3  # of glibc's mallopt
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plan:
    """Settings of a training run; a run that goes on may change `samples` alone.

    Attributes:
        samples: synthetic shapes that are shown, each once.
        batch: samples of a step.
        rays: of each sample that are supervised.
        lr: peak learning rate.
        weight_decay: of AdamW.
        warmup: samples over which the rate rises.
        cooldown: share of all samples over which it falls to zero at the end.
        ema: weight of the past in the averaged network that is validated and shipped.
        seed: of the shapes and of the initial weights.
        held_out: batches for validation.
    """

    samples: int = 500_000
    batch: int = 16
    rays: int = 1024
    lr: float = 1.5e-3
    weight_decay: float = 0.02
    warmup: int = 8_000
    cooldown: float = 0.3
    ema: float = 0.999
    seed: int = 1
    held_out: int = 16

    def lr_at(self, shown: int) -> float:
        """Return the learning rate after a number of samples."""
        left = (self.samples - shown) / (self.cooldown * self.samples)
        return self.lr * min(1.0, (shown + self.batch) / self.warmup, max(0.0, left))


class Run:
    """State of one training run: networks, optimizer, samples shown, figures."""

    def __init__(self, plan: Plan, config: ShapePriorConfig, device: torch.device = CPU) -> None:
        self.plan = plan
        self.device = device
        torch.manual_seed(plan.seed)
        self.network = channels_last(ShapePriorNetwork(config)).to(device)
        self.average = deepcopy(self.network).eval()
        self.optimizers = make_optimizers(self.network, plan)
        self.shown = 0
        self.gradient_norm = torch.zeros(())
        self.curve: list[dict[str, float]] = []

    def step(self, batch: Batch) -> dict[str, Tensor]:
        """Show one batch; return its losses, on the device of the network."""
        for group in (group for optimizer in self.optimizers for group in optimizer.param_groups):
            group["lr"] = self.plan.lr_at(self.shown)
        losses = training_losses(self.network, batch.to(self.device))
        self.network.zero_grad(set_to_none=True)
        losses.total().backward()
        self.gradient_norm = nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        for optimizer in self.optimizers:
            optimizer.step()
        self.shown += len(batch.picture)
        steps = self.shown / self.plan.batch
        weight = 1 - min(self.plan.ema, (1 + steps) / (10 + steps))
        with torch.no_grad():
            torch._foreach_lerp_(list(self.average.parameters()), list(self.network.parameters()), weight)
        return {name: value.detach() for name, value in vars(losses).items()}

    def require_finite(self) -> None:
        """Refuse a run that diverged; the weights must also be finite in float16, in which they are shipped.

        Raises:
            FitDiverged: the gradient of the last step or a weight is not finite.
        """
        shipped = {name: value.half() for name, value in self.average.state_dict().items()}
        own = {"the gradient norm": self.gradient_norm, **self.network.state_dict()}
        if broken := not_finite(own) + not_finite(shipped):
            raise FitDiverged(
                f"{broken[0]} is not finite after {self.shown} of {self.plan.samples} samples (--lr "
                f"{self.plan.lr:g}); {LOWER_LR}"
            )

    def save(self, folder: Path) -> None:
        """Write the checkpoint and the averaged weights, each in one move.

        Raises:
            FitDiverged: as `require_finite`; nothing is written.
        """
        self.require_finite()
        state = {
            "plan": asdict(self.plan),
            "config": asdict(self.network.config),
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "shown": self.shown,
            "curve": self.curve,
        }
        torch.save(_on_cpu(state), folder / f"{CHECKPOINT}.new")
        (folder / f"{CHECKPOINT}.new").replace(folder / CHECKPOINT)
        save_network(self.average, folder / f"{WEIGHTS}.new")
        (folder / f"{WEIGHTS}.new").replace(folder / WEIGHTS)

    @classmethod
    def load(cls, folder: Path, device: torch.device = CPU) -> "Run":
        """Return the run of a checkpoint.

        Raises:
            BadInput: the checkpoint cannot be read, or holds weights that are not finite.
        """
        path = folder / CHECKPOINT
        state = _read_checkpoint(path)
        with _checkpoint_errors(path):
            plan, config = Plan(**state["plan"]), _config(state["config"])
        run = cls(plan, config, device)
        with _checkpoint_errors(path):
            run.network.load_state_dict(state["network"])
            run.average.load_state_dict(state["average"])
            for optimizer, value in zip(run.optimizers, state["optimizers"], strict=True):
                optimizer.load_state_dict(value)
            run.shown, run.curve = state["shown"], state["curve"]
        return run

    def warm_start(self, path: Path) -> list[str]:
        """Take the averaged weights of another run where names and shapes agree; return the names left out.

        Args:
            path: checkpoint of a run, or weights in safetensors such as the shipped ones.

        Raises:
            BadInput: the file cannot be read, or holds weights that are not finite.
        """
        shipped = path.suffix == ".safetensors"
        other = load_network(path).state_dict() if shipped else _read_checkpoint(path)["average"]
        own = self.network.state_dict()
        fitting = {name: value for name, value in other.items() if name in own and own[name].shape == value.shape}
        for network in (self.network, self.average):
            network.load_state_dict({**own, **fitting})
        return sorted(set(own) - set(fitting))


def make_optimizers(network: ShapePriorNetwork, plan: Plan) -> list[torch.optim.Optimizer]:
    """Return Muon for the matrices and convolutions inside the network, and AdamW for everything else."""
    ends = ("stem.", "places", "plane.", "head.")
    named = [(name, value) for name, value in network.named_parameters() if value.ndim > 1]
    outer = [value for name, value in named if name.startswith(ends)]
    inner = [value for name, value in named if not name.startswith(ends)]
    vectors = [value for value in network.parameters() if value.ndim <= 1]
    groups = [{"params": outer, "weight_decay": plan.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
    adam = torch.optim.AdamW(groups, lr=plan.lr, betas=(0.9, 0.99), foreach=True)
    return [Muon(inner, lr=plan.lr, weight_decay=plan.weight_decay), adam]


def train(
    run: Run, folder: Path, *, workers: int = 1, every: int = 16_000, save_s: float = 180.0,
    console: Console | None = None, stop: Event | None = None,
) -> None:  # fmt: skip
    """Train until all samples were shown.

    Args:
        run: where it stands; changed.
        folder: for checkpoint, weights and curves.
        workers: processes that make shapes; 0 makes them here.
        every: samples between two validations.
        save_s: seconds between two checkpoints.
        console: where progress is shown.
        stop: when set, the run is saved after the step in hand and ends.

    Raises:
        FitDiverged: a gradient or a weight is not finite; the last checkpoint stays as it is.
        BackendUnavailable: a process that makes shapes was killed; the run is saved.
    """
    plan = run.plan
    folder.mkdir(parents=True, exist_ok=True)
    held_out = [make_batch(VALIDATION_SEED, number, plan.batch, 1024).to(run.device) for number in range(plan.held_out)]
    left = (plan.samples - run.shown) // plan.batch
    stream = batches(plan.seed, run.shown // plan.batch, left, plan.batch, plan.rays, workers)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    saved, begun, first, sums = time.monotonic(), time.monotonic(), run.shown, Means()
    with Progress(*columns, console=console, disable=console is None or not console.is_terminal) as progress:
        task = progress.add_task("samples", total=plan.samples, completed=run.shown)
        for batch in _saved_if_broken(stream, run, folder, stop):
            sums.add(run.step(batch))
            progress.update(task, completed=run.shown)
            last, stopped = run.shown + plan.batch > plan.samples, stop is not None and stop.is_set()
            if run.shown % every < plan.batch or last:
                run.require_finite()
                rate = (run.shown - first) / (time.monotonic() - begun)
                run.curve.append(
                    {"shown": run.shown, "rate": rate, **sums.take(), **validation_figures(run.average, held_out)}
                )
                _log.info("%s", json.dumps({name: round(value, 4) for name, value in run.curve[-1].items()}))
                (folder / f"{CURVES}.json").write_text(json.dumps(run.curve, indent=1), encoding="utf-8")
                draw_curves(run.curve).save(folder / f"{CURVES}.png")
            if last or stopped or time.monotonic() - saved > save_s:
                run.save(folder)
                saved = time.monotonic()
            if stopped:
                break


def _saved_if_broken(stream: Iterator[Batch], run: Run, folder: Path, stop: Event | None) -> Iterator[Batch]:
    """Yield the batches; save the run if the processes that make them end, with the trainer or without it."""
    try:
        yield from stream
    except BrokenProcessPool as error:
        if run.shown:
            run.save(folder)
        if stop is None or not stop.is_set():
            raise BackendUnavailable(
                f"a process that makes shapes was killed after {run.shown} of {run.plan.samples} samples, most likely "
                "for lack of memory; run the same command again, with fewer --workers"
            ) from error


class Means:
    """Running means of named numbers."""

    def __init__(self) -> None:
        self._sums: dict[str, Tensor] = {}
        self._count = 0

    def add(self, values: dict[str, Tensor]) -> None:
        """Add one number per name, without waiting for it."""
        self._count += 1
        for name, value in values.items():
            self._sums[name] = self._sums[name] + value if name in self._sums else value

    def take(self) -> dict[str, float]:
        """Return the means since the last call."""
        means = {f"train_{name}": float(value) / max(1, self._count) for name, value in self._sums.items()}
        self._sums, self._count = {}, 0
        return means


def keep_freed_memory() -> None:
    """Have glibc reuse the memory of large tensors: returning it to the system costs a third of a step."""
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for option, value in ((M_MMAP_THRESHOLD, 1 << 30), (M_TRIM_THRESHOLD, (1 << 31) - 1), (M_TOP_PAD, 1 << 28)):
            mallopt(option, value)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train the shape prior, or go on where a run in the folder stopped."""
    parser = argparse.ArgumentParser(prog="python -m training.shape_prior.train", description=main.__doc__)
    parser.add_argument("folder", type=Path, help="checkpoint, weights and curves; a checkpoint in it is resumed")
    for name, value in asdict(Plan()).items():  # no defaults in the parser: a resumed run has its own values
        parser.add_argument(_option(name), type=type(value), default=argparse.SUPPRESS, help=f"default: {value}")
    parser.add_argument("--widths", type=int, nargs=4, default=argparse.SUPPRESS)
    parser.add_argument("--layers", type=int, default=argparse.SUPPRESS)
    parser.add_argument("--device", type=_device, default=CPU, help="cpu or cuda")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1, help="processes that make shapes")
    parser.add_argument("--every", type=int, default=16_000, help="samples between two validations")
    parser.add_argument("--warm-start", type=Path, help="checkpoint or weights of another run to begin with")
    given = parser.parse_args(arguments)
    _check_ranges(parser, given)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)
    keep_freed_memory()
    torch.set_num_threads(given.threads)
    torch.set_float32_matmul_precision("high")  # TF32 on GPUs; processors have none
    try:
        run = _resumed(parser, given) if (given.folder / CHECKPOINT).exists() else _new_run(parser, given)
    except BadInput as error:
        parser.error(str(error))
    parameters = sum(value.numel() for value in run.network.parameters())
    _log.info("%.2f million parameters, pid %d", parameters / 1e6, os.getpid())
    stop = Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    try:
        train(run, given.folder, workers=given.workers, every=given.every, console=Console(stderr=True), stop=stop)
    except (FitDiverged, BackendUnavailable) as error:
        parser.exit(1, f"{parser.prog}: training ended: {error}\n")


def _resumed(parser: argparse.ArgumentParser, given: argparse.Namespace) -> Run:
    run = Run.load(given.folder, given.device)
    _check_resumed(parser, given, run)
    run.plan = replace(run.plan, samples=getattr(given, "samples", run.plan.samples))
    _log.info("resumed at %d of %d samples", run.shown, run.plan.samples)
    return run


def _new_run(parser: argparse.ArgumentParser, given: argparse.Namespace) -> Run:
    plan = Plan(**{name: getattr(given, name, value) for name, value in asdict(Plan()).items()})
    if plan.samples < plan.batch:
        parser.error(f"--samples is {plan.samples}, less than one batch. Give at least --batch ({plan.batch}).")
    sizes = ShapePriorConfig()
    widths, layers = getattr(given, "widths", sizes.widths), getattr(given, "layers", sizes.layers)
    run = Run(plan, ShapePriorConfig(widths=tuple(widths), layers=layers), given.device)
    if given.warm_start:
        _log.info("warm start; new: %s", run.warm_start(given.warm_start))
    return run


def _device(text: str) -> torch.device:
    """Return the device that an option names."""
    try:
        device = torch.device(text)
    except RuntimeError:
        device = torch.device("meta")
    if device.type not in ("cpu", "cuda"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a device for training; give cpu or cuda")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise argparse.ArgumentTypeError(f"{text!r}: torch finds {torch.cuda.device_count()} CUDA devices; give cpu")
    return device


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _check_ranges(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """End with a message if an option is out of its range."""
    ranges: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
        ("samples batch rays warmup threads every", lambda value: value >= 1, "at least 1"),
        ("seed held_out layers workers", lambda value: value >= 0, "at least 0"),
        ("lr", lambda value: 0 < value < math.inf, "more than 0"),
        ("weight_decay", lambda value: 0 <= value < math.inf, "at least 0"),
        ("cooldown", lambda value: 0 < value <= 1, "more than 0 and at most 1"),
        ("ema", lambda value: 0 <= value <= 1, "0 to 1"),
    )
    for names, fits, allowed in ranges:
        for name in names.split():
            if name in given and not fits(getattr(given, name)):
                parser.error(f"{_option(name)} is {getattr(given, name)}. Give {allowed}.")


def _check_resumed(parser: argparse.ArgumentParser, given: argparse.Namespace, run: Run) -> None:
    """End with a message if an option does not fit the run that is resumed."""
    place, sizes = given.folder / CHECKPOINT, run.network.config
    own = {**asdict(run.plan), "widths": list(sizes.widths), "layers": sizes.layers}
    samples = getattr(given, "samples", own.pop("samples"))
    differing = [f"{_option(name)} ({value})" for name, value in own.items() if getattr(given, name, value) != value]
    if differing:
        parser.error(
            f"{place} has other settings than those given: {', '.join(differing)}. Only --samples may change when it "
            "is resumed. Leave the others out, or name another folder for a new run."
        )
    if given.warm_start:
        parser.error(f"--warm-start is for new runs; {place} is resumed. Leave it out, or name another folder.")
    if samples < run.shown:
        parser.error(f"--samples is {samples}, but {place} was shown {run.shown}. Give at least as many.")


def _read_checkpoint(path: Path) -> dict[str, Any]:
    """Return the state of a run on the processor, where optimizers keep their step counts.

    Raises:
        BadInput: the file is not a checkpoint of a run, or its weights are not finite.
    """
    with _checkpoint_errors(path):
        state: dict[str, Any] = dict(torch.load(path, weights_only=True, map_location=CPU))
        broken = not_finite(state["network"]) + not_finite(state["average"])
    if broken:
        raise BadInput(
            f"{path} is of a run that diverged: {broken[0]} has values that are not finite; begin a new run with a "
            "lower --lr in another folder"
        )
    return state


@contextmanager
def _checkpoint_errors(path: Path) -> Iterator[None]:
    """Turn errors of a file that is not a checkpoint of a run into BadInput."""
    try:
        yield
    except UNREADABLE as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise BadInput(
            f"{path} cannot be read as a checkpoint of this trainer: {reason}; give another file or, in the "
            "folder of a run, remove it to begin a new one"
        ) from error


def _on_cpu(value: Any) -> Any:
    """Return nested dicts and lists with every tensor on the processor: a checkpoint is read without a GPU."""
    if isinstance(value, Tensor):
        return value.cpu()
    if isinstance(value, dict):
        return {key: _on_cpu(item) for key, item in value.items()}
    return [_on_cpu(item) for item in value] if isinstance(value, list) else value


def _config(state: dict[str, Any]) -> ShapePriorConfig:
    return ShapePriorConfig(tuple(state["widths"]), tuple(state["blocks"]), state["layers"], state["head"])


if __name__ == "__main__":
    main()
