"""Which device does the work."""

from typing import TYPE_CHECKING, Literal, get_args

from lidarpainter_models.errors import ConfigError

if TYPE_CHECKING:
    import torch

Device = Literal["auto", "cpu", "cuda"]


def chosen_device(name: Device) -> "torch.device":
    """The device by name; `auto` takes the GPU if there is one.

    Raises:
        ConfigError: no such device, or none that works here.
    """
    if name not in get_args(Device):
        raise ConfigError(f"no device {name!r}, expected {', '.join(get_args(Device))}")
    import torch  # whoever only names a device does without

    has_gpu = torch.cuda.is_available()
    if name == "cuda" and not has_gpu:
        raise ConfigError("device cuda: no CUDA device works here, expected cpu or auto")
    return torch.device("cuda" if has_gpu and name != "cpu" else "cpu")
