"""Compile the Triton kernels that trials launch for a GPU that need not be there.

`python triton_trial_compilation.py ARCHITECTURE KERNEL ...` runs `kernel_trials` of these kernel
packages, and prints what `triton_compilation` does, by kernel and the options that are on.
`TRITON_INTERPRET` must not be set.
"""

import json
import sys

import torch
import triton
from kernel_trials import TRIALS
from triton_compilation import compiled

from lidarpainter_models.kernels import backends, gpu_packages


def main():
    architecture, kernels = int(sys.argv[1]), sys.argv[2:]
    found = {}

    def catch(kernel, *values, grid, warmup, **named):
        del grid, warmup
        arguments = dict(zip(kernel.arg_names, values, strict=False))
        arguments |= {name: named.pop(name) for name in kernel.arg_names if name in named}
        options = "".join(f" {name}" for name, value in arguments.items() if value is True)
        name = kernel.fn.__name__ + options
        found[name] = compiled(kernel, arguments, named, architecture)

    triton.JITFunction.run = catch
    backends.why_no_triton = lambda: None
    gpu_packages.check_triton_device = lambda *_: None
    for kernel in kernels:
        TRIALS[kernel].run("triton", torch.device("cpu"))
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main()
