"""Triton kernels beside the rasteriser's as a GPU would get them.

They are those that the trials of the check of a GPU launch, so every kernel package takes part once
it has a `triton.py`.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import kernel_trials
import pytest
from splat_drawing import TRITON, WITHOUT_TRITON

KERNELS = Path(__file__).resolve().parents[2] / "lidarpainter_models" / "kernels"
SUPPORT = Path(__file__).resolve().parents[1] / "support"
WRITTEN = [name for name in kernel_trials.TRIALS if (KERNELS / name / "triton.py").is_file()]
pytestmark = TRITON.marks
if WITHOUT_TRITON is not None:
    pytest.skip(WITHOUT_TRITON, allow_module_level=True)


@pytest.mark.parametrize(
    "architecture", [pytest.param(80, marks=pytest.mark.slow), pytest.param(90)]
)
def test_every_kernel_compiles_to_machine_code_without_spilling(architecture):
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    result = subprocess.run(
        [sys.executable, SUPPORT / "triton_trial_compilation.py", str(architecture), *WRITTEN],
        capture_output=True,
        text=True,
        check=False,
        env=environment | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    assert len(found) >= len(WRITTEN)
    for name, use in found.items():
        assert use["ptx"], name
        assert use["REG"] <= 255, name
        assert use["STACK"] == 0, f"{name} spills registers"
