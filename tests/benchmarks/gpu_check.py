"""Check this machine's GPU in five minutes: does it agree with the CPU, and what does it take?

    make gpu-check
    python tests/benchmarks/gpu_check.py [--out FILE] [--model FOLDER|sd-turbo]

Prints one line of what was checked where, then a block in Markdown for docs/benchmarks.md: machine,
agreement of every kernel and of a short fit with the CPU, costs of each stage and painter, what
failed and what was not checked. The exit code is 1 if something failed or differs. Without a GPU
the same code runs in small on the CPU, and the first line says so.
"""

import argparse
import os
import sys
import time
from pathlib import Path

for _folder in ("support", "benchmarks"):
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / _folder))


def check(model: str | None, out: Path | None):
    """Everything; takes minutes on a GPU. What is found is written part by part."""
    import torch

    has_gpu = torch.cuda.is_available()
    if not has_gpu:
        os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is first imported
    from gpu_agreement import compare_fits, compare_kernels
    from gpu_costs import measure_painters, measure_rasterisers, measure_stages
    from gpu_findings import Findings

    from lidarpainter_models.devices import chosen_device
    from tasks.health import gpu_findings
    from tasks.machine import machine

    device = chosen_device("auto")
    facts = {found.name: found.detail for found in gpu_findings()} | machine(device)
    findings = Findings(machine=facts, is_gpu=has_gpu)
    started = time.perf_counter()
    for part in (
        compare_kernels,
        compare_fits,
        measure_rasterisers,
        measure_stages,
        lambda found, where: measure_painters(found, where, model),
    ):
        part(findings, device)
        findings.machine["took"] = f"{time.perf_counter() - started:.0f} s"
        _write(findings, out)
    if not has_gpu:
        findings.unchecked.append("every figure of a GPU: none is here")
    return findings


def _write(findings, out: Path | None) -> None:
    if out is not None:
        out.write_text(findings.page(), "utf-8")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="where the page goes as well")
    parser.add_argument("--model", help="a model in diffusers' layout; random weights without it")
    options = parser.parse_args()
    findings = check(options.model, options.out)
    sys.stdout.write(findings.page())
    _write(findings, options.out)
    return 0 if findings.is_fit else 1


if __name__ == "__main__":
    sys.exit(main())
