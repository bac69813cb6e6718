"""A scene as USD with `ParticleField3DGaussianSplat` (OpenUSD 26.03 on), its actors in motion.

The stage is z up, in metres, in the frame of the scene's world. Every actor is an Xform whose
translation, orientation and visibility are sampled over time, and those of one moment given without
a time code; its Gaussians are below it in the frame of its box. Needs usd-core (extra `export`).
"""

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from lidarpainter_models.errors import ConfigError, DataError, MissingPackageError, WriteError
from lidarpainter_models.export.contents import FRAME, SceneContents
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.geometry.transforms import quaternion_from_rotation
from lidarpainter_models.storage.whole_files import whole_file

USD_ENDINGS = (".usdz", ".usdc", ".usda")
MAX_PACKED_BYTES = 2**32 - 1
"""Of a layer inside a .usdz, which is a zip file without its 64-bit extension."""
_REASON = re.compile(r"Error occurred writing file: ([^'\n]+)")
TIME_CODES_PER_SECOND = 1000.0
"""Time codes are milliseconds since the first frame."""


def write_usd(path: Path, contents: SceneContents, *, time: int = 0) -> None:
    """Write a scene and how it moves, aside and renamed whole.

    `time` is which of its times readers show that ask for none.

    Raises:
        ConfigError: the name does not end as USD files do.
        DataError: the scene is larger than a .usdz can be.
        MissingPackageError: the extra `export` is not installed.
        WriteError: the disk refuses.
    """
    if path.suffix not in USD_ENDINGS:
        raise ConfigError(f"{path.name}: expected a name in {', '.join(USD_ENDINGS)}")
    try:
        from pxr import Usd, UsdUtils
    except ImportError:
        hint = "USD needs usd-core: pip install 'lidarpainter[export]'"
        raise MissingPackageError(hint) from None
    with (
        whole_file(path) as aside,
        tempfile.TemporaryDirectory(dir=path.parent) as folder,
        _usd_errors(path),
    ):
        layer = Path(folder) / f"scene{'.usdc' if path.suffix == '.usdz' else path.suffix}"
        stage = Usd.Stage.CreateNew(str(layer))
        _fill(stage, contents, time)
        stage.GetRootLayer().Save()
        del stage
        if path.suffix != ".usdz":
            layer.replace(aside)
            return
        if layer.stat().st_size > MAX_PACKED_BYTES:
            raise DataError(f"{path}: larger than the 4 GiB of a .usdz, expected .usdc")
        packed = Path(folder) / "scene.usdz"
        if not UsdUtils.CreateNewUsdzPackage(str(layer), str(packed)):
            raise WriteError(f"{path}: cannot be written: USD could not pack it")
        packed.replace(aside)


@contextmanager
def _usd_errors(path: Path) -> Iterator[None]:
    """Turn what USD says of its insides into one line."""
    from pxr import Tf

    try:
        yield
    except Tf.ErrorException as error:
        found = _REASON.search(str(error))
        reason = found[1] if found else "USD failed"
        raise WriteError(f"{path}: cannot be written: {reason}") from None


def _fill(stage: Any, contents: SceneContents, time: int) -> None:  # noqa: ANN401 - pxr has no types
    from pxr import Sdf, UsdGeom

    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(TIME_CODES_PER_SECOND)
    codes = (contents.seconds * TIME_CODES_PER_SECOND).tolist()
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    if len(codes) > 1:
        stage.SetFramesPerSecond(1000.0 * (len(codes) - 1) / (codes[-1] - codes[0]))
    world = UsdGeom.Xform.Define(stage, "/World")
    world.GetPrim().SetDocumentation(
        f"{contents.name}: {FRAME}; colours before any camera's exposure"
    )
    stage.SetDefaultPrim(world.GetPrim())
    _define_gaussians(stage, "/World/Street", contents.street)
    poses = contents.world_from_actor
    rotations_wxyz = quaternion_from_rotation(poses[..., :3, :3])
    for index, actor in enumerate(contents.actors):
        identifier = re.sub(r"\W", "_", actor.actor_id, flags=re.ASCII)
        place = f"/World/Actors/A{index:03d}_{identifier}"
        xform = UsdGeom.Xform.Define(stage, Sdf.Path(place))
        xform.GetPrim().SetCustomDataByKey("actor_id", actor.actor_id)
        xform.GetPrim().SetCustomDataByKey("category", actor.category)
        translations = poses[:, index, :3, 3].tolist()
        _move(xform, codes, translations, rotations_wxyz[:, index].tolist(), time)
        _show(xform, codes, contents.is_present[:, index].tolist(), time)
        _define_gaussians(stage, f"{place}/Gaussians", actor.gaussians)


def _move(
    xform: Any,  # noqa: ANN401
    codes: list[float],
    translations: list[list[float]],
    rotations_wxyz: list[list[float]],
    time: int,
) -> None:
    from pxr import Gf, Usd, UsdGeom

    translate = xform.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    orient = xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    samples = [*zip(codes, translations, rotations_wxyz, strict=True)]
    shown = (Usd.TimeCode.Default(), *samples[time][1:])
    for code, metres, (w, x, y, z) in (shown, *samples):
        translate.Set(Gf.Vec3d(*metres), code)
        orient.Set(Gf.Quatd(w, x, y, z), code)


def _show(xform: Any, codes: list[float], is_present: list[bool], time: int) -> None:  # noqa: ANN401
    from pxr import UsdGeom

    visibility = xform.CreateVisibilityAttr()
    words = [UsdGeom.Tokens.inherited if one else UsdGeom.Tokens.invisible for one in is_present]
    visibility.Set(words[time])
    for number, (code, word) in enumerate(zip(codes, words, strict=True)):
        if number == 0 or word != words[number - 1]:  # tokens hold until the next sample
            visibility.Set(word, code)


def _define_gaussians(stage: Any, place: str, gaussians: GaussianSet) -> None:  # noqa: ANN401
    from pxr import UsdVol, Vt

    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, place)
    rotation = torch.nn.functional.normalize(gaussians.rotation_wxyz.detach(), dim=1)
    # usd-core reads quaternions from buffers with the scalar last
    values = {
        "positions": Vt.Vec3fArray.FromNumpy(gaussians.means.detach().numpy()),
        "orientations": Vt.QuatfArray.FromNumpy(rotation.roll(-1, 1).contiguous().numpy()),
        "scales": Vt.Vec3fArray.FromNumpy(gaussians.scale_m.detach().numpy()),
        "opacities": Vt.FloatArray.FromNumpy(gaussians.opacity.detach().numpy()),
        "radiance:sphericalHarmonicsDegree": gaussians.sh_degree,
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(
            gaussians.sh.detach().flatten(0, 1).contiguous().numpy()
        ),
        "projectionModeHint": "perspective",
        "sortingModeHint": "zDepth",
        "extent": Vt.Vec3fArray.FromNumpy(_extent(gaussians).numpy()),
    }
    prim = field.GetPrim()
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)


def _extent(gaussians: GaussianSet) -> torch.Tensor:
    """Lowest and highest corner of what the Gaussians cover, three deviations out."""
    if len(gaussians) == 0:
        return torch.zeros(2, 3)
    reach = 3 * gaussians.scale_m.detach().amax(dim=1, keepdim=True)
    means = gaussians.means.detach()
    return torch.stack([(means - reach).amin(dim=0), (means + reach).amax(dim=0)])
