"""PLY, SPZ and glTF beside PlayCanvas' splat-transform (npm), where it is on the path."""

import shutil
import subprocess

import numpy as np
import pytest
import torch
from pygltflib import GLTF2
from random_gaussians import moving_scene

from lidarpainter_models.export.contents import scene_contents
from lidarpainter_models.export.fidelity import fidelity
from lidarpainter_models.export.gltf_files import write_gltf
from lidarpainter_models.export.spz_files import SPZ_FROM_WORLD, write_spz
from lidarpainter_models.gaussians.model.gaussian_set import PARAMETERS
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.gaussians.model.ply_files import read_ply, write_ply

COMMAND = shutil.which("splat-transform")
SPZ_FROM_DOWN = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
"""It takes PLY to be x right, y down, z forward."""
ITS_GLTF_FROM_PLY = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
"""It turns every PLY over on the way, so that y is up."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(COMMAND is None, reason="no splat-transform on the path"),
]


@pytest.fixture
def world():
    scene, cameras, times_ns = moving_scene()
    return scene, cameras, times_ns, scene_contents(scene, "toy/street", times_ns)


def convert(source, target):
    subprocess.run([COMMAND, "-w", "-q", str(source), str(target)], check=True, timeout=120)


def test_it_reads_our_ply_and_changes_nothing(world, tmp_path):
    placed = world[3].placed(3)
    write_ply(tmp_path / "a.ply", placed, ["a comment"])
    convert(tmp_path / "a.ply", tmp_path / "b.ply")
    found = read_ply(tmp_path / "b.ply")
    for name in PARAMETERS:
        torch.testing.assert_close(getattr(found, name), getattr(placed, name), rtol=0, atol=1e-6)


@pytest.mark.parametrize("version", [3, 4])
def test_it_sees_in_our_spz_what_we_see(world, tmp_path, version):
    scene, cameras, times_ns, contents = world
    write_spz(tmp_path / "a.spz", contents.placed(3), version=version)
    convert(tmp_path / "a.spz", tmp_path / "b.ply")
    world_from_down = SPZ_FROM_WORLD.T @ SPZ_FROM_DOWN
    found = carried_gaussians(read_ply(tmp_path / "b.ply"), world_from_down)
    assert fidelity(scene, found, times_ns[3], cameras[:2], sky=scene.sky).psnr_db > 40


def test_its_gltf_has_the_attributes_of_ours(world, tmp_path):
    contents = world[3]
    turned = carried_gaussians(contents.street, ITS_GLTF_FROM_PLY)
    write_ply(tmp_path / "a.ply", turned)
    convert(tmp_path / "a.ply", tmp_path / "theirs.glb")
    write_gltf(tmp_path / "ours.glb", contents)
    theirs, ours = (attributes(tmp_path / f"{name}.glb") for name in ("theirs", "ours"))
    assert theirs.keys() == ours.keys()
    for name, values in theirs.items():
        if name.endswith("ROTATION"):  # a quaternion and its negative turn alike
            cosines = (ours[name] * values).reshape(-1, 4).sum(axis=1)
            np.testing.assert_allclose(np.abs(cosines), 1, atol=1e-5)
        else:  # a colour in bytes may round either way
            np.testing.assert_allclose(ours[name], values, atol=1 if name == "COLOR_0" else 1e-5)


def attributes(path):
    """The columns of a file's first mesh."""
    file = GLTF2().load(path)
    found = {}
    for name, number in vars(file.meshes[0].primitives[0].attributes).items():
        if number is not None:
            view = file.bufferViews[file.accessors[number].bufferView]
            blob = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
            kind = np.uint8 if name == "COLOR_0" else np.dtype("<f4")
            found[name] = np.frombuffer(blob, kind).astype(np.float64)
    return found
