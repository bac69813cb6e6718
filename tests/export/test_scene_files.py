"""A scene as a file of other programs, opened by readers that are not ours."""

import resource
import struct
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from gaussian_world import camera_at, scene_of
from plyfile import PlyData
from pygltflib import GLTF2
from random_gaussians import moving_scene
from styled_world import styled

from lidarpainter_models.errors import (
    ConfigError,
    DataError,
    MissingPackageError,
    SceneError,
    WriteError,
)
from lidarpainter_models.export import gltf_files
from lidarpainter_models.export.contents import fidelity, scene_contents, world_image
from lidarpainter_models.export.gltf_files import EXTENSION, write_gltf
from lidarpainter_models.export.spz_files import SPZ_FROM_WORLD, read_spz, write_spz
from lidarpainter_models.export.usd_files import TIME_CODES_PER_SECOND, write_usd
from lidarpainter_models.gaussians.model.gaussian_set import PARAMETERS, GaussianSet
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.gaussians.model.ply_files import read_ply, write_ply
from lidarpainter_models.geometry.transforms import rigid_from_rotation, rotation_from_quaternion


@pytest.fixture(scope="module")
def world():
    """Scene, cameras, times, and what an export holds of them."""
    scene, cameras, times_ns = moving_scene()
    return scene, cameras, times_ns, scene_contents(scene, "toy/street", times_ns)


def gaussians_of(means, rotation_wxyz, scale_m, opacity, sh):
    """A set from what a file holds: plain scales and opacities, all harmonics together."""
    count = len(means)
    return GaussianSet(
        means=means,
        rotation_wxyz=rotation_wxyz,
        log_scale=scale_m.log(),
        opacity_logit=torch.logit(opacity),
        sh_dc=sh[:, :1],
        sh_rest=sh[:, 1:],
        body_index=torch.zeros(count, dtype=torch.int32),
    )


# --- the scene in parts


@pytest.mark.parametrize("time", [0, 2, 4])
def test_placed_parts_look_as_the_scene_does(world, time):
    scene, cameras, times_ns, contents = world
    found = fidelity(scene, contents.placed(time), times_ns[time], cameras[:2], sky=scene.sky)
    assert found.psnr_db > 90  # float32 of poses
    assert contents.is_present[time].tolist() == [True, time >= 2]


def test_actors_are_chosen_by_name_and_unknown_ones_refused(world):
    scene, _, times_ns, contents = world
    alone = scene_contents(scene, "toy/street", times_ns, actors=["car"])
    assert [actor.actor_id for actor in alone.actors] == ["car"]
    assert alone.num_gaussians == contents.num_gaussians - 40
    with pytest.raises(SceneError, match="has no actor 'bus', it has car"):
        scene_contents(scene, "toy/street", times_ns, actors=["bus"])


def test_far_gaussians_show_the_sky(world):
    scene, cameras, times_ns, _ = world
    with_sky = scene_contents(scene, "toy/street", times_ns, with_sky=True)
    image = world_image(with_sky.placed(0), cameras[0], None)
    ours = scene.render(cameras[0], times_ns[0])
    is_clear = ours.alpha < 0.01
    is_clear[cameras[0].height_px // 2 :] = False  # the texture ends a little below the horizon
    assert int(is_clear.sum()) > 100
    torch.testing.assert_close(image[is_clear], ours.rgb[is_clear], atol=0.02, rtol=0)


def test_a_style_is_baked_into_colours(tmp_path):
    scene = styled("foggy")
    baked = scene.baked(0)
    write_ply(tmp_path / "a.ply", scene_contents(baked, "toy/street", [0]).placed(0))
    found = read_ply(tmp_path / "a.ply")
    camera = [camera_at(0.0)]
    foggy = fidelity(scene, found, 0, camera, sky=baked.sky)
    clear = fidelity(replace(scene, style=None), found, 0, camera, sky=scene.sky)
    assert foggy.psnr_db > 60 > clear.psnr_db + 30


# --- PLY and SPZ


def test_ply_is_read_by_plyfile_and_renders_the_same(world, tmp_path):
    scene, cameras, _, contents = world
    placed = contents.placed(3)
    write_ply(tmp_path / "a.ply", placed)
    assert len(PlyData.read(tmp_path / "a.ply")["vertex"]) == len(placed)
    image = world_image(read_ply(tmp_path / "a.ply"), cameras[0], scene.sky)
    expected = world_image(placed, cameras[0], scene.sky)
    torch.testing.assert_close(image, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("version", [3, 4])
def test_spz_loses_little_and_stands_in_its_own_frame(world, tmp_path, version):
    import gsply

    scene, cameras, times_ns, contents = world
    placed = contents.placed(3)
    path = tmp_path / "a.spz"
    write_spz(path, placed, version=version)
    lost = fidelity(scene, read_spz(path), times_ns[3], cameras[:2], sky=scene.sky)
    assert 40 < lost.psnr_db < 80  # eight bits a number
    start = path.read_bytes()[:8]
    assert start[:2] == b"\x1f\x8b" if version == 3 else struct.unpack("<4sI", start)[1] == 4
    x, y, z = gsply.read_spz(path).means.T  # right, up, back
    back = np.stack([-z, -x, y], axis=1)
    np.testing.assert_allclose(back, placed.means, atol=2**-12)


def test_spz_says_what_it_needs_and_how_far_it_reaches(world, tmp_path, monkeypatch):
    far = carried_gaussians(world[3].street, SPZ_FROM_WORLD.new_tensor(np.eye(4)))
    far.means[0, 0] = 5000.0
    with pytest.raises(DataError, match="SPZ reaches 2048 m"):
        write_spz(tmp_path / "a.spz", far)
    (tmp_path / "b.spz").write_bytes(b"\x1f\x8b nothing")
    with pytest.raises(DataError, match="no readable SPZ file"):
        read_spz(tmp_path / "b.spz")
    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'lidarpainter\[export\]'"):
        write_spz(tmp_path / "a.spz", far)
    assert [path.name for path in tmp_path.iterdir()] == ["b.spz"]


# --- glTF


def gltf_column(file, number):
    """The values of an accessor, as pygltflib finds them."""
    accessor = file.accessors[number]
    view = file.bufferViews[accessor.bufferView]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
    kind = {5126: "<f4", 5121: "u1"}[accessor.componentType]
    blob = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return torch.from_numpy(np.frombuffer(blob, kind).reshape(accessor.count, width).copy())


def gltf_gaussians(file, mesh):
    """The Gaussians of a mesh."""
    (primitive,) = file.meshes[mesh].primitives
    assert primitive.mode == 0
    assert primitive.extensions[EXTENSION]["kernel"] == "ellipse"
    named = vars(primitive.attributes)
    columns = {name: gltf_column(file, n) for name, n in named.items() if n is not None}
    harmonics = [
        columns[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"]
        for degree in range(3)
        for order in range(2 * degree + 1)
    ]
    return gaussians_of(
        columns["POSITION"],
        columns[f"{EXTENSION}:ROTATION"].roll(1, 1),
        columns[f"{EXTENSION}:SCALE"],
        columns[f"{EXTENSION}:OPACITY"][:, 0],
        torch.stack(harmonics, dim=1),
    )


def test_gltf_holds_every_number_of_the_scene(world, tmp_path):
    contents = world[3]
    write_gltf(tmp_path / "a.glb", contents)
    file = GLTF2().load(tmp_path / "a.glb")
    assert file.extensionsUsed == [EXTENSION]
    root, street, *cars = (file.nodes[n] for n in range(len(file.nodes)))
    assert root.children == [1, 2, 3]
    assert [car.name for car in cars] == [actor.actor_id for actor in contents.actors]
    expected = [contents.street, *(actor.gaussians for actor in contents.actors)]
    for node, ours in zip([street, *cars], expected, strict=True):
        found = gltf_gaussians(file, node.mesh)
        for name in PARAMETERS:
            torch.testing.assert_close(getattr(found, name), getattr(ours, name), atol=1e-5, rtol=0)
    # left, up and forward of the world are x, y and z of the file
    turn = rotation_from_quaternion(torch.tensor(root.rotation).roll(1))
    forward = torch.tensor([1.0, 0.0, 0.0])
    torch.testing.assert_close(turn @ forward, torch.tensor([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("time", [0, 2, 4])
def test_gltf_actors_stand_where_they_should(world, tmp_path, time):
    scene, _, times_ns, contents = world
    write_gltf(tmp_path / "a.glb", contents, time=1)
    file = GLTF2().load(tmp_path / "a.glb")
    (drive,) = file.animations
    found: dict[int, dict[str, torch.Tensor]] = {}
    for channel in drive.channels:
        sampler = drive.samplers[channel.sampler]
        seconds = gltf_column(file, sampler.input)[:, 0]
        assert seconds[time] == pytest.approx(times_ns[time] * 1e-9)
        values = gltf_column(file, sampler.output)
        found.setdefault(channel.target.node, {})[channel.target.path] = values[time]
    likely, present = scene.actors.refined_poses(times_ns[time])
    for row, node in enumerate((2, 3)):
        rotation = rotation_from_quaternion(found[node]["rotation"].roll(1))
        pose = rigid_from_rotation(rotation, found[node]["translation"]).double()
        torch.testing.assert_close(pose, likely[row], atol=1e-5, rtol=0)
        assert found[node]["scale"].tolist() == [float(present[row])] * 3
        still = file.nodes[node]  # what readers without animations show
        assert still.translation == pytest.approx(contents.world_from_actor[1, row, :3, 3].tolist())


def test_gltf_that_is_too_large_is_refused_and_leaves_nothing(world, tmp_path, monkeypatch):
    monkeypatch.setattr(gltf_files, "MAX_BYTES", 10_000)
    with pytest.raises(DataError, match=r"a \.glb holds at most"):
        write_gltf(tmp_path / "a.glb", world[3])
    assert list(tmp_path.iterdir()) == []


# --- USD


def usd_gaussians(prim):
    """The Gaussians of a prim, as usd-core hands them out."""

    def column(name):
        return torch.from_numpy(np.array(prim.GetAttribute(name).Get()))

    rotations = [
        [value.GetReal(), *value.GetImaginary()]
        for value in prim.GetAttribute("orientations").Get()
    ]
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    means = column("positions")
    harmonics = column("radiance:sphericalHarmonicsCoefficients")
    return gaussians_of(
        means,
        torch.tensor(rotations),
        column("scales"),
        column("opacities"),
        harmonics.reshape(len(means), (degree + 1) ** 2, 3),
    )


@pytest.mark.parametrize("ending", ["usdz", "usdc"])
def test_usd_holds_every_number_and_moves_the_actors(world, tmp_path, ending):
    from pxr import Usd, UsdGeom

    scene, _, times_ns, contents = world
    write_usd(tmp_path / f"a.{ending}", contents)
    stage = Usd.Stage.Open(str(tmp_path / f"a.{ending}"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    street = stage.GetPrimAtPath("/World/Street")
    assert street.GetTypeName() == "ParticleField3DGaussianSplat"
    actors = stage.GetPrimAtPath("/World/Actors").GetChildren()
    assert [prim.GetCustomDataByKey("actor_id") for prim in actors] == ["car", 'van "7"/é\n']
    expected = [contents.street, *(actor.gaussians for actor in contents.actors)]
    prims = [street, *(prim.GetChildren()[0] for prim in actors)]
    for prim, ours in zip(prims, expected, strict=True):
        found = usd_gaussians(prim)
        for name in PARAMETERS:
            torch.testing.assert_close(getattr(found, name), getattr(ours, name), atol=1e-5, rtol=0)
    for time in (0, 2, 4):
        code = Usd.TimeCode(times_ns[time] * 1e-9 * TIME_CODES_PER_SECOND)
        require_shown(stage, code, scene.actors.refined_poses(times_ns[time]))


def require_shown(stage, code, poses):
    """Actors stand where they should at a time, and are seen if they are there."""
    from pxr import UsdGeom

    for prim, likely, present in zip(
        stage.GetPrimAtPath("/World/Actors").GetChildren(), *poses, strict=True
    ):
        pose = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(code)
        pose = torch.from_numpy(np.array(pose)).T
        torch.testing.assert_close(pose, likely, atol=1e-5, rtol=0)
        seen = UsdGeom.Imageable(prim).ComputeVisibility(code)
        assert (seen == "inherited") == bool(present)


@pytest.mark.parametrize("time", [0, 3])
def test_usd_shows_one_moment_to_whoever_asks_for_none(world, tmp_path, time):
    from pxr import Usd

    scene, _, times_ns, contents = world
    write_usd(tmp_path / "a.usdc", contents, time=time)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    require_shown(stage, Usd.TimeCode.Default(), scene.actors.refined_poses(times_ns[time]))


def test_usd_names_its_endings_and_what_it_needs(world, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match=r"a\.ply: expected a name in \.usdz, \.usdc, \.usda"):
        write_usd(tmp_path / "a.ply", world[3])
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(MissingPackageError, match="USD needs usd-core"):
        write_usd(tmp_path / "a.usdz", world[3])
    assert list(tmp_path.iterdir()) == []


def test_a_street_without_actors_stands_still(tmp_path):
    from pxr import Usd

    scene, cameras, times_ns = moving_scene()
    still = scene_of(scene.gaussians.select(torch.arange(150)), cameras)
    contents = scene_contents(still, "toy/street", times_ns)
    assert fidelity(still, contents.placed(0), 0, cameras[:1], sky=still.sky).psnr_db > 90
    write_gltf(tmp_path / "a.glb", contents)
    file = GLTF2().load(tmp_path / "a.glb")
    assert (len(file.nodes), file.animations) == (2, [])
    write_usd(tmp_path / "a.usdz", contents)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    assert len(usd_gaussians(stage.GetPrimAtPath("/World/Street"))) == 150


@pytest.mark.parametrize("ending", ["usda", "usdz"])
def test_usd_on_a_full_disk_is_one_line(world, tmp_path, ending):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000, before[1]))  # the kernel refuses more
    try:
        with pytest.raises(WriteError, match=r"cannot be written: File too large$"):
            write_usd(tmp_path / f"a.{ending}", world[3])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_usd_that_cannot_be_packed_leaves_nothing(world, tmp_path, monkeypatch):
    from pxr import UsdUtils

    monkeypatch.setattr(UsdUtils, "CreateNewUsdzPackage", lambda *_: False)
    with pytest.raises(WriteError, match="USD could not pack it"):
        write_usd(tmp_path / "a.usdz", world[3])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("write", [write_gltf, write_usd])
def test_a_place_that_cannot_be_written_is_named(world, tmp_path, write):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(WriteError, match="cannot be written"):
        write(tmp_path / "file" / "a.usdc", world[3])
