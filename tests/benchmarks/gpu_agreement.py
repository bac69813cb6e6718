"""Do kernels and a short fit on the GPU give what they give on the CPU?

Where there is no GPU, its way is gone on the CPU: plain torch against numba, and Triton's kernels
in their interpreter.
"""

import pkgutil

import kernel_trials
import torch
from gaussian_world import build_world
from gpu_findings import Agreement, Findings

from lidarpainter_models import kernels
from lidarpainter_models.gaussians.fitting.config import DensificationConfig, FitConfig
from lidarpainter_models.gaussians.fitting.fit import fit_gaussians
from lidarpainter_models.gaussians.initialisation.settings import InitialisationConfig
from lidarpainter_models.kernels.backends import (
    Backend,
    available_backends,
    kernels_chosen,
    why_missing,
)

CPU = torch.device("cpu")
RASTERISERS: tuple[Backend, ...] = ("cuda", "triton")
MOST_PSNR_DB = 0.3
"""Between two short fits: roundings split other Gaussians."""
FIT = FitConfig(
    steps=30,
    log_every=30,
    initialisation=InitialisationConfig(num_gaussians=700, street_voxel_m=0.2),
    densification=DensificationConfig(budget=900, start=0.2, stop=0.8, every=10),
)


def compare_kernels(findings: Findings, device: torch.device) -> None:
    """Every kernel by its door."""
    backend: Backend = "auto" if device.type == "cuda" else "reference"
    compared = "GPU, numba" if device.type == "cuda" else "torch, numba"
    for kernel, trial in kernel_trials.TRIALS.items():
        with findings.part(kernel):
            error = kernel_trials.disagreement(trial.run(backend, device), trial.run("cpu", CPU))
            findings.agreements.append(
                Agreement(what=kernel, compared=compared, error=error, allowed=trial.tolerance)
            )
    findings.unchecked.append(
        "colour_sampling but for the projection, point_contrasts: done by the CPU"
    )
    findings.unchecked += [f"{kernel}: it has no trial yet" for kernel in kernels_without_trial()]
    for name in RASTERISERS:
        compare_rasteriser(findings, name, device)


def kernels_without_trial() -> list[str]:
    """Kernels that nobody has written a trial for."""
    tried = {*kernel_trials.TRIALS, "gaussian_raster", "point_contrasts"}
    packages = {module.name for module in pkgutil.iter_modules(kernels.__path__) if module.ispkg}
    return sorted(name for name in packages - tried if "reference" in available_backends(name))


def compare_rasteriser(findings: Findings, backend: Backend, device: torch.device) -> None:
    """Images and gradients of one of the rasterisers for a GPU."""
    reason = why_missing("gaussian_raster", backend)
    if reason is not None:
        findings.unchecked.append(f"gaussian_raster by {backend}: {reason}")
        return
    size = kernel_trials.GAUSSIANS if device.type == "cuda" else kernel_trials.INTERPRETED
    with findings.part(f"gaussian_raster by {backend}"):
        error = kernel_trials.disagreement(
            kernel_trials.raster(size, backend, device), kernel_trials.raster(size, "cpu", CPU)
        )
        compared = f"{backend}{'' if device.type == 'cuda' else ' interpreted'}, numba"
        allowed = kernel_trials.RASTER_TOLERANCE[backend]
        findings.agreements.append(
            Agreement(what="gaussian_raster", compared=compared, error=error, allowed=allowed)
        )


def compare_fits(findings: Findings, device: torch.device) -> None:
    """The PSNR that a short fit reaches on a tiny world, and that of the same on the CPU."""
    with findings.part("a short fit"):
        world = build_world()
        plain = fit_gaussians(world.observations, FIT).history[-1]["psnr"]
        with kernels_chosen("torch" if device.type == "cpu" else "auto"):
            found = fit_gaussians(world.observations, FIT, device=device).history[-1]["psnr"]
        findings.agreements.append(
            Agreement(
                what=f"a fit of {FIT.steps} steps, {plain:.2f} dB",
                compared="GPU, numba, in dB" if device.type == "cuda" else "torch, numba, in dB",
                error=abs(found - plain),
                allowed=MOST_PSNR_DB,
            )
        )
