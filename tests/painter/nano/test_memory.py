"""What painting costs beside computing, in a process that is set up as the command is."""

import platform
import subprocess
import sys

import pytest

FAULTS_OF_A_VIEW = """
import resource
import statistics
from flows.environment import prepare_environment
prepare_environment()
import torch
from lidarpainter_models.painter.nano.network import NanoConfig, NanoNetwork
from lidarpainter_models.painter.nano.painter import NanoPainter
from lidarpainter_models.painter.protocol import PaintingConditions

torch.set_num_threads(1)
height_px, width_px = 320, 480
image, plane = torch.rand(height_px, width_px, 3), torch.ones(height_px, width_px)
conditions = PaintingConditions(
    render_rgb=image, render_depth_m=plane, render_alpha=plane,
    lidar_rgb=image, lidar_depth_m=plane, lidar_hit=plane > 0,
    warp_rgb=torch.stack([image] * 2), warp_valid=torch.stack([plane > 0] * 2),
)
painter = NanoPainter(NanoNetwork(NanoConfig(widths=(8, 8, 8), blocks=(1, 1, 1))))
faults = []
for _ in range(8):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    painter.paint(conditions)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(int(statistics.median(faults[3:])))  # by then the memory has grown to its size
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="how glibc gives memory back")
def test_a_view_is_painted_in_the_memory_that_the_one_before_it_freed():
    run = [sys.executable, "-c", FAULTS_OF_A_VIEW]
    printed = subprocess.run(run, check=True, capture_output=True, text=True).stdout
    assert int(printed) < 1000  # pages of 4 KiB; thousands if the memory is given back
