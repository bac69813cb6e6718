"""Which implementation `auto` stands for, on a machine that is said to have a GPU."""

import pytest
import torch

from lidarpainter_models.errors import BackendError, ConfigError
from lidarpainter_models.kernels import backends
from lidarpainter_models.kernels.backends import check_choice, implementation, kernels_chosen

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.fixture
def machine(monkeypatch):
    """A GPU whose Triton and gsplat can run, or cannot for a reason."""

    def has(*, triton=None, gsplat=None):
        monkeypatch.setattr(backends, "why_no_triton", lambda: triton)
        monkeypatch.setattr(backends, "why_no_gsplat", lambda: gsplat)

    return has


def taken(kernel, device, function="draw_view"):
    return implementation(kernel, function, "auto", device).__module__.rsplit(".")[-1]


def test_a_gpu_draws_with_our_own_kernels_unless_gsplat_is_asked_for(machine):
    machine()
    assert taken("gaussian_raster", GPU) == "triton"
    with kernels_chosen("gsplat"):
        assert taken("gaussian_raster", GPU) == "cuda"
        assert taken("point_splat", GPU, "splat_points") == "triton"
    assert taken("gaussian_raster", GPU) == "triton"


def test_plain_torch_is_taken_for_all_but_the_rasteriser(machine):
    machine()
    with kernels_chosen("torch"):
        assert taken("point_splat", CPU, "splat_points") == "reference"
        assert taken("gaussian_raster", CPU) == "cpu"


@pytest.mark.parametrize("device", [CPU, GPU])
def test_gsplat_that_is_missing_is_told_in_one_line(machine, device):
    machine(gsplat="gsplat is not installed")
    message = "kernels=gsplat: gsplat cannot draw here: gsplat is not installed"
    with kernels_chosen("gsplat"), pytest.raises(BackendError, match=f"^{message}$"):
        taken("gaussian_raster", device)


def test_a_run_that_asks_for_a_missing_gsplat_is_refused_before_its_first_stage(machine):
    machine(gsplat="no CUDA device")
    with pytest.raises(ConfigError, match=r"^kernels=gsplat: no CUDA device; expected auto"):
        check_choice("gsplat")
    check_choice("torch")


def test_a_gpu_without_triton_is_not_left_to_the_plain_reference(machine):
    machine(triton="no C compiler")
    with pytest.raises(BackendError, match=r"no C compiler.*--set kernels=gsplat"):
        taken("gaussian_raster", GPU)
    assert taken("point_splat", GPU, "splat_points") == "reference"
