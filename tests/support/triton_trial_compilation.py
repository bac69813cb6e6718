"""Compile the Triton kernels that trials launch for a GPU that need not be there.

`python triton_trial_compilation.py ARCHITECTURE KERNEL ...` runs `kernel_trials` of these kernel
packages, and prints what `triton_compilation` does. `TRITON_INTERPRET` must not be set.
"""

import json
import sys
from typing import Any

import torch
from kernel_trials import TRIALS
from triton_compilation import catch_launches

from lidarpainter_models.kernels import backends


def main():
    architecture, kernels = int(sys.argv[1]), sys.argv[2:]
    found = catch_launches(architecture)
    doors: Any = backends
    doors.why_no_triton = lambda: None
    doors.is_interpreting = lambda: True
    for kernel in kernels:
        TRIALS[kernel].run("triton", torch.device("cpu"))
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main()
