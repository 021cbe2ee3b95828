"""Training: it learns, goes on where it stopped, and gives the same weights again."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import binary_cross_entropy

from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
from dg4d_lib.shape_prior.network import ShapePriorConfig, load_network
from training.shape_prior import train as training
from training.shape_prior.batches import Batch, batches, make_batch
from training.shape_prior.losses import Losses, color_at, validation_figures
from training.shape_prior.muon import orthogonalized

TINY = ShapePriorConfig(widths=(8, 16, 32, 32), blocks=(1, 1, 1), layers=1, head=32)


@pytest.fixture(autouse=True)
def one_thread() -> object:
    """The order of sums depends on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def plan(samples: int, **others: float) -> training.Plan:
    return training.Plan(
        **{"samples": samples, "batch": 4, "rays": 256, "warmup": 64, "lr": 4e-3, "held_out": 2, **others}
    )  # type: ignore[arg-type]


def test_a_tiny_network_learns(tmp_path: Path) -> None:
    run = training.Run(plan(360, ema=0.9, lr=0.01), TINY)
    training.train(run, tmp_path, workers=0, every=180)
    curve = json.loads((tmp_path / "curves.json").read_text())
    assert [row["shown"] for row in curve] == [180, 360]
    held_out = [make_batch(training.VALIDATION_SEED, number, 4, 1024) for number in range(2)]
    matter = torch.cat([batch.occupancy for batch in held_out]).float() / 255
    same_for_every_ray = binary_cross_entropy(matter.mean(0).expand_as(matter), matter).item()
    assert curve[-1]["bce"] < 0.95 * same_for_every_ray
    assert curve[-1]["iou"] > 0.2
    assert (tmp_path / "curves.png").stat().st_size > 1000
    assert (tmp_path / training.WEIGHTS).stat().st_size < 1 << 20
    assert load_network(tmp_path / training.WEIGHTS).config == TINY


@pytest.mark.gpu
def test_a_gpu_trains_as_the_processor_does(tmp_path: Path) -> None:
    if not torch.cuda.is_available():
        pytest.skip("there is no CUDA device here")
    made, losses = [make_batch(1, number, 4, 256) for number in range(12)], {}
    for device in (torch.device("cpu"), torch.device("cuda")):
        run = training.Run(plan(48), TINY, device)
        losses[device.type] = [float(run.step(batch)["occupancy"]) for batch in made]
        run.save(tmp_path)
    assert losses["cuda"] == pytest.approx(losses["cpu"], rel=0.03)
    resumed = training.Run.load(tmp_path)  # on the processor what the GPU left
    assert resumed.shown == 48
    assert resumed.network.stem.weight.device.type == "cpu"


def test_a_run_that_was_stopped_gives_the_same_weights(tmp_path: Path) -> None:
    whole = training.Run(plan(32), TINY)
    training.train(whole, tmp_path / "whole", workers=0, every=16)
    part = training.Run(plan(32), TINY)
    for number in range(4):
        part.step(make_batch(1, number, 4, 256))
    (tmp_path / "parts").mkdir()
    part.save(tmp_path / "parts")
    resumed = training.Run.load(tmp_path / "parts")
    assert resumed.shown == 16
    training.train(resumed, tmp_path / "parts", workers=0, every=16)
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, resumed.network.state_dict()[name]), name
    for name, value in whole.average.state_dict().items():
        assert torch.equal(value, resumed.average.state_dict()[name]), name


def test_a_run_that_is_asked_to_stop_saves_where_it_stands(tmp_path: Path) -> None:
    stop = Event()
    stop.set()
    training.train(training.Run(plan(32, held_out=1), TINY), tmp_path, workers=0, stop=stop)
    assert training.Run.load(tmp_path).shown == 4


def test_a_run_that_is_asked_to_stop_saves_though_its_workers_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> Iterator[Batch]:
        yield make_batch(1, 0, 4, 16)
        raise BrokenProcessPool

    monkeypatch.setattr(training, "batches", broken)
    with pytest.raises(BackendUnavailable, match=r"was killed after 4 of 32 samples, .* run the same command again"):
        training.train(training.Run(plan(32, held_out=0), TINY), tmp_path / "killed")
    stop = Event()
    run = training.Run(plan(32, held_out=0), TINY)
    step = run.step
    monkeypatch.setattr(run, "step", lambda batch: (step(batch), setattr(run, "shown", 8))[0])

    def broken_later(*_: object) -> Iterator[Batch]:
        yield make_batch(1, 0, 4, 16)
        stop.set()  # the signal comes while the trainer waits
        raise BrokenProcessPool

    monkeypatch.setattr(training, "batches", broken_later)
    training.train(run, tmp_path / "stopped", stop=stop)
    assert training.Run.load(tmp_path / "killed").shown == 4
    assert training.Run.load(tmp_path / "stopped").shown == 8


def test_a_run_that_diverges_leaves_its_last_checkpoint(tmp_path: Path) -> None:
    run = training.Run(plan(12, lr=1e20, warmup=1, held_out=0, rays=16), TINY)
    run.save(tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(FitDiverged, match=r"not finite after \d+ of 12 samples \(--lr 1e\+20\); the last checkpoint"):
        training.train(run, tmp_path, workers=0)
    assert before == {file.name: file.read_bytes() for file in tmp_path.iterdir()}


def test_a_gradient_that_is_not_finite_is_not_saved(tmp_path: Path) -> None:
    run = training.Run(plan(12), TINY)
    run.gradient_norm = torch.tensor(torch.nan)
    with pytest.raises(FitDiverged, match="the gradient norm is not finite"):
        run.save(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        ("plane", "the mirror plane that the network gives for a held-out sample is not finite"),
        ("head", "the occupancy that the network gives for a held-out sample is not finite"),
    ],
)
def test_a_network_whose_output_is_not_finite_is_not_validated(layer: str, message: str) -> None:
    network = training.Run(plan(12), TINY).average
    with torch.no_grad():
        network.get_parameter(f"{layer}.bias")[0] = torch.inf
    with pytest.raises(FitDiverged, match=message):
        validation_figures(network, [make_batch(1, 0, 1, 16)])


def test_a_run_without_held_out_samples_has_no_validation_figures(tmp_path: Path) -> None:
    training.train(training.Run(plan(4, held_out=0, rays=16), TINY), tmp_path, workers=0)
    (row,) = json.loads((tmp_path / "curves.json").read_text())
    assert set(row) == {"shown", "rate", *(f"train_{name}" for name in Losses.__dataclass_fields__)}


@pytest.mark.parametrize("part", ["network", "average"])
def test_weights_of_a_run_that_are_not_finite_are_not_saved(part: str, tmp_path: Path) -> None:
    run = training.Run(plan(12), TINY)
    with torch.no_grad():
        getattr(run, part).stem.bias[0] = torch.inf
    with pytest.raises(FitDiverged, match=r"stem\.bias is not finite"):
        run.save(tmp_path)
    assert not list(tmp_path.iterdir())


def changed_checkpoint(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """Write the checkpoint of a new run, with a change in it."""
    training.Run(plan(32), TINY).save(folder)
    state = torch.load(folder / training.CHECKPOINT, weights_only=True)
    change(state)
    torch.save(state, folder / training.CHECKPOINT)
    return folder / training.CHECKPOINT


@pytest.mark.parametrize("part", ["network", "average"])
def test_a_checkpoint_that_is_not_finite_is_refused(part: str, tmp_path: Path) -> None:
    path = changed_checkpoint(tmp_path, lambda state: state[part]["stem.bias"].fill_(torch.nan))
    for read in (lambda: training.Run.load(tmp_path), lambda: training.Run(plan(32), TINY).warm_start(path)):
        with pytest.raises(BadInput, match=r"is of a run that diverged: stem\.bias has values that are not finite"):
            read()


@pytest.mark.parametrize(
    "change",
    [
        lambda state: state.pop("plan"),
        lambda state: state["plan"].update(rank=4),
        lambda state: state["network"].pop("stem.bias"),
        lambda state: state["average"].update({"stem.bias": 3}),
        lambda state: state["optimizers"].pop(),
    ],
)
def test_a_checkpoint_of_another_version_is_named(change: Callable[[dict[str, Any]], object], tmp_path: Path) -> None:
    path = changed_checkpoint(tmp_path, change)
    with pytest.raises(BadInput, match=rf"{path} cannot be read as a checkpoint of this trainer: \w+: "):
        training.Run.load(tmp_path)


@pytest.mark.filterwarnings("ignore:.*is a no-op:UserWarning")
def test_optimizers_of_a_resumed_run_count_their_steps_on_the_processor(tmp_path: Path) -> None:
    run = training.Run(plan(32), TINY)
    run.step(make_batch(1, 0, 4, 16))
    run.save(tmp_path)
    resumed = training.Run.load(tmp_path, torch.device("meta"))  # in place of a GPU, which would be synchronized
    states = resumed.optimizers[1].state.values()
    assert {state["step"].device.type for state in states} == {"cpu"}
    assert {state["exp_avg"].device.type for state in states} == {"meta"}


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the trainer from changing this process."""
    monkeypatch.setattr(training, "keep_freed_memory", lambda: None)
    monkeypatch.setattr(torch, "set_float32_matmul_precision", lambda _: None)
    monkeypatch.setattr(training.signal, "signal", lambda *_: None)


@pytest.mark.usefixtures("process")
@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("--samples 15", "--samples is 15, less than one batch. Give at least --batch (16)."),
        ("--batch 0", "--batch is 0. Give at least 1."),
        ("--threads 0", "--threads is 0. Give at least 1."),
        ("--every 0", "--every is 0. Give at least 1."),
        ("--warmup 0", "--warmup is 0. Give at least 1."),
        ("--cooldown 0", "--cooldown is 0.0. Give more than 0 and at most 1."),
        ("--rays 0", "--rays is 0. Give at least 1."),
        ("--lr nan", "--lr is nan. Give more than 0."),
        ("--workers=-1", "--workers is -1. Give at least 0."),
        ("--seed=-1", "--seed is -1. Give at least 0."),
        ("--device gpu", "'gpu' is not a device for training; give cpu or cuda"),
        ("--device meta", "'meta' is not a device for training; give cpu or cuda"),
        ("--device cuda:99", "CUDA devices; give cpu"),
        ("--widths 8 8 8 8", "widths 8 8 8 8 do not fit the network"),
        ("--warm-start nosuch.pt", "nosuch.pt cannot be read as a checkpoint"),
        ("--warm-start nosuch.safetensors", "nosuch.safetensors cannot be read as weights"),
    ],
)
def test_an_option_out_of_its_range_is_refused_by_name(
    given: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        training.main([str(tmp_path / "run"), *given.split()])
    assert ended.value.code == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.usefixtures("process")
@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("--lr 0.1", "other settings than those given: --lr (0.004)."),
        ("--seed 2 --batch 4", "--seed (1)."),
        ("--batch 8 --layers 2", "--batch (4), --layers (1)."),
        ("--widths 8 16 32 64", "--widths ([8, 16, 32, 32])."),
        ("--warm-start other.safetensors", "--warm-start is for new runs;"),
        ("--samples 3", "--samples is 3, but"),
    ],
)
def test_a_run_that_goes_on_refuses_other_settings(
    given: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = training.Run(plan(32), TINY)
    run.shown = 4
    run.save(tmp_path)
    with pytest.raises(SystemExit):
        training.main([str(tmp_path), *given.split()])
    assert says in capsys.readouterr().err


@pytest.mark.usefixtures("process")
@pytest.mark.parametrize(
    ("given", "samples"), [("", 32), ("--samples 800", 800), ("--lr 0.004 --widths 8 16 32 32 --seed 1", 32)]
)
def test_a_run_goes_on_with_its_own_settings(
    given: str, samples: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    training.Run(plan(32), TINY).save(tmp_path)
    plans: list[training.Plan] = []
    monkeypatch.setattr(training, "train", lambda run, *_, **__: plans.append(run.plan))
    training.main([str(tmp_path), *given.split()])
    assert plans == [plan(samples)]


@pytest.mark.usefixtures("process")
def test_a_checkpoint_that_is_cut_off_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    training.Run(plan(32), TINY).save(tmp_path)
    file = tmp_path / training.CHECKPOINT
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(SystemExit):
        training.main([str(tmp_path)])
    assert f"{file} cannot be read as a checkpoint of this trainer" in capsys.readouterr().err


@pytest.mark.usefixtures("process")
def test_a_run_that_diverges_ends_with_a_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    training.Run(plan(12, lr=1e20, warmup=1, held_out=0, rays=16), TINY).save(tmp_path)
    with pytest.raises(SystemExit) as ended:
        training.main([str(tmp_path), "--workers", "0"])
    assert ended.value.code == 1
    assert "training ended: " in capsys.readouterr().err


@pytest.mark.slow
def test_a_trainer_saves_when_its_process_group_is_asked_to_end(tmp_path: Path) -> None:
    options = "--widths 8 16 32 32 --layers 1 --batch 2 --rays 8 --held-out 0 --samples 40000 --every 2"
    command = [sys.executable, "-m", "training.shape_prior.train", str(tmp_path), *options.split()]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as trainer:
        assert trainer.stderr is not None
        while '"shown"' not in trainer.stderr.readline():
            assert trainer.poll() is None
        os.killpg(trainer.pid, signal.SIGTERM)
        _, said = trainer.communicate(timeout=60)
    assert trainer.returncode == 0 and "Traceback" not in said
    assert training.Run.load(tmp_path).shown >= 2


@pytest.mark.slow
def test_no_worker_is_left_when_one_is_killed() -> None:
    made = batches(1, 0, 1000, 1, 16, workers=2)
    next(made)
    killed, other = active_children()
    killed.kill()
    with pytest.raises(BrokenProcessPool):
        list(made)
    assert not other.is_alive()


@pytest.mark.slow
def test_batches_can_be_closed_after_a_worker_was_killed() -> None:
    made = batches(1, 0, 1000, 1, 16, workers=2)
    next(made)
    killed, other = active_children()
    killed.kill()
    killed.join()
    made.close()
    assert not other.is_alive()


@pytest.mark.slow
def test_workers_make_the_same_batches() -> None:
    here = list(batches(3, 5, 2, 2, 64, workers=0))
    there = list(batches(3, 5, 2, 2, 64, workers=1))
    for one, two in zip(here, there, strict=True):
        assert torch.equal(one.picture, two.picture)
        assert torch.equal(one.occupancy, two.occupancy)
        assert torch.equal(one.pixels, two.pixels)


@pytest.mark.slow
def test_workers_end_with_a_trainer_that_is_killed() -> None:
    code = """
import multiprocessing, sys
from training.shape_prior.batches import batches
if __name__ == "__main__":
    made = batches(1, 0, 100, 1, 16, workers=1)
    next(made)
    print(multiprocessing.active_children()[0].pid, flush=True)
    sys.stdin.read()
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as trainer:
        assert trainer.stdout is not None
        worker = int(trainer.stdout.readline())
        trainer.kill()
    deadline = time.monotonic() + 60
    while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()


def test_a_warm_start_takes_what_fits(tmp_path: Path) -> None:
    first = training.Run(plan(32), TINY)
    first.save(tmp_path)
    wider = training.Run(plan(32), ShapePriorConfig(widths=(8, 16, 32, 64), blocks=(1, 1, 1), layers=1, head=32))
    left_out = wider.warm_start(tmp_path / training.CHECKPOINT)
    assert torch.equal(wider.network.stem.weight, first.average.stem.weight)
    assert "places" in left_out
    assert "stem.weight" not in left_out


def test_a_warm_start_from_weights_has_all_of_them(tmp_path: Path) -> None:
    first, second = training.Run(plan(32), TINY), training.Run(plan(32, seed=7), TINY)
    first.save(tmp_path)
    assert not torch.equal(second.network.stem.weight, first.average.stem.weight)
    assert second.warm_start(tmp_path / training.WEIGHTS) == []
    for network in (second.network, second.average):
        torch.testing.assert_close(network.stem.weight, first.average.stem.weight, atol=1e-3, rtol=1e-3)


def test_the_rate_rises_stays_and_falls() -> None:
    rates = [plan(1000, cooldown=0.3).lr_at(shown) for shown in (0, 60, 500, 850, 1000)]
    assert rates == pytest.approx([4e-3 * 4 / 64, 4e-3, 4e-3, 2e-3, 0])


def test_orthogonalized_matrices_have_singular_values_near_one() -> None:
    matrix = torch.randn(24, 80, generator=torch.Generator().manual_seed(0))
    for given in (matrix, matrix.T):
        values = torch.linalg.svdvals(orthogonalized(given))
        assert values.min() > 0.6  # the quintic iteration of Muon ends between 0.7 and 1.2
        assert values.max() < 1.3


def test_hidden_colors_are_linear_between_knots() -> None:
    knots = torch.arange(8.0)[None, :, None].expand(4, 8, 3)
    depth = torch.tensor([0.0, 0.5, 0.93, 1.0])
    assert np.allclose(color_at(knots, depth)[:, 0], depth * 7, atol=1e-5)
