"""Triton's kernels as a GPU would get them, compiled by a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path


def machine_code(*words):
    """What `triton_compilation.py` finds of kernels: their registers and stack, by name."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    result = subprocess.run(
        [sys.executable, Path(__file__).with_name("triton_compilation.py"), *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env=environment | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def assert_fits(found):
    """Every kernel compiled without spilling a register."""
    assert found
    for name, use in found.items():
        assert use["ptx"], name
        assert use["REG"] <= 255, name
        assert use["STACK"] == 0, f"{name} spills registers"
