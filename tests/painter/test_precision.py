"""The type a painter computes in: measured once, never the slower one."""

import subprocess
import sys

import pytest
import torch

from lidarpainter_models.painter import precision
from lidarpainter_models.painter.description import time_views
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.painter import NanoPainter

CPU = torch.device("cpu")


@pytest.fixture
def machine(monkeypatch):
    """A CPU whose bfloat16 takes a given share of float32's time; counts what is timed."""
    timed = []

    def of(share):
        def convolution_s(dtype):
            timed.append(dtype)
            return share if dtype == torch.bfloat16 else 1.0

        monkeypatch.setattr(precision, "convolution_s", convolution_s)
        precision.faster_type.cache_clear()
        return timed

    yield of
    precision.faster_type.cache_clear()


@pytest.mark.parametrize(
    ("share", "expected"), [(0.5, torch.bfloat16), (0.95, torch.float32), (8.0, torch.float32)]
)
def test_bfloat16_is_chosen_where_it_is_clearly_faster(machine, share, expected):
    timed = machine(share)
    painters = [NanoPainter(NanoNetwork(NanoConfig())) for _ in range(2)]
    assert [painter.precision for painter in painters] == [expected] * 2
    assert len(timed) == 2  # each type once, not once per painter


def test_a_precision_that_is_asked_for_is_not_measured(machine):
    timed = machine(8.0)
    painter = NanoPainter(NanoNetwork(NanoConfig()), precision=torch.bfloat16)
    assert painter.precision == torch.bfloat16
    assert timed == []


CHOICE = """
import torch
from lidarpainter_models.painter.precision import convolution_s, faster_type
chosen = faster_type(torch.device("cpu"))
times_s = {dtype: min(convolution_s(dtype) for _ in range(3)) for dtype in (torch.float32, chosen)}
print(times_s[chosen] / times_s[torch.float32])
"""


@pytest.mark.parametrize(
    "held_to", [{}, {"ATEN_CPU_CAPABILITY": "avx2"}, {"ONEDNN_MAX_CPU_ISA": "AVX512_CORE"}]
)
def test_the_choice_is_never_slower_than_float32(held_to, monkeypatch):
    for name, value in held_to.items():
        monkeypatch.setenv(name, value)
    run = [sys.executable, "-c", CHOICE]
    printed = subprocess.run(run, check=True, capture_output=True, text=True).stdout
    assert float(printed) < 1.5  # a busy moment; the wrong choice takes three to ten times as long


def test_times_of_a_view_are_positive():
    painter = NanoPainter(NanoNetwork(NanoConfig(widths=(8, 8, 8), blocks=(1, 1, 1))))
    times = time_views(painter, height_px=16, width_px=24, repeats=1)
    assert times.cpu_ms > 0
    assert times.wall_ms > 0
