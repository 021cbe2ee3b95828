"""Batches of synthetic samples, by number: the same seed and number give the same batch in any process."""

import os
import signal
from collections import deque
from collections.abc import Generator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, fields, replace
from multiprocessing import active_children, get_context, parent_process
from threading import Thread
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dg4d_lib.shape_prior.frustum import BINS, SIZE
from training.shape_prior.kernels import soft_occupancy
from training.shape_prior.samples import Sample, make_sample

AHEAD = 6  # batches that are made before they are asked for, at least; with many workers two for each


@dataclass(frozen=True)
class Batch:
    """Pictures, with occupancy and colors along some of their rays.

    Attributes:
        picture: premultiplied color and alpha, 0 to 255.
        pixels: flat indices into batch, row and column of those rays.
        occupancy: share of every cell of those rays that lies in matter, 0 to 255.
        ray: for every surface that the picture does not show, the position of its ray in `pixels`.
        depth: of those surfaces, 0 at `NEAR`, 1 at `FAR`.
        color: of those surfaces, 0 to 255.
        plane: unit normal and offset of the mirror plane, zeros if there is none.
        symmetric: 1 with a mirror plane, 0 without, 0.5 if every vertical plane is one.
        families: numbers of the recipes, in the order of `FAMILIES`.
    """

    picture: UInt8[Tensor, "b 4 128 128"]
    pixels: Int[Tensor, " n"]
    occupancy: UInt8[Tensor, "n 64"]
    ray: Int[Tensor, " m"]
    depth: Float[Tensor, " m"]
    color: UInt8[Tensor, "m 3"]
    plane: Float[Tensor, "b 4"]
    symmetric: Float[Tensor, " b"]
    families: tuple[str, ...]

    def to(self, device: torch.device) -> "Batch":
        """Return the batch with its tensors on a device."""
        moved: dict[str, Any] = {
            name: value.to(device) for name, value in vars(self).items() if isinstance(value, Tensor)
        }
        return replace(self, **moved)


def make_batch(seed: int, number: int, size: int, rays: int) -> Batch:
    """Make batch `number`: samples number x size and those after it.

    Args:
        seed: of all samples.
        number: of the batch.
        size: samples in it.
        rays: greatest number of rays of each sample.
    """
    samples = [make_sample(seed, number * size + i) for i in range(size)]
    return join_samples(samples, rays, np.random.default_rng([seed, number, 1]))


def join_samples(samples: list[Sample], rays: int, generator: np.random.Generator) -> Batch:
    """Return samples as a batch, each with a random choice of its rays."""
    selected = [np.sort(generator.permutation(len(sample.pixels))[:rays]) for sample in samples]
    pairs = list(zip(samples, selected, strict=True))
    flat = np.concatenate([i * SIZE**2 + s.pixels[use].astype(np.int64) for i, (s, use) in enumerate(pairs)])
    counts = np.concatenate([s.counts[use] for s, use in pairs])
    depths = np.concatenate([s.depths[use] for s, use in pairs]).astype(np.float32) / 65535
    colors = np.concatenate([s.colors[use] for s, use in pairs])
    occupancy = soft_occupancy(depths, counts, np.empty((len(flat), BINS), np.float32))
    hidden = np.arange(depths.shape[1])[None] < counts[:, None]
    hidden[:, 0] = False
    ray, crossing = np.nonzero(hidden)
    return Batch(
        picture=torch.from_numpy(np.stack([s.picture for s in samples]).transpose(0, 3, 1, 2).copy()),
        pixels=torch.from_numpy(flat),
        occupancy=torch.from_numpy((occupancy * 255 + 0.5).clip(0, 255).astype(np.uint8)),
        ray=torch.from_numpy(ray),
        depth=torch.from_numpy(depths[ray, crossing]),
        color=torch.from_numpy(colors[ray, crossing]),
        plane=torch.from_numpy(np.stack([s.plane for s in samples])),
        symmetric=torch.tensor([s.symmetric for s in samples]),
        families=tuple(s.family for s in samples),
    )


def batches(seed: int, first: int, count: int, size: int, rays: int, workers: int) -> Generator[Batch, None, None]:
    """Yield batches `first` to `first + count - 1`, made by worker processes, or here if there are none.

    Raises:
        BrokenProcessPool: a worker was killed; the others are ended, too, as when the iterator is closed.
    """
    numbers = iter(range(first, first + count))
    if not workers:
        yield from (make_batch(seed, number, size, rays) for number in numbers)
        return
    others = set(active_children())
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_prepare_worker) as pool:
        waiting: deque[Future[dict[str, object]]] = deque()
        try:
            for number in numbers:
                waiting.append(pool.submit(_packed, seed, number, size, rays))
                if len(waiting) > max(AHEAD, 2 * workers):
                    yield _unpacked(waiting.popleft().result())
            while waiting:
                yield _unpacked(waiting.popleft().result())
        except (BrokenProcessPool, GeneratorExit):
            for worker in set(active_children()) - others:
                worker.kill()  # the executor sends SIGTERM, which workers ignore, and would wait for them
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def _prepare_worker() -> None:
    """Use one thread, leave signals to the trainer, and end when it is gone."""
    for number in (signal.SIGINT, signal.SIGTERM):  # sent to the whole process group
        signal.signal(number, signal.SIG_IGN)
    torch.set_num_threads(1)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _packed(seed: int, number: int, size: int, rays: int) -> dict[str, object]:
    """Return a batch as arrays: tensors would travel through shared memory files, which containers limit."""
    batch = make_batch(seed, number, size, rays)
    return {field.name: _arrays(getattr(batch, field.name)) for field in fields(Batch)}


def _arrays(value: object) -> object:
    if isinstance(value, Tensor):
        return value.numpy()
    return tuple(_arrays(part) for part in value) if isinstance(value, tuple) else value


def _unpacked(arrays: dict[str, Any]) -> Batch:
    return Batch(**{name: _tensors(value) for name, value in arrays.items()})


def _tensors(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return torch.from_numpy(value)
    return tuple(_tensors(part) for part in value) if isinstance(value, tuple) else value
