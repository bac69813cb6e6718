"""The public names, and the example that the README gives of them."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import cv2

import lidarpainter_models as lp
from catalog.code_closure import SourceTree
from lidarpainter_models import api
from lidarpainter_models.metrics.images import psnr_from_error
from lidarpainter_models.synthetic import SyntheticStreet

ROOT = Path(__file__).resolve().parents[1]
MOST_MS = 50.0
CLOCK = """
import sys, time
begun = time.perf_counter()
import lidarpainter_models as lp
print(1000 * (time.perf_counter() - begun), lp.__version__, "torch" in sys.modules)
"""


def test_every_public_name_is_found_and_typed():
    stub = ast.parse((ROOT / "lidarpainter_models" / "__init__.pyi").read_text("utf-8"))
    typed = [
        alias.asname
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    assert typed == lp.__all__ == api.__all__
    assert all(getattr(lp, name) is getattr(api, name) for name in lp.__all__)


def test_import_is_quick_and_loads_nothing():
    told = [
        subprocess.run(
            [sys.executable, "-c", CLOCK], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(3)
    ]
    assert min(float(milliseconds) for milliseconds, _version, _torch in told) < MOST_MS
    assert {(version, torch) for _ms, version, torch in told} == {(lp.__version__, "False")}


def test_no_stage_reaches_the_public_names():
    """Else an edit to any room would make every result stale."""
    source = SourceTree.of_packages("flows", "tasks", "lidarpainter_models")
    reached = source.code_from(["flows.reconstruct:reconstruct"]).modules
    assert "lidarpainter_models.gaussians.fitting.fit" in reached
    assert "lidarpainter_models.api" not in reached


def test_example_of_the_readme_ends_with_an_image(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.S)
    assert len(example.splitlines()) < 30
    names = {}
    exec(compile(example, "README.md", "exec"), names)  # noqa: S102 - our own page
    assert "psnr" in capsys.readouterr().out
    image = cv2.imread(str(tmp_path / "lidarpainter-example" / "aside.png"))
    assert image.shape == (180, 640, 3)
    aside, time_ns = names["aside"], names["view"].timestamp_ns
    truth = SyntheticStreet(street_of(names["scene"].manifest)).render(aside, time_ns).rgb
    render_db, painted_db = (
        psnr_from_error(float((names[name].rgb - truth).square().mean()))
        for name in ("render", "painted")
    )
    assert painted_db > render_db + 0.3


def street_of(manifest):
    return lp.SyntheticStreetConfig.from_dict(manifest["generator"]["config"])
