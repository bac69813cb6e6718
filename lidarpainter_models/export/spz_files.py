"""Gaussians in Niantic's SPZ: eight bits for most numbers, a tenth of the size of PLY.

Frame of the file: x right, y up, z back (towards whoever looks along the drive), metres. Written by
gsply (extra `export`), version 3 (gzip) or 4 (zstd streams).
"""

from pathlib import Path
from typing import Literal

import torch

from lidarpainter_models.errors import DataError, MissingPackageError
from lidarpainter_models.export.contents import SceneContents
from lidarpainter_models.gaussians.model.gaussian_set import GaussianSet
from lidarpainter_models.gaussians.model.placing import carried_gaussians
from lidarpainter_models.storage.whole_files import whole_file

SpzVersion = Literal[3, 4]
SPZ_FROM_WORLD = torch.tensor(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]],
    dtype=torch.float64,
)
"""Right is minus left, up is up, back is minus forward."""
FRACTIONAL_BITS = 12
"""Of a position: a quarter of a millimetre, up to 2048 m away."""
MAX_REACH_M = 2.0 ** (23 - FRACTIONAL_BITS)


def write_spz(path: Path, gaussians_world: GaussianSet, *, version: SpzVersion = 3) -> None:
    """Write Gaussians that stand in the world, aside and renamed whole.

    Raises:
        MissingPackageError: the extra `export` is not installed.
        DataError: a Gaussian stands farther away than the format can say.
        WriteError: the disk refuses.
    """
    gsply = _gsply()
    turned = carried_gaussians(gaussians_world, SPZ_FROM_WORLD)
    if len(turned) and float(turned.means.abs().max()) >= MAX_REACH_M:
        raise DataError(f"{path}: SPZ reaches {MAX_REACH_M:.0f} m, the scene is larger")
    rotation_wxyz = torch.nn.functional.normalize(turned.rotation_wxyz, dim=1)
    data = gsply.GSData.from_arrays(
        means=turned.means.numpy(),
        scales=turned.log_scale.numpy(),
        quats=rotation_wxyz.numpy(),
        opacities=turned.opacity_logit.numpy(),
        sh0=turned.sh_dc[:, 0].numpy(),
        shN=turned.sh_rest.numpy() if turned.sh_degree else None,
        format="ply",
    )
    with whole_file(path) as aside:
        gsply.write_spz(aside, data, version=version, fractional_bits=FRACTIONAL_BITS)


def write_spz_scene(
    path: Path, contents: SceneContents, *, time: int = 0, version: SpzVersion = 3
) -> None:
    """Write everything that is there at the n-th of the times; raises as `write_spz` does."""
    write_spz(path, contents.placed(time), version=version)


def read_spz(path: Path) -> GaussianSet:
    """Read back what `write_spz` wrote, in the world.

    Raises:
        MissingPackageError: the extra `export` is not installed.
        DataError: it is no such file.
    """
    gsply = _gsply()
    try:
        data = gsply.read_spz(path)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: no readable SPZ file ({error})") from None
    count = len(data.means)
    rest = torch.zeros(count, 0, 3) if data.shN is None else torch.from_numpy(data.shN)
    turned = GaussianSet(
        means=torch.from_numpy(data.means),
        rotation_wxyz=torch.from_numpy(data.quats),
        log_scale=torch.from_numpy(data.scales),
        opacity_logit=torch.from_numpy(data.opacities),
        sh_dc=torch.from_numpy(data.sh0)[:, None],
        sh_rest=rest,
        body_index=torch.zeros(count, dtype=torch.int32),
    )
    return carried_gaussians(turned, SPZ_FROM_WORLD.T)


def _gsply():  # noqa: ANN202 - a module
    try:
        import gsply
        import zstandard  # noqa: F401 - gsply asks for it when version 4 is written
    except ImportError:
        raise MissingPackageError("SPZ needs gsply: pip install 'lidarpainter[export]'") from None
    return gsply
