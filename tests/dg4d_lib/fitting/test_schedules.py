import pytest

from dg4d_lib.fitting.schedules import late_decay, log_linear, reference_size_at, resolution_at
from dg4d_lib.settings import RESOLUTION_SCHEDULE, MotionSettings, ResolutionStage


@pytest.mark.parametrize(("step", "rate"), [(1, 0.0099221), (100, 0.0045731), (250, 0.0014142), (500, 0.0002)])
def test_mean_rates_of_the_method(step: int, rate: float):
    assert log_linear(0.01, 0.0002, step / 500) == pytest.approx(rate, rel=1e-4)


@pytest.mark.parametrize(("progress", "factor"), [(0.0, 1.0), (0.5, 1.0), (0.75, 0.1), (1.0, 0.01)])
def test_late_decay_keeps_rates_for_half_of_the_iterations(progress: float, factor: float):
    assert late_decay(0.01, progress) == pytest.approx(factor)


@pytest.mark.parametrize(
    ("progress", "size"), [(0.0, 128), (0.29, 128), (0.3, 256), (0.59, 256), (0.6, 512), (1.0, 512)]
)
def test_the_resolution_schedule_of_the_method(progress: float, size: int):
    assert resolution_at(RESOLUTION_SCHEDULE, progress) == size


def test_the_reference_view_grows_to_its_full_size():
    assert reference_size_at(MotionSettings(), 0.1) == 256
    settings = MotionSettings(reference_schedule=(ResolutionStage(until=0.5, size=128),))
    assert [reference_size_at(settings, progress) for progress in (0.0, 0.49, 0.5, 1.0)] == [128, 128, 256, 256]
    small = settings.model_copy(update={"reference_size": 48})
    assert [reference_size_at(small, progress) for progress in (0.0, 1.0)] == [48, 48]
