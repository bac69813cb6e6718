"""What `--set` knows is listed whole, with the reason that stands in the source."""

import json
import subprocess
import sys

import pytest
from commands import refuse, succeed

from flows.overrides import known_settings, with_overrides
from flows.presets import PRESETS, preset


@pytest.mark.parametrize("name", PRESETS)
def test_every_setting_has_a_type_and_a_reason_and_can_be_set_to_its_default(name):
    parameters = preset(name, "a/b")
    found = known_settings(parameters)
    assert len(found) > 100
    assert [one.path for one in found if not one.reason or not one.type] == []
    simple = [one for one in found if isinstance(one.default, int | float | str)]
    assert len(simple) > 70
    assignments = [f"{one.path}={json.dumps(one.default)}" for one in simple]
    assert with_overrides(parameters, assignments) == parameters


def test_a_setting_says_what_its_class_says():
    (budget,) = known_settings(preset("balanced", "a/b"), "fit.densification.budget")
    assert (budget.type, budget.default) == ("int", 0)
    assert budget.reason.startswith("The most Gaussians of a fit")
    (device,) = known_settings(preset("preview", "a/b"), "device")
    assert device.type == "str"


def test_the_command_lists_a_part_or_all():
    shown = succeed("settings", "fit.densification").out
    assert "fit.densification.budget" in shown
    assert "fit.steps" not in shown
    listed = succeed("settings", "--preset", "paper", "--json").json["settings"]
    assert {"path": "fit.effort.looks", "type": "float", "default": 3500.0} in [
        {key: one[key] for key in ("path", "type", "default")} for one in listed
    ]
    trained = succeed("settings", "training", "--of", "train", "--json").json["settings"]
    assert "training.batch_size" in [one["path"] for one in trained]


def test_a_setting_that_is_none_is_refused():
    assert "no setting 'fits', expected one of scene, preset, split" in refuse("settings", "fits")


def test_listing_imports_nothing_heavy():
    code = (
        "import sys; from flows.cli.main import main; main(['settings']); "
        "print({'torch', 'prefect', 'numba', 'cv2', 'pyarrow'} & set(sys.modules) or 'light')"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert answer.stdout.splitlines()[-1] == "light"
