"""Bundles of anybody: what is lacking is said, and what is made to do harm is refused."""

import json
import struct
import zipfile

import numpy as np
import pytest
import yaml

from lidarpainter_models.errors import DataError
from lidarpainter_models.export import bundle_checks
from lidarpainter_models.export.bundle_checks import check_bundle
from lidarpainter_models.export.bundle_reading import opened_bundle
from lidarpainter_models.export.meshes import mesh_of_ply, obstacle_mesh, ply_bytes
from lidarpainter_models.export.simulator_bundle import ALIGNED_BYTES, write_usdz

LAYER = b"""#usda 1.0
def ParticleField3DGaussianSplat "Street" {
}
"""
MAP = b"""<OpenDRIVE><road><lanes><lane type="driving"/></lanes></road></OpenDRIVE>"""


def square(half_m=12.0, hole_m=0.0):
    """A ground mesh at z = 0, perhaps with a hole in the middle."""
    step = np.arange(-half_m, half_m + 0.01, 0.25)
    x, y = np.meshgrid(step, step, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    numbers = np.arange(x.size).reshape(x.shape)
    corners = [numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:]]
    a, b, c, d = (one.ravel() for one in corners)
    middles = vertices[a, :2] + 0.125
    kept = np.abs(middles).max(axis=1) > hole_m / 2
    return vertices, np.concatenate([np.stack([a, b, c], 1)[kept], np.stack([a, c, d], 1)[kept]])


def members(**changed):
    """The members of a bundle that lacks nothing."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = [0.0, 1.0, 2.0], 0.3
    rig = {
        "world_to_nre": {"matrix": np.eye(4).tolist()},
        "T_world_base": np.eye(4).tolist(),
        "camera_calibrations": {
            "c@1": {"logical_sensor_name": "c", "T_sensor_rig": np.eye(4).tolist()}
        },
        "rig_trajectories": [
            {
                "sequence_id": "s",
                "T_rig_world_timestamps_us": [0, 100, 200],
                "T_rig_worlds": poses.tolist(),
                "cameras_frame_timestamps_us": {"c@1": [[0, 50], [100, 150]]},
                "rig_bbox": {"centroid": [0, 0, 0], "dim": [4, 2, 1], "rot": [0, 0, 0]},
            }
        ],
    }
    tracks = {
        "tracks_id": ["a"],
        "tracks_label_class": ["car"],
        "tracks_flags": ["CONTROLLABLE"],
        "tracks_timestamps_us": [[0, 100]],
        "tracks_poses": [[[5, 0, 1, 0, 0, 0, 1], [6, 0, 1, 0, 0, 0, 1]]],
    }
    metadata = {
        "scene_id": "s",
        "version_string": "1",
        "training_date": "2026-11-29",
        "dataset_hash": "0",
        "uuid": "12345678-1234-5678-1234-567812345678",
        "is_resumable": False,
        "sensors": {"camera_ids": ["c"], "lidar_ids": []},
        "logger": {"name": "n", "run_id": "r", "run_url": None},
        "time_range": {"start": 0.0, "end": 0.0002},
        "training_step_outputs": {"envelope_left_m": 2.0, "envelope_right_m": 1.0},
    }
    made = {
        "scene.usda": LAYER,
        "metadata.yaml": metadata,
        "rig_trajectories.json": rig,
        "sequence_tracks.json": {
            "s": {"tracks_data": tracks, "cuboidtracks_data": {"cuboids_dims": [[4, 2, 1]]}}
        },
        "mesh.ply": ply_bytes(square(), "m"),
        "mesh_ground.ply": ply_bytes(square(), "m"),
        "map.xodr": MAP,
    }
    return made | changed


def written(path, parts):
    """A bundle of parts, values as texts."""
    texts = {
        name: value
        if isinstance(value, bytes)
        else (yaml.safe_dump(value) if name.endswith("yaml") else json.dumps(value)).encode()
        for name, value in parts.items()
        if value is not None
    }
    write_usdz(path, texts)
    return path


def said(path, name, monkeypatch):
    """The findings of one part alone, worst first."""
    monkeypatch.setattr(bundle_checks, "_CHECKS", {name: bundle_checks._CHECKS[name]})
    worst = {"fail": 0, "warn": 1, "ok": 2}
    found = [one for one in check_bundle(path) if one.name == name]
    return sorted(((one.verdict, one.detail) for one in found), key=lambda one: worst[one[0]])


def test_a_whole_bundle_lacks_nothing(tmp_path):
    path = written(tmp_path / "a.usdz", members())
    findings = check_bundle(path)
    assert [one for one in findings if one.verdict != "ok"] == []
    assert {one.name for one in findings} == {
        *("layer", "metadata", "rig", "tracks", "meshes", "map")
    }


def test_members_are_stored_at_multiples_of_64_bytes(tmp_path):
    path = written(tmp_path / "a.usdz", members())
    content = path.read_bytes()
    with zipfile.ZipFile(path) as packed:
        assert packed.testzip() is None
        assert packed.namelist()[0] == "scene.usda"
        for one in packed.infolist():
            name_bytes, extra_bytes = struct.unpack_from("<HH", content, one.header_offset + 26)
            assert (one.header_offset + 30 + name_bytes + extra_bytes) % ALIGNED_BYTES == 0
            assert one.compress_type == zipfile.ZIP_STORED
    again = written(tmp_path / "b.usdz", members())
    assert again.read_bytes() == content


def changed_rig(key, value):
    rig = members()["rig_trajectories.json"]
    rig["rig_trajectories"][0][key] = value
    return {"rig_trajectories.json": rig}


def changed_tracks(key, value):
    whole = members()["sequence_tracks.json"]
    whole["s"]["tracks_data"][key] = value
    return {"sequence_tracks.json": whole}


METADATA = members()["metadata.yaml"]
WITHOUT_UUID = {k: v for k, v in METADATA.items() if k != "uuid"}
WITHOUT_REACH = METADATA | {"training_step_outputs": {}}
WITH_HOLE = ply_bytes(square(hole_m=1.0), "m")
TURNED = [[5, 0, 1, 0, 0, 0, 2]] * 2
LACKING = [
    ("layer", {"scene.usda": b"#usda 1.0\n"}, "warn", "form of somebody's own"),
    ("layer", {"scene.usda": b"#usda 1.0\n("}, "fail", "cannot be opened"),
    ("metadata", {"metadata.yaml": WITHOUT_UUID}, "fail", "lacks uuid"),
    ("metadata", {"metadata.yaml": WITHOUT_REACH}, "warn", "how far from its path"),
    ("metadata", {"metadata.yaml": b"a: &x [1]\nb: *x\n"}, "fail", "aliases"),
    ("metadata", {"metadata.yaml": b"!!python/object:os.system {}"}, "fail", "is no YAML"),
    ("metadata", {"metadata.yaml": b"[" * 200_000}, "fail", "is no YAML"),
    ("rig", {"rig_trajectories.json": b"{"}, "fail", "is no JSON"),
    ("rig", {"rig_trajectories.json": b"[" * 100_000}, "fail", "is no JSON"),
    ("rig", {"rig_trajectories.json": None}, "fail", "is missing"),
    ("rig", {"rig_trajectories.json": {}}, "fail", "world_to_nre is missing"),
    ("rig", changed_rig("T_rig_world_timestamps_us", [0, 200, 100]), "fail", "do not ascend"),
    ("rig", changed_rig("T_rig_worlds", [[[10**400] * 4] * 4] * 3), "fail", "numbers"),
    ("rig", changed_rig("T_rig_worlds", [[[2.0] * 4] * 4] * 3), "fail", "no rotation"),
    ("rig", changed_rig("rig_bbox", None), "warn", "size of the car"),
    ("rig", changed_rig("cameras_frame_timestamps_us", {"c@1": [[5, 5]]}), "fail", "ends no later"),
    ("tracks", {"sequence_tracks.json": {"a": {}, "b": {}}}, "fail", "expected one sequence"),
    ("tracks", changed_tracks("tracks_flags", ["NONE"]), "warn", "0 of which may be moved"),
    ("tracks", changed_tracks("tracks_poses", [TURNED]), "fail", "unit quaternions"),
    ("meshes", {"mesh_ground.ply": None}, "fail", "mesh_ground.ply is missing"),
    ("meshes", {"mesh.ply": b"ply\nelement vertex 4000000000\n"}, "fail", "than it has bytes"),
    ("meshes", {"mesh_ground.ply": WITH_HOLE}, "warn", "widest hole within 1.75 m of it 1.0 m"),
    ("map", {"map.xodr": None}, "warn", "CARLA has no road"),
    ("map", {"map.xodr": b"<!DOCTYPE a [<!ENTITY b 'c'>]><a/>"}, "fail", "document type"),
    ("map", {"map.xodr": b"<OpenDRIVE/>"}, "fail", "at least one driving lane"),
]


@pytest.mark.parametrize(
    ("name", "changed", "verdict", "words"), LACKING, ids=[one[3] for one in LACKING]
)
def test_what_is_lacking_is_said_where_it_is(tmp_path, monkeypatch, name, changed, verdict, words):
    path = written(tmp_path / "a.usdz", members(**changed))
    found = said(path, name, monkeypatch)
    assert found[0][0] == verdict, found
    assert words in found[0][1]
    assert "\n" not in found[0][1]


def zip_of(path, *entries, compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as packed:
        for name, content in entries:
            packed.writestr(name, content)
    return path


def linked(name):
    entry = zipfile.ZipInfo(name)
    entry.external_attr = 0o120777 << 16
    return entry


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ([("../a", b"")], "leads outside"),
        ([("/etc/passwd", b"")], "leads outside"),
        ([("a\\..\\b", b"")], "leads outside"),
        ([("C:/a", b"")], "leads outside"),
        ([(linked("a"), b"/etc/passwd")], "is a link"),
        ([("a", bytes(50_000_000))], "a zip bomb"),
    ],
)
def test_zips_that_are_made_to_do_harm_are_refused(tmp_path, entries, words):
    path = zip_of(tmp_path / "a.usdz", *entries, compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(DataError, match=words):
        check_bundle(path)


def test_what_is_no_zip_is_refused(tmp_path):
    with pytest.raises(DataError, match="is not there"):
        check_bundle(tmp_path / "a.usdz")
    (tmp_path / "b.usdz").write_bytes(b"PK\x03\x04" + bytes(100))
    with pytest.raises(DataError, match="no zip that can be read"):
        check_bundle(tmp_path / "b.usdz")


def test_twice_one_name_and_a_damaged_member_are_told(tmp_path):
    with pytest.warns(UserWarning, match="Duplicate name"):
        path = zip_of(tmp_path / "a.usdz", ("a", b"1"), ("a", b"2"))
    with pytest.raises(DataError, match="two members have one name"):
        check_bundle(path)
    path = zip_of(tmp_path / "b.usdz", ("a", b"0123456789"))
    content = path.read_bytes()
    path.write_bytes(content.replace(b"0123456789", b"0123456780"))
    with opened_bundle(path) as bundle, pytest.raises(DataError, match="a cannot be read"):
        bundle.read("a", 100)
    whole = zip_of(tmp_path / "c.usdz", ("a", b"0123456789"))
    with opened_bundle(whole) as bundle, pytest.raises(DataError, match="larger than"):
        bundle.read("a", 9)


def test_a_wall_of_points_becomes_a_mesh_through_them():
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(4000, 5.0), rng.uniform(-3, 3, 4000), rng.uniform(0, 2, 4000)])
    vertices, faces = obstacle_mesh(wall, np.zeros(3))
    assert len(faces) > 500
    np.testing.assert_allclose(vertices[:, 0], 5.0, atol=1e-6)
    again = mesh_of_ply(ply_bytes((vertices, faces), "c"), "m")
    np.testing.assert_allclose(again[0], vertices)
    assert (again[1] == faces).all()
    none = obstacle_mesh(np.zeros((0, 3)), np.zeros(3))
    assert none[0].shape == none[1].shape == (0, 3)
