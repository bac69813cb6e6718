"""What the doctor says of a GPU: there, missing, or there and of no use."""

from types import SimpleNamespace

import pytest

from lidarpainter_models.kernels import backends
from tasks import health


def gpu(monkeypatch, tmp_path, *, driver=None, build=None, works=False):
    """Findings by name on a machine with this driver, this build of torch, and a card or none."""
    told = tmp_path / "version"
    if driver is not None:
        told.write_text(f"{driver}\nGCC\n")
    monkeypatch.setattr(health, "_DRIVER", told)
    monkeypatch.setattr(health.shutil, "which", lambda _name: None)
    torch = SimpleNamespace(
        __version__="2.13.0",
        version=SimpleNamespace(cuda=build),
        cuda=SimpleNamespace(is_available=lambda: works, get_device_name=lambda: "a card"),
    )
    monkeypatch.setattr(health, "import_module", {"torch": torch}.__getitem__)
    return {finding.name: finding for finding in health.gpu_findings()}


def test_a_machine_without_a_gpu_is_fit(monkeypatch, tmp_path):
    found = gpu(monkeypatch, tmp_path)
    assert {finding.verdict for finding in found.values()} == {"ok"}
    assert "the CPU does the work" in found["gpu driver"].detail
    assert "rasteriser" not in found


def test_a_gpu_without_torch_for_cuda_is_told_what_to_install(monkeypatch, tmp_path):
    found = gpu(monkeypatch, tmp_path, driver="NVRM version: 580")
    assert found["gpu driver"].detail == "NVRM version: 580"
    assert found["torch build"].verdict == "warn"
    assert "needs torch's build for CUDA" in found["torch build"].detail


def test_a_driver_that_torch_cannot_use_is_warned_of(monkeypatch, tmp_path):
    found = gpu(monkeypatch, tmp_path, driver="NVRM version: 400", build="13.0")
    assert found["device"].verdict == "warn"


@pytest.mark.parametrize(
    ("missing", "verdict", "detail"),
    [({}, "ok", "triton on the GPU"), ({"triton": "no gcc"}, "warn", "not triton: no gcc")],
)
def test_the_rasteriser_of_a_gpu_is_named(monkeypatch, tmp_path, missing, verdict, detail):
    monkeypatch.setattr(backends, "why_missing", lambda _kernel, backend: missing.get(backend))
    found = gpu(monkeypatch, tmp_path, driver="NVRM version: 580", build="13.0", works=True)
    assert found["rasteriser"].verdict == verdict
    assert detail in found["rasteriser"].detail
