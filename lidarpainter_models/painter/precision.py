"""The type in which a painter computes: bfloat16 where the machine multiplies it faster.

A CPU with AMX or AVX-512 BF16 runs a convolution in bfloat16 about twice as fast as in float32; one
without emulates it and takes three to ten times as long. What a CPU says of itself does not settle
it (oneDNN may be held to fewer instructions than there are, and accepts bfloat16 with plain
AVX-512), so a small convolution is timed, once per process.
"""

import time
from functools import cache

import torch
import torch.nn.functional as F  # noqa: N812

from lidarpainter_models.painter.protocol import Painter

CHANNELS, ROWS, COLUMNS = 64, 32, 24
"""Of the convolution, like those of the small painter's middle layers."""
REPEATS = 3
LEAST_GAIN = 1.25
"""bfloat16 has to be faster by this: CPUs lie far on either side of it (0.1 to 0.4, and about 2),
so that a busy moment does not change the choice."""


@cache
def faster_type(device: torch.device) -> torch.dtype:
    """bfloat16 or float32, whichever the device computes faster; measured once per process."""
    if device.type != "cpu":
        has_bfloat16 = torch.cuda.is_bf16_supported(including_emulation=False)
        return torch.bfloat16 if has_bfloat16 else torch.float32
    gain = convolution_s(torch.float32) / convolution_s(torch.bfloat16)
    return torch.bfloat16 if gain > LEAST_GAIN else torch.float32


@torch.inference_mode()
def convolution_s(dtype: torch.dtype) -> float:
    """CPU seconds of a 3x3 convolution of that type, the best of some."""
    image = torch.ones(1, CHANNELS, ROWS, COLUMNS, dtype=dtype)
    image = image.to(memory_format=torch.channels_last)
    weight = torch.ones(CHANNELS, CHANNELS, 3, 3, dtype=dtype)
    weight = weight.to(memory_format=torch.channels_last)
    taken_s = []
    for _ in range(1 + REPEATS):  # the first one compiles
        started_s = time.process_time()
        F.conv2d(image, weight, padding=1)
        taken_s.append(time.process_time() - started_s)
    return min(taken_s[1:])


def precision_of(painter: Painter) -> str | None:
    """What records call the type that a learned painter computes in; None for a rule."""
    dtype = getattr(painter, "precision", None)
    return None if dtype is None else type_name(dtype)


def type_name(dtype: torch.dtype) -> str:
    """What records and tables call a type: `bfloat16`."""
    return str(dtype).removeprefix("torch.")
