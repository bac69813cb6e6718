"""The code of every stage is found from the source, and is that of no other concern."""

import ast
import shutil
from pathlib import Path

import pytest

import tasks
from catalog.code_closure import SourceTree
from tasks.stages import project_source

LIBRARY = "lidarpainter_models"
FOLDER = Path(tasks.__file__).parent


def builds_of(path):
    """Where the builds of the stages in a module start, `module:name`."""
    module = ".".join(path.relative_to(FOLDER.parent).with_suffix("").parts)
    used = {node.id for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Name)}
    if "run_stage" in used:
        yield from (f"{module}:{name}" for name in used if name.startswith("_build"))


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
    modules = modules_of("tasks.reconstruction.fit:_build")
    assert {
        f"{LIBRARY}.kernels.gaussian_raster.cpu",
        f"{LIBRARY}.kernels.gaussian_raster.reference",
        f"{LIBRARY}.kernels.sparse_adam.cpu",
        f"{LIBRARY}.kernels.ssim.cpu",
    } <= modules.keys()
    others = ("readers", "painter", "metrics", "evaluation", "conditioning", "export", "synthetic")
    assert holds(modules, *(f"{LIBRARY}.{other}." for other in others)) == []


def test_a_painted_round_follows_what_takes_it_back_and_no_painter():
    modules = modules_of("tasks.reconstruction.fit:_build_round")
    after = {f"{LIBRARY}.evaluation.round_gain", f"{LIBRARY}.gaussians.fitting.fit"}
    assert after <= modules.keys()
    assert holds(modules, f"{LIBRARY}.readers.", f"{LIBRARY}.painter.nano.") == []


def test_preparing_follows_the_colouring_and_no_reader_and_no_fit():
    modules = modules_of(*builds_in("reconstruction.prepare"))
    assert {f"{LIBRARY}.lidar.colouring", f"{LIBRARY}.kernels.point_splat.cpu"} <= modules.keys()
    others = ("readers", "painter", "metrics", "evaluation", "gaussians", "synthetic")
    assert holds(modules, *(f"{LIBRARY}.{other}." for other in others)) == []


def test_evaluation_follows_the_scores_and_no_reader():
    modules = modules_of(*builds_in("evaluation.views"))
    assert {
        f"{LIBRARY}.evaluation.scene_evaluation",
        f"{LIBRARY}.metrics.images",
        f"{LIBRARY}.kernels.point_blend.cpu",
    } <= modules.keys()
    assert holds(modules, f"{LIBRARY}.readers.", f"{LIBRARY}.gaussians.fitting.") == []


def test_training_follows_what_its_students_are_made_of():
    modules = modules_of(*builds_in("painter.train"))
    assert {
        f"{LIBRARY}.evaluation.painter_training",
        f"{LIBRARY}.painter.training_jobs",
        f"{LIBRARY}.painter.nano.training",
        f"{LIBRARY}.painter.one_step.training",
        f"{LIBRARY}.evaluation.held_back",
    } <= modules.keys()


@pytest.fixture
def copied(tmp_path):
    """A copy of the project, to be changed."""
    roots = {name: tmp_path / name for name in ("flows", "tasks", LIBRARY)}
    for name, folder in roots.items():
        shutil.copytree(FOLDER.parent / name, folder)
    return roots


def digests_of(roots):
    tree = SourceTree(roots)
    return {start: tree.code_from([start]).digest for start in BUILDS}


def changed_by(roots, module, old, new):
    """The task modules whose builds run what was changed."""
    before = digests_of(roots)
    root, *parts = module.split(".")
    path = roots[root].joinpath(*parts).with_suffix(".py")
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    after = digests_of(roots)
    return {start.partition(":")[0] for start in BUILDS if before[start] != after[start]}


def test_a_comment_in_every_file_changes_no_stage(copied):
    before = digests_of(copied)
    for folder in copied.values():
        for path in folder.rglob("*.py"):
            path.write_text(f"{path.read_text()}\n# one comment\n")
    assert digests_of(copied) == before


def test_scoring_code_changes_what_scores_and_nothing_else(copied):
    module = f"{LIBRARY}.evaluation.scene_evaluation"
    changed = changed_by(copied, module, "sum(weights)", "sum(weights[:])")
    assert changed == {"tasks.evaluation.views"}


def test_the_rasteriser_changes_the_fit_and_all_after_it_but_not_what_it_is_fitted_to(copied):
    module = f"{LIBRARY}.kernels.gaussian_raster.cpu"
    changed = changed_by(copied, module, "return ", "return None or ")
    after = {"fit", "paint", "report"}
    assert changed >= {"tasks.evaluation.views", *(f"tasks.reconstruction.{one}" for one in after)}
    assert "tasks.reconstruction.prepare" not in changed


def test_a_reader_changes_nothing_of_a_stored_scene(copied):
    module = f"{LIBRARY}.readers.waymo.tfrecord"
    assert changed_by(copied, module, "return ", "return None or ") == set()
