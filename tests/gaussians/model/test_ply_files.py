"""Gaussians as PLY: read by others, read back, and refused where they are no such file."""

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from random_gaussians import random_gaussians

from lidarpainter_models.errors import DataError
from lidarpainter_models.gaussians.model.gaussian_set import PARAMETERS
from lidarpainter_models.gaussians.model.ply_files import MAX_GAUSSIANS, read_ply, write_ply


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_gaussians_come_back_as_they_went(tmp_path, sh_degree):
    gaussians = random_gaussians(50, sh_degree)
    write_ply(tmp_path / "a.ply", gaussians, ["z up", "two\nlines"])
    back = read_ply(tmp_path / "a.ply")
    for name in PARAMETERS:
        torch.testing.assert_close(getattr(back, name), getattr(gaussians, name))
    assert not back.body_index.any()


def test_plyfile_finds_harmonics_channel_by_channel(tmp_path):
    gaussians = random_gaussians(7, 2)
    write_ply(tmp_path / "a.ply", gaussians, ["metres"])
    file = PlyData.read(tmp_path / "a.ply")
    vertex = file["vertex"]
    assert file.comments == ["metres"]
    assert [kind.name for kind in vertex.properties][:6] == [
        *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2")
    ]
    for number in range(24):  # 8 of red, 8 of green, 8 of blue
        expected = gaussians.sh_rest[:, number % 8, number // 8].numpy()
        np.testing.assert_array_equal(vertex[f"f_rest_{number}"], expected)
    np.testing.assert_allclose(vertex["rot_0"], gaussians.rotation_wxyz[:, 0], atol=1e-6)
    np.testing.assert_array_equal(vertex["opacity"], gaussians.opacity_logit)
    np.testing.assert_array_equal(vertex["scale_2"], gaussians.log_scale[:, 2])


def test_columns_of_other_programs_are_passed_over(tmp_path):
    gaussians = random_gaussians(5, 1)
    write_ply(tmp_path / "a.ply", gaussians)
    file = PlyData.read(tmp_path / "a.ply")
    old = file["vertex"].data
    new = np.zeros(5, dtype=[("label", "u1"), ("nx", "f8"), *old.dtype.descr])
    for name in old.dtype.names:
        new[name] = old[name]
    PlyData([PlyElement.describe(new, "vertex")], byte_order=">").write(tmp_path / "b.ply")
    torch.testing.assert_close(read_ply(tmp_path / "b.ply").sh_rest, gaussians.sh_rest)


ROW = b"".join(
    b"property float %s\n" % name
    for name in b"x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 "
    b"rot_3".split()
)
START = b"ply\nformat binary_little_endian 1.0\n"
BODY = np.ones(14, dtype="<f4").tobytes()
NAN = np.array([np.nan] + [1.0] * 13, dtype="<f4").tobytes()
FLAT = np.array([1.0] * 10 + [0.0] * 4, dtype="<f4").tobytes()


def one(rows=b"1", columns=ROW, body=BODY, start=START):
    return start + b"element vertex " + rows + b"\n" + columns + b"end_header\n" + body


def test_a_hand_made_file_of_one_row_is_read(tmp_path):
    (tmp_path / "a.ply").write_bytes(one())
    assert len(read_ply(tmp_path / "a.ply")) == 1


def test_opaque_and_flat_gaussians_of_other_programs_are_read(tmp_path):
    row = np.array([1.0] * 6 + [np.inf, -np.inf] + [1.0] * 6, dtype="<f4")
    (tmp_path / "a.ply").write_bytes(one(body=row.tobytes()))
    found = read_ply(tmp_path / "a.ply")
    assert float(found.opacity[0]) == 1.0
    assert 0 < float(found.scale_m[0, 0]) < 1e-9
    row[7] = np.inf  # endlessly large
    (tmp_path / "a.ply").write_bytes(one(body=row.tobytes()))
    with pytest.raises(DataError, match="not finite in scale_0"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"", "no PLY file"),
        (b"solid cube\n", "begin with the line 'ply'"),
        (b"ply\r" * 2000, "no PLY file"),
        (b"ply\n" + b"comment x\n" * 100_000, "no PLY file"),
        (b"ply\n" + b"comment " + b"x" * 10_000_000, "no PLY file"),
        (one(rows=b"1000000000000"), f"at most {MAX_GAUSSIANS}"),
        (one(rows=b"9" * 900), "is no number of rows"),
        (one(rows=b"-1"), "is no number of rows"),
        (one(rows=b"40000000"), "need a file of 22400"),
        (one(body=BODY + b"more"), "it has"),
        (one(body=BODY[:-1]), "it has"),
        (one(body=NAN), "not finite"),
        (one(body=FLAT), "rotations of length 0"),
        (one(start=b"ply\nformat ascii 1.0\n"), "cannot use 'format ascii 1.0'"),
        (one(start=b"ply\n"), "lacks a format"),
        (one(columns=b"property list uchar int x\n"), "cannot use 'property list"),
        (one(columns=b"property string x\n"), "cannot use 'property string x'"),
        (one(columns=ROW + b"element chunk 3\n"), "cannot use 'element chunk 3'"),
        (one(columns=ROW + b"property float x\n"), "cannot use 'property float x'"),
        (one(columns=ROW + b"property float f_rest_0\n", body=BODY * 2), "need a file of"),
        (one(columns=ROW + b"property float f_rest_0\n", body=BODY + b"0000"), "has 1 f_rest"),
        (one(columns=b"property float x\n", body=b"0000"), "holds no Gaussians, it lacks y"),
    ],
)
def test_what_is_no_file_of_gaussians_is_refused_in_one_line(tmp_path, content, complaint):
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(DataError, match=complaint) as refused:
        read_ply(tmp_path / "a.ply")
    assert len(str(refused.value)) < 400
    assert "\n" not in str(refused.value)


def test_a_folder_in_place_of_a_file_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"expected a \.ply file"):
        read_ply(tmp_path)
