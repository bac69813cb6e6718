"""Look at a fitted scene from all along its path, and learn what a style must know of the place.

Lamps and windows are looked for in rendered views (`painter.styles.lamps`); what several views
find at one place in the world is one lamp. Which windows are lit is drawn once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidarpainter_models.conditioning.conditions import ConditionBuilder
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene
from lidarpainter_models.gaussians.model.styling.scene_style import SceneStyle, StyledPlace
from lidarpainter_models.geometry.cameras import Camera
from lidarpainter_models.observations.views import SceneObservations, TrainingView
from lidarpainter_models.painter.styles import StyleView
from lidarpainter_models.painter.styles.fog import airlight
from lidarpainter_models.painter.styles.lamps import Lamp, LampKind, find_lamps
from lidarpainter_models.painter.styles.night import POWER, RADIANCE, place_of, sunlit_white
from lidarpainter_models.painter.styles.view import fit_ground, quantile
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.splits import sampled_views
from lidarpainter_models.weather.darkness import HEADLAMP_AHEAD_M, HEADLAMP_HEIGHT_M, LIT_SHARE
from lidarpainter_models.weather.mix import StyleMix

MOST_VIEWS = 24
LEAST_FINDS = 2
"""What one view alone finds is no lamp, where there are several views."""
MERGED_M: dict[LampKind, float] = {"signal": 0.8, "window": 1.2, "street": 2.0}
"""Finds of one kind closer than this are one lamp."""
SIGNAL_LOWEST_M = 1.8
"""Lower signals are tail lights, which the cars' boxes bring themselves."""
LAMP_GLOW = 10.0
"""A lamp's own light against that of its patch of an image, which is larger than the lamp."""
USUAL_CAMERA_HEIGHT_M = 1.6
MOVING_ALPHA = 0.3


@dataclass(frozen=True, kw_only=True, eq=False)
class _Find:
    """A lamp as one view finds it."""

    kind: LampKind
    centre: Float[Tensor, "3"]
    along: Float[Tensor, "3"]
    half_m: Float[Tensor, "2"]
    rgb: Float[Tensor, "3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Look:
    """What one view says of the place."""

    finds: list[_Find]
    white: float
    horizon: Float[Tensor, "3"]
    camera_height_m: float | None


def styled_scene(
    scene: GaussianScene,
    seen: SceneObservations,
    recorded: DrivingScene,
    mix: StyleMix,
    *,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> GaussianScene:
    """The scene in a style; one that wears another style changes it.

    The poses of `recorded` say where the car that recorded was; the seed decides which windows are
    lit and where puddles stand.
    """
    clear = replace(scene, style=None)
    builder = ConditionBuilder(clear, seen.lidar_map, seen.views)
    looked_at = sampled_views(seen.views, MOST_VIEWS)
    looks = []
    for number, view in enumerate(looked_at):
        looks.append(_look(builder, view))
        progress(number + 1, len(looked_at))
    heights = sorted(h for look in looks if (h := look.camera_height_m) is not None)
    height_m = heights[len(heights) // 2] if heights else USUAL_CAMERA_HEIGHT_M
    lamp, heading = _ego_lamps(recorded, looked_at[0], height_m)
    place = _place(looks, lamp, heading, recorded.frame_timestamps_ns, seed)
    return replace(clear, style=SceneStyle(mix=mix, seed=seed, place=place.to(scene.device)))


def style_view(
    builder: ConditionBuilder,
    camera: Camera,
    timestamp_ns: int,
    image: Float[Tensor, "height width 3"],
    sky_mask: Bool[Tensor, "height width"] | None = None,
) -> tuple[StyleView, Float[Tensor, "height width"]]:
    """An image of the scene with what styles it, and the LiDAR depth that supports it.

    `sky_mask` is that of a recorded image; by default what the Gaussians leave open is sky.

    Returns:
        The view, its depth that of the render corrected by LiDAR; and camera z in metres where the
        LiDAR hit, 0 elsewhere. All on the CPU, where styles are made.
    """
    render = builder.scene.render(camera, timestamp_ns)
    lidar = builder.lidar_image(camera, camera.taken_ns(timestamp_ns))
    sky = 1 - render.alpha.clamp(0, 1).cpu() if sky_mask is None else sky_mask.float()
    view = StyleView(
        rgb=image.cpu(),
        depth_m=builder.surface_m(render, lidar, camera).detach().cpu(),
        sky=sky.detach(),
        camera=camera,
    )
    return view, lidar.depth_m.cpu()


def _place(
    looks: Sequence[_Look],
    ego_lamp: Float[Tensor, "frames 3"],
    ego_heading: Float[Tensor, "frames 3"],
    times_ns: Int[Tensor, " frames"],
    seed: int,
) -> StyledPlace:
    """What all views together say of the place."""
    lamps, windows = _agreed(looks, least=min(LEAST_FINDS, len(looks)))
    drawn = torch.rand(len(windows), generator=torch.Generator().manual_seed(seed))
    lit = [pane for pane, chance in zip(windows, drawn.tolist(), strict=True) if chance < LIT_SHARE]
    return StyledPlace(
        white=torch.tensor([look.white for look in looks]).mean(),
        horizon_light=torch.stack([look.horizon for look in looks]).mean(dim=0),
        lamp_position=_stacked([found.centre for found in lamps], 3),
        lamp_rgb=_stacked([found.rgb for found in lamps], 3),
        lamp_power=torch.tensor([POWER[found.kind] for found in lamps]),
        lamp_radiance=torch.tensor([LAMP_GLOW * RADIANCE[found.kind] for found in lamps]),
        window_centre=_stacked([found.centre for found in lit], 3),
        window_along=_stacked([found.along for found in lit], 3),
        window_half_m=_stacked([found.half_m for found in lit], 2),
        ego_times_ns=times_ns,
        ego_lamp=ego_lamp,
        ego_heading=ego_heading,
    )


def _stacked(rows: list[Tensor], width: int) -> Float[Tensor, "rows width"]:
    return torch.stack(rows).float() if rows else torch.zeros(0, width)


def _look(builder: ConditionBuilder, view: TrainingView) -> _Look:
    """Everything that one view shows of the place."""
    camera = builder.scene.refined_camera(view)
    render = builder.scene.render(camera, view.timestamp_ns)
    image = render.rgb.clamp(0, 1)
    styled_view, _ = style_view(builder, camera, view.timestamp_ns, image)
    place, points_m = place_of(styled_view)
    finds = []
    if points_m is not None:
        centre = camera.centre_world.float()
        for lamp in find_lamps(place, lit_share=1.0, generator=torch.Generator()):
            moving = render.actor_alpha[lamp.window][lamp.patch].mean()
            high = None if place.height_m is None else place.height_m[lamp.window][lamp.patch]
            is_low = lamp.kind == "signal" and (
                high is None or float(high.mean()) < SIGNAL_LOWEST_M
            )
            if float(moving) < MOVING_ALPHA and not is_low:
                finds.append(_find(lamp, points_m[lamp.window][lamp.patch] + centre))
    return _Look(
        finds=finds,
        white=sunlit_white(styled_view),
        horizon=airlight(styled_view, greyness=0.0),
        camera_height_m=_camera_height_m(styled_view, points_m),
    )


def _camera_height_m(
    view: StyleView, points_m: Float[Tensor, "height width 3"] | None
) -> float | None:
    ground = None if points_m is None else fit_ground(points_m, view.surface)
    return None if ground is None else ground.camera_height_m


def _find(lamp: Lamp, points_world: Float[Tensor, "pixels 3"]) -> _Find:
    """Middle, direction and half size of the surface that a lamp's patch shows."""
    centre = points_world.median(dim=0).values
    offset = points_world - centre
    spread = offset[:, :2].T @ offset[:, :2]
    along = torch.zeros(3)
    along[:2] = torch.linalg.eigh(spread.double()).eigenvectors[:, -1].float()
    sideways = (offset @ along).abs()
    # single pixels lie far off
    half_m = torch.stack([quantile(away, 0.9) for away in (sideways, offset[:, 2].abs())])
    return _Find(kind=lamp.kind, centre=centre, along=along, half_m=half_m, rgb=lamp.colour)


def _agreed(looks: Sequence[_Look], *, least: int) -> tuple[list[_Find], list[_Find]]:
    """Lamps and windows that enough views agree on, in an order that a seed can rely on."""
    lamps: list[_Find] = []
    windows: list[_Find] = []
    for kind, merged_m in MERGED_M.items():
        own = [(number, find) for number, look in enumerate(looks) for find in look.finds]
        own = [(number, find) for number, find in own if find.kind == kind]
        for group in _groups(_stacked([find.centre for _, find in own], 3), merged_m):
            members = [own[row] for row in group.tolist()]
            if len({number for number, _ in members}) >= least:
                (windows if kind == "window" else lamps).append(_merged([f for _, f in members]))
    return lamps, windows


def _groups(centres: Float[Tensor, "finds 3"], merged_m: float) -> list[Int[Tensor, " members"]]:
    """Finds around each one that is not yet taken, in their order."""
    near = torch.cdist(centres, centres) < merged_m
    free = torch.ones(len(centres), dtype=torch.bool)
    groups = []
    for row in range(len(centres)):
        if free[row]:
            members = (near[row] & free).nonzero()[:, 0]
            free[members] = False
            groups.append(members)
    return groups


def _merged(finds: list[_Find]) -> _Find:
    """The median of several finds of one lamp; the direction is that of the widest."""
    widest = max(finds, key=lambda find: float(find.half_m[0]))
    return _Find(
        kind=finds[0].kind,
        centre=torch.stack([find.centre for find in finds]).median(dim=0).values,
        along=widest.along,
        half_m=torch.stack([find.half_m for find in finds]).median(dim=0).values,
        rgb=finds[0].rgb,
    )


def _ego_lamps(
    recorded: DrivingScene, first: TrainingView, camera_height_m: float
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames 3"]]:
    """Place between the headlamps and heading of the car that recorded, frame by frame."""
    world_from_ego = recorded.world_from_ego.double()
    times = recorded.frame_timestamps_ns
    frame = int((times - first.timestamp_ns).abs().argmin())
    camera = first.camera.centre_world.double()
    rotation, origin = world_from_ego[frame, :3, :3], world_from_ego[frame, :3, 3]
    in_ego = rotation.T @ (camera - origin)
    in_ego[0] += HEADLAMP_AHEAD_M
    in_ego[1] = 0.0
    in_ego[2] += HEADLAMP_HEIGHT_M - camera_height_m
    position = world_from_ego[:, :3, :3] @ in_ego + world_from_ego[:, :3, 3]
    level = world_from_ego[:, :3, 0] * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    return position.float(), torch.nn.functional.normalize(level, dim=1).float()
