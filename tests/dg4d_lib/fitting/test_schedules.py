import pytest

from dg4d_lib.fitting.schedules import log_linear, resolution_at
from dg4d_lib.settings import RESOLUTION_SCHEDULE


@pytest.mark.parametrize(("step", "rate"), [(1, 0.0099221), (100, 0.0045731), (250, 0.0014142), (500, 0.0002)])
def test_mean_rates_of_the_method(step: int, rate: float):
    assert log_linear(0.01, 0.0002, step / 500) == pytest.approx(rate, rel=1e-4)


@pytest.mark.parametrize(
    ("progress", "size"), [(0.0, 128), (0.29, 128), (0.3, 256), (0.59, 256), (0.6, 512), (1.0, 512)]
)
def test_the_resolution_schedule_of_the_method(progress: float, size: int):
    assert resolution_at(RESOLUTION_SCHEDULE, progress) == size
