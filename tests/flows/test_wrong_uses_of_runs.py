"""Commands about a run, used wrongly: one line that says what was expected, and nothing is left."""

import shlex

import pytest
from commands import complaint, refuse
from tiny_street import SCENE

RENDER = "render {run} --trajectory recorded --out x"
EXPORT = "export {run} --format"
EDIT = "edit {run}"
AHEAD = "nearest-ahead"
SILENT = (EDIT, EXPORT + " page")
"""These say nothing else on stderr either."""


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (RENDER + " --camera roof", "no camera 'roof'"),
        (RENDER + " --frames 70:80", "no frame of front_camera is left to render"),
        (RENDER + " --painter miro", "no painter 'miro'"),
        ("stylize {run} --prompt rain --images drawn --out x", "drawn"),
        ("evaluate {run} --lpips-heads gone.pth", "gone.pth"),
        ("evaluate {run} --protocol neurad", "--split linspace, this one was with --split alter"),
        # sweeps
        (RENDER + " --lidar sonar", "sensor 'sonar': expected hdl-32e"),
        (RENDER + " --lidar gone.json", "gone.json: cannot be read as a sensor"),
        (RENDER + " --lidar log --lidar-format las", "'las': expected pcd"),
        (RENDER + " --lidar log --video", "--video"),
        (RENDER + " --lidar-format npz", "--lidar-format needs --lidar"),
        ("evaluate {run} --protocol lidar --postpaint", "--postpaint"),
        ("evaluate {run} --protocol lidar --all-views", "--all-views"),
        (f"lidar-model {SCENE} --lidar roof", "LiDAR 'roof' is needed"),
        # what is exported
        (EXPORT + " obj --out a", "--format 'obj': expected one of ply, spz"),
        (EXPORT + " ply --out a.ply --time soon", "--time 'soon': expected seconds"),
        (EXPORT + " ply --out a.ply --actors x", "has no actor 'x', it has"),
        (EXPORT + " video --out a.mp4 --sky", "--format video has no use for --sky"),
        (EXPORT + " ply --out a.ply --camera all", "--format ply has no use for --camera"),
        (EXPORT + " gltf --out a.glb --per-actor", "--format gltf has no use for --per-actor"),
        (EXPORT + " depth --out a --postpaint", "--format depth has no use for --postpaint"),
        (EXPORT + " spz --out a.spz --spz-version 2", "expected 3 or 4"),
        (EXPORT + " depth --out a --camera roof", "has no camera 'roof'"),
        (EXPORT + " depth --out a --width 9999", "expected at most"),
        (EXPORT + " video --out a.mp4 --fps 0", "--fps 0: expected above 0"),
        (EXPORT + " video --out a.mp4 --beside ffff", "'ffff'"),
        (EXPORT + " colmap --out a --postpaint", "taken as they are"),
        (EXPORT + " ply --out /proc/no/a.ply", "cannot be written"),
        (EXPORT + " simulator --out a.zip", "expected a name in .usdz"),
        ("check-bundle none.usdz", "is not there"),
        (EXPORT + " page --out a.html --postpaint", "a browser shows the scene itself"),
        (EXPORT + " page --out a.html --trajectory lateral:90", "lateral:90"),
        (EXPORT + " page --out a.html --camera rear", "rear"),
        # edits
        (EDIT + " remove bus", "no actor 'bus', expected an id"),
        (f"{EDIT} move {AHEAD} trajectory=latral:2", "trajectory 'latral:2': expected one of"),
        (f"{EDIT} move {AHEAD}", "trajectory: Field required"),
        (EDIT + " move trajectory=lateral:2", "move takes one name, got none"),
        (f"{EDIT} stop {AHEAD} at_s=soon", "at_s=soon: expected a number"),
        (f"{EDIT} stop {AHEAD} at_s=nan", "finite number"),
        (f"{EDIT} lamps {AHEAD} state=blue", "state: Input should be 'off', 'on' or 'brake'"),
        (f"{EDIT} lamps {AHEAD} state=off", "lamps are seen at night alone: expected a style"),
        (f"{EDIT} fly {AHEAD}", "does not match any of the expected"),
        (EDIT + " insert new source.ply=nowhere.ply", "no file nowhere.ply"),
        (EDIT + " insert new source.run=nobody source.actor=a", "no run_id 'nobody'"),
        (EDIT + " join nobody", "no run_id 'nobody'"),
        (EDIT + " style prompt=snow", "no style 'snow', expected clear, foggy"),
        (EDIT + " style prompt=foggy strength=2", "strength: Input should be less than"),
        (EDIT + " style prompt=foggy seed=0.5", "seed=0.5: expected a whole number"),
        (f"{EDIT} style {AHEAD} prompt=foggy", "style takes no name, got nearest-ahead"),
        (EDIT + " drive trajectory=latral:2", "trajectory 'latral:2': expected one of"),
        (EDIT + " join", "join takes one name, got none"),
        (EDIT + " join {run}", "that run has seen nothing much better than this one"),
        (EDIT, "expected at least one operation"),
        (EDIT + " --script nowhere.json", "script nowhere.json cannot be read"),
        # what is served
        ("serve {run} --memory much", "--memory"),
        ("serve {run} --time-limit soon", "--time-limit"),
        ("serve {run} --device tpu", "tpu"),
        ("serve {run} --refuse-below 0.5 --no-trust", "--refuse-below"),
        ("serve {run} --painter nobody", "nobody"),
        # its scene, and its past
        (f"view {SCENE} --label --camera front", "--label has no use for --camera"),
        (f"view {SCENE} --edits a.json", "view of a run has no use for --edits"),
        (f"label {SCENE} --edits missing.json", "missing.json is no file of edits"),
        (f"label {SCENE} --edits a.json --complete", "--edits has no use for --complete"),
        ("catalog list runs --as-of yesterday", "expected a version such as 3, or a time"),
        ("catalog list runs --as-of 99", "no runs as of 99, the last version is"),
        ("catalog cost toy/none", "no run and no attempt"),
    ],
)
def test_what_cannot_be_done_with_a_run_is_one_line_and_leaves_nothing(
    tiny_run, tmp_path, monkeypatch, words, expected
):
    monkeypatch.chdir(tmp_path)
    before = tiny_run.store.tables.rows("runs")
    written = [word.format(run=tiny_run.run_id) for word in shlex.split(words)]
    answered = complaint if words.startswith(SILENT) else refuse
    assert expected in answered(*written, store=tiny_run.store)
    assert list(tmp_path.iterdir()) == []
    assert tiny_run.store.tables.rows("runs") == before
