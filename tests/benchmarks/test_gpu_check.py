"""The check of a GPU: its page, and that its parts run on a device that is not the CPU."""

import subprocess
import sys
from pathlib import Path

import gpu_costs
import kernel_trials
import pytest
import torch
from gpu_agreement import compare_kernels
from gpu_findings import Agreement, Findings
from splat_drawing import TRITON, home_of
from strict_device import strict_runs

from lidarpainter_models.kernels.backends import available_backends

CPU = torch.device("cpu")


def findings_of(*agreements, is_gpu=True):
    facts = {"device": "cuda, a card", "date": "today"}
    return Findings(machine=facts, is_gpu=is_gpu, agreements=list(agreements))


def agreement(error):
    return Agreement(what="ssim", compared="GPU, numba", error=error, allowed=1e-4)


def test_what_fails_is_named_and_the_rest_goes_on():
    findings = findings_of(agreement(0.0))
    with findings.part("a fit"):
        raise RuntimeError("out of memory\nwith a long tail")
    assert findings.failed == ["a fit: RuntimeError: out of memory"]
    assert findings.first_line == (
        "GPU check on cuda, a card: 1 of 1 parts agree, 1 failed, 0 not checked"
    )
    assert "- a fit: RuntimeError: out of memory" in findings.page()


def test_without_a_gpu_the_first_line_says_so():
    assert findings_of(is_gpu=False).page().startswith("No GPU was found. On the CPU instead")


def trials(names):
    """Kernels whose trials run in seconds; those that take longer in the nightly tests."""
    long = ("sparse_adam", "ssim")
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in long)) for name in names]


@pytest.mark.parametrize("kernel", trials(kernel_trials.TRIALS))
def test_a_trial_runs_on_another_device_and_gives_what_the_cpu_gives(kernel, monkeypatch):
    trial = kernel_trials.TRIALS[kernel]
    with strict_runs(monkeypatch) as device:
        found = [each.detach().cpu() for each in trial.run("reference", device)]
    assert kernel_trials.disagreement(found, trial.run("cpu", CPU)) <= trial.tolerance


@pytest.mark.parametrize("backend", [TRITON])
@pytest.mark.parametrize(
    "kernel", trials(name for name in kernel_trials.TRIALS if "triton" in available_backends(name))
)
def test_a_trial_by_triton_gives_what_the_cpu_gives(kernel, backend):
    trial = kernel_trials.TRIALS[kernel]
    found = trial.run(backend, home_of(backend))
    assert kernel_trials.disagreement(found, trial.run("cpu", CPU)) <= trial.tolerance


def test_another_answer_is_a_disagreement():
    trial = kernel_trials.TRIALS["ssim"]
    found = trial.run("cpu", CPU)
    assert kernel_trials.disagreement([*found[:-1], found[-1].flip(0)], found) > 0.1
    chosen = torch.tensor([1, 2, 3, 4])
    assert kernel_trials.disagreement([chosen], [torch.tensor([1, 2, 3, 5])]) == 0.25


def test_the_cpu_agrees_with_itself_part_by_part(monkeypatch):
    kept = {name: kernel_trials.TRIALS[name] for name in ("ssim", "point_splat")}
    monkeypatch.setattr(kernel_trials, "TRIALS", kept)
    findings = findings_of()
    compare_kernels(findings, CPU)
    assert findings.is_fit
    assert {found.what for found in findings.agreements} >= set(kept)
    assert any(line.startswith("gaussian_raster by cuda") for line in findings.unchecked)


@pytest.mark.slow
def test_stages_and_painters_are_rehearsed_on_another_device(monkeypatch):
    findings = findings_of()
    with strict_runs(monkeypatch) as device:
        gpu_costs.measure_stages(findings, device)
    gpu_costs.measure_painters(findings, CPU, None)
    assert findings.failed == []
    assert len(findings.costs) == 3
    assert [cost.what.split()[0] for cost in findings.painters] == ["nano,", "a", "paper", "fast"]


@pytest.mark.slow
def test_the_check_runs_to_its_end_and_writes_its_page(tmp_path):
    script = Path(gpu_costs.__file__).with_name("gpu_check.py")
    page = tmp_path / "gpu-check.md"
    result = subprocess.run(
        [sys.executable, script, "--out", page], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert page.read_text("utf-8") == result.stdout
    assert "Failed:\n\n- nothing" in result.stdout
