"""Compile Triton kernels for a GPU that need not be there.

`python triton_compilation.py ARCHITECTURE COEFFICIENTS FEATURES` draws a scene with gradients,
`... ARCHITECTURE KERNEL ...` runs `kernel_trials` of these kernel packages; either catches every
launch before it runs, and compiles it to machine code by the compiler and assembler
in Triton's wheel. It prints, as JSON by kernel, the registers of a thread and the bytes of stack,
which are spilled registers. `TRITON_INTERPRET` must not be set.
"""

import json
import re
import subprocess
import sys
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import torch
import triton
from kernel_trials import TRIALS
from splat_drawing import pinhole
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from lidarpainter_models.kernels import backends
from lidarpainter_models.kernels.gaussian_raster import triton as backend

TYPES = {
    torch.bool: "*i1",
    torch.float32: "*fp32",
    torch.float64: "*fp64",
    torch.int32: "*i32",
    torch.int64: "*i64",
    torch.uint8: "*u8",
}
CUOBJDUMP = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"


def type_of(value):
    """How a launch names the type of an argument."""
    if isinstance(value, tuple):
        return tuple(map(type_of, value))
    if torch.is_tensor(value):
        return TYPES[value.dtype]
    return "fp32" if isinstance(value, float) else "i32"


def alignments(value, *path):
    """Tensors of an argument, all of which begin at a multiple of 16 bytes."""
    if isinstance(value, tuple):
        for place, part in enumerate(value):
            yield from alignments(part, *path, place)
    elif torch.is_tensor(value):
        yield path


def compiled(kernel, arguments, options, architecture):
    """Registers and stack of a kernel as it is launched; both of the cubin."""
    signature: dict[str, str] = {}
    constants: dict[str, Any] = {}
    alignment: dict[tuple[int, ...], Any] = {}
    for place, (name, value) in enumerate(arguments.items()):
        if kernel.params[place].is_constexpr:
            signature[name], constants[name] = "constexpr", value
        else:
            signature[name] = type_of(value)
            alignment |= {key: [["tt.divisibility", 16]] for key in alignments(value, place)}
    source = ASTSource(fn=kernel, signature=signature, constexprs=constants, attrs=alignment)
    options = options | {"enable_fp_fusion": True}
    code = triton.compile(source, target=GPUTarget("cuda", architecture, 32), options=options)
    with NamedTemporaryFile(suffix=".cubin") as cubin:
        cubin.write(code.asm["cubin"])
        cubin.flush()
        usage = subprocess.run(
            [CUOBJDUMP, "--dump-resource-usage", cubin.name],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    found = {key: int(number) for key, number in re.findall(r"(REG|STACK):(\d+)", usage)}
    return found | {"ptx": f".target sm_{architecture}" in code.asm["ptx"]}


def scene(coefficients, features, count=5):
    """Tensors as the backend takes them; none of their values matters."""
    splats = [torch.rand(count, *size) for size in ((3,), (4,), (3,), (), (coefficients, 3))]
    splats.append(torch.rand(count, features))
    for tensor in splats:
        tensor.requires_grad_()
    poses = torch.eye(4).double()[None]
    camera = pinhole(fx_px=9.0, fy_px=9.0, cx_px=9.0, cy_px=9.0, width_px=18, height_px=18)
    return [*splats, poses, torch.zeros(count, dtype=torch.int32), camera, None]


def catch_launches(architecture):
    """Compile what is launched from now on instead of running it.

    What a kernel uses is filled in, by its name and the options that are on.
    """
    found = {}

    def catch(kernel, *values, grid, warmup, **named):
        del grid, warmup
        arguments = dict(zip(kernel.arg_names, values, strict=False))
        arguments |= {name: named.pop(name) for name in kernel.arg_names if name in named}
        if "tile_count" in arguments:
            arguments["tile_count"].fill_(1)  # it says how much room the lists need
        options = "".join(f" {name}" for name, value in arguments.items() if value is True)
        found[kernel.fn.__name__ + options] = compiled(kernel, arguments, named, architecture)

    triton.JITFunction.run = catch
    return found


def main():
    architecture, *words = sys.argv[1:]
    found = catch_launches(int(architecture))
    if words[0].isdigit():
        drawn = backend._DrawView.apply(*scene(*map(int, words)))
        sum(image.sum() for image in drawn[:4]).backward()
    else:
        doors: Any = backends
        doors.why_no_triton = lambda: None
        doors.is_interpreting = lambda: True
        for kernel in words:
            TRIALS[kernel].run("triton", torch.device("cpu"))
    sys.stdout.write(json.dumps(found))


if __name__ == "__main__":
    main()
