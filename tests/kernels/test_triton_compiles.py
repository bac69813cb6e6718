"""Triton kernels beside the rasteriser's as a GPU would get them.

They are those that the trials of the check of a GPU launch, so every kernel package takes part once
it has a `triton.py`.
"""

from pathlib import Path

import kernel_trials
import pytest
from machine_code import assert_fits, machine_code
from splat_drawing import TRITON, WITHOUT_TRITON

KERNELS = Path(__file__).resolve().parents[2] / "lidarpainter_models" / "kernels"
WRITTEN = [name for name in kernel_trials.TRIALS if (KERNELS / name / "triton.py").is_file()]
pytestmark = TRITON.marks
if WITHOUT_TRITON is not None:
    pytest.skip(WITHOUT_TRITON, allow_module_level=True)


@pytest.mark.parametrize("architecture", [pytest.param(80, marks=pytest.mark.slow), 90])
def test_every_kernel_compiles_to_machine_code_without_spilling(architecture):
    found = machine_code(architecture, *WRITTEN)
    assert len(found) >= len(WRITTEN)
    assert_fits(found)
