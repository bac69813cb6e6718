"""The code of every stage is found from the source, and is that of no other concern."""

import ast
from pathlib import Path

import pytest

import tasks
from tasks.stages import project_source

LIBRARY = "lidarpainter_models"
FOLDER = Path(tasks.__file__).parent


def builds_of(path):
    """Where the builds given to `run_stage` in a module start, `module:name`."""
    module = ".".join(path.relative_to(FOLDER.parent).with_suffix("").parts)
    top = {node.name: node for node in ast.parse(path.read_text()).body if hasattr(node, "name")}
    for name, function in top.items():
        for call in ast.walk(function):
            if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "run_stage":
                (build,) = (word.value for word in call.keywords if word.arg == "build")
                given = {node.id for node in ast.walk(build) if isinstance(node, ast.Name)}
                yield from (f"{module}:{one}" for one in sorted(given & top.keys()) or [name])


BUILDS = sorted({start for path in FOLDER.rglob("*.py") for start in builds_of(path)})


def modules_of(*starts):
    return project_source().code_from(starts).modules


def builds_in(module):
    found = [start for start in BUILDS if start.startswith(f"tasks.{module}:")]
    assert found, f"no build in tasks.{module}"
    return found


def holds(modules, *packages):
    return sorted(name for name in modules if f"{name}.".startswith(packages))


@pytest.mark.parametrize("start", BUILDS)
def test_every_build_is_followed_into_the_library(start):
    assert holds(modules_of(start), f"{LIBRARY}.") != []


def test_there_are_the_stages_of_a_run_and_of_a_training():
    modules = {start.partition(":")[0] for start in BUILDS}
    assert len(modules) >= 9


def test_a_fit_follows_the_rasteriser_and_nothing_that_comes_after_it():
    modules = modules_of(*builds_in("reconstruction.fit"))
    assert {
        f"{LIBRARY}.kernels.gaussian_raster.cpu",
        f"{LIBRARY}.kernels.gaussian_raster.reference",
        f"{LIBRARY}.kernels.sparse_adam.cpu",
        f"{LIBRARY}.kernels.ssim.cpu",
    } <= modules.keys()
    others = ("readers", "painter", "metrics", "evaluation", "conditioning", "export", "synthetic")
    assert holds(modules, *(f"{LIBRARY}.{other}." for other in others)) == []


def test_preparing_follows_the_colouring_and_no_reader_and_no_fit():
    modules = modules_of(*builds_in("reconstruction.prepare"))
    assert {f"{LIBRARY}.lidar.colouring", f"{LIBRARY}.kernels.point_splat.cpu"} <= modules.keys()
    others = ("readers", "painter", "metrics", "evaluation", "gaussians", "synthetic")
    assert holds(modules, *(f"{LIBRARY}.{other}." for other in others)) == []


def test_evaluation_follows_the_scores_and_no_reader():
    modules = modules_of(*builds_in("evaluation.scene"))
    assert {
        "tasks.evaluation.judging",
        f"{LIBRARY}.evaluation.scene_scores",
        f"{LIBRARY}.metrics.images",
        f"{LIBRARY}.kernels.point_blend.cpu",
    } <= modules.keys()
    assert holds(modules, f"{LIBRARY}.readers.", f"{LIBRARY}.gaussians.fitting.") == []


def test_training_follows_what_its_students_are_made_of():
    modules = modules_of(*builds_in("painter.train"))
    assert {
        "tasks.painter.students",
        "tasks.painter.training_processes",
        f"{LIBRARY}.painter.nano.training",
        f"{LIBRARY}.painter.one_step.training",
        f"{LIBRARY}.evaluation.held_back",
    } <= modules.keys()
