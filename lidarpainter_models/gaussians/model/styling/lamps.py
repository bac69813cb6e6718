"""Lamps of a scene at a time: street lamps and windows that stand, and lamps of cars that move.

Every moving actor as long as a car has dipped headlamps and tail lamps, at the places on its box
where cars have them; so has the car that recorded. They go where their box goes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.model.actors import Actors
from lidarpainter_models.gaussians.model.bending import knots_around
from lidarpainter_models.gaussians.model.styling.scene_style import LampChange, StyledPlace
from lidarpainter_models.kernels.scene_light import Lamps
from lidarpainter_models.weather.darkness import (
    BEAM,
    BEAM_RGB,
    HEADLAMP_HEIGHT_M,
    WARM_RGB,
    WINDOW_POWER,
)

BEAM_REACH_M = 45.0
LAMP_REACH_M = 25.0
WINDOW_REACH_M = 8.0
LEAST_CAR_M = 3.0
"""Shorter moving actors have no lamps."""
TAIL_HEIGHT_M = 0.85
INSET_M = 0.25
"""Of a car's lamps from its sides."""
HEADLAMP_RADIANCE, TAIL_RADIANCE = 150.0, 12.0
HEADLAMP_RADIUS_M, TAIL_RADIUS_M, LAMP_RADIUS_M = 0.08, 0.07, 0.12
TAIL_RGB = (1.0, 0.06, 0.03)
BRAKE = 15.0
"""Brake lamps against tail lamps: 60 to 185 cd and 4 to 12 cd (UN Regulation 7)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class LampHeads:
    """What shines into a camera."""

    position_world: Float[Tensor, "heads 3"]
    heading_world: Float[Tensor, "heads 3"]
    """Zero for one that shines all round."""
    radiance_rgb: Float[Tensor, "heads 3"]
    radius_m: Float[Tensor, " heads"]


@dataclass(frozen=True, kw_only=True, eq=False)
class CarLamps:
    """Lamps of the moving cars in the frames of their boxes."""

    actor: Tensor
    """Position among the actors of each car; int64."""
    forward: Float[Tensor, " cars"]
    """1, or -1 for a box that drives backwards."""
    size_m: Float[Tensor, "cars 3"]
    changes: tuple[tuple[LampChange, ...], ...]
    """What was switched of each car's lamps."""

    @classmethod
    def of(cls, actors: Actors, changes: Sequence[LampChange] = ()) -> "CarLamps":
        """Those of actors that move and are as long as a car, and of whom changes speak of."""
        cars, forward, sizes, own = [], [], [], []
        for number, track in enumerate(actors.recorded_tracks):
            told = tuple(change for change in changes if change.actor_id == track.actor_id)
            if not told and (not track.is_moving or float(track.size_m[0]) < LEAST_CAR_M):
                continue
            own.append(told)
            path = track.world_from_box[-1, :3, 3] - track.world_from_box[0, :3, 3]
            middle = track.world_from_box[len(track.world_from_box) // 2, :3, 0]
            cars.append(number)
            forward.append(-1.0 if float(path @ middle) < 0 else 1.0)
            sizes.append(track.size_m.double())
        return cls(
            actor=torch.tensor(cars, dtype=torch.int64),
            forward=torch.tensor(forward, dtype=torch.float64),
            size_m=torch.stack(sizes) if sizes else torch.zeros(0, 3, dtype=torch.float64),
            changes=tuple(own),
        )

    def brightness(self, timestamp_ns: int) -> Float[Tensor, "cars 2"]:
        """How bright headlamps and tail lamps are at a time: 0 off, 1 on."""
        shining = {"off": (0.0, 0.0), "on": (1.0, 1.0), "brake": (1.0, BRAKE)}
        told = [
            [one.state for one in own if one.first_ns <= timestamp_ns <= one.last_ns]
            for own in self.changes
        ]
        rows = [shining[states[-1] if states else "on"] for states in told]
        return torch.tensor(rows, dtype=torch.float64).reshape(-1, 2)

    def _corners(self, ahead: float, height_m: float) -> Float[Tensor, "cars 2 3"]:
        """Left and right place at one end of each box, at a height above its floor."""
        length, width, height = self.size_m.unbind(1)
        x = 0.5 * ahead * self.forward * length
        z = torch.minimum(height_m - 0.5 * height, 0.4 * height)
        aside = (0.5 * width - INSET_M).clamp_min(0.2)
        return torch.stack([torch.stack([x, side * aside, z], dim=1) for side in (1, -1)], dim=1)

    def beams(self, world_from_actor: Float[Tensor, "actors 4 4"]) -> tuple[Tensor, Tensor]:
        """Place between the headlamps and level heading of each car."""
        poses = world_from_actor[self.actor]
        middle = self._corners(1, HEADLAMP_HEIGHT_M).mean(dim=1)
        position = torch.einsum("cij,cj->ci", poses[:, :3, :3], middle) + poses[:, :3, 3]
        return position, _level(poses[:, :3, 0] * self.forward[:, None])

    def heads(self, world_from_actor: Float[Tensor, "actors 4 4"], like: Tensor) -> LampHeads:
        """Two headlamps and two tail lamps of each car."""
        poses = world_from_actor[self.actor]
        ends = torch.cat([self._corners(1, HEADLAMP_HEIGHT_M), self._corners(-1, TAIL_HEIGHT_M)], 1)
        position = torch.einsum("cij,ckj->cki", poses[:, :3, :3], ends) + poses[:, None, :3, 3]
        heading = _level(poses[:, :3, 0] * self.forward[:, None])
        signs = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=heading.dtype)
        rgb = like.new_tensor([BEAM_RGB, BEAM_RGB, TAIL_RGB, TAIL_RGB])
        radiance = like.new_tensor([HEADLAMP_RADIANCE] * 2 + [TAIL_RADIANCE] * 2)
        radius = like.new_tensor([HEADLAMP_RADIUS_M] * 2 + [TAIL_RADIUS_M] * 2)
        cars = len(self.actor)
        return LampHeads(
            position_world=position.reshape(-1, 3).to(like),
            heading_world=(signs[:, None] * heading[:, None]).reshape(-1, 3).to(like),
            radiance_rgb=(radiance[:, None] * rgb).repeat(cars, 1),
            radius_m=radius.repeat(cars),
        )


def fixed_lamps(place: StyledPlace) -> Lamps:
    """Street lamps, signals and lit windows."""
    like = place.lamp_rgb
    warm = like.new_tensor(WARM_RGB).expand(len(place.window_centre), 3)
    power = torch.cat([place.lamp_power[:, None] * place.lamp_rgb, WINDOW_POWER * warm])
    reach = [(place.lamp_position, LAMP_REACH_M), (place.window_centre, WINDOW_REACH_M)]
    position = torch.cat([place.lamp_position, place.window_centre])
    return Lamps(
        position_world=position,
        heading_world=torch.zeros_like(position),
        power_rgb=power,
        reach_m=torch.cat([like.new_full((len(found),), far_m) for found, far_m in reach]),
        is_fixed=torch.ones(len(position), dtype=torch.bool, device=position.device),
    )


def no_lamps(place: StyledPlace) -> Lamps:
    """No lamps, as by day."""
    nothing = place.lamp_rgb.new_zeros(0, 3)
    return Lamps(
        position_world=nothing,
        heading_world=nothing,
        power_rgb=nothing,
        reach_m=nothing[:, 0],
        is_fixed=nothing[:, 0].bool(),
    )


def lamps_at(
    place: StyledPlace,
    fixed: Lamps,
    cars: CarLamps,
    world_from_actor: Float[Tensor, "actors 4 4"],
    present: Float[Tensor, " actors"],
    timestamp_ns: int,
) -> Lamps:
    """All lamps that light anything at a time; fixed ones are those already in the street."""
    like = fixed.position_world
    position, heading = cars.beams(world_from_actor)
    is_here = (present[cars.actor] > 0) & (cars.brightness(timestamp_ns)[:, 0] > 0)
    ego_position, ego_heading = ego_beam(place, timestamp_ns)
    positions = torch.cat([position[is_here].to(like), ego_position[None].to(like)])
    headings = torch.cat([heading[is_here].to(like), ego_heading[None].to(like)])
    power = 2 * BEAM * like.new_tensor(BEAM_RGB)  # both headlamps from the middle between them
    count = len(positions)
    return Lamps(
        position_world=torch.cat([fixed.position_world, positions]),
        heading_world=torch.cat([fixed.heading_world, headings]),
        power_rgb=torch.cat([fixed.power_rgb, power.expand(count, 3)]),
        reach_m=torch.cat([fixed.reach_m, like.new_full((count,), BEAM_REACH_M)]),
        is_fixed=torch.cat([fixed.is_fixed, fixed.is_fixed.new_zeros(count)]),
    )


def heads_at(
    place: StyledPlace,
    cars: CarLamps,
    world_from_actor: Float[Tensor, "actors 4 4"],
    present: Float[Tensor, " actors"],
    timestamp_ns: int,
) -> LampHeads:
    """All lamps that may shine into a camera; those of the car that recorded are never seen."""
    like = place.lamp_rgb
    of_cars = cars.heads(world_from_actor, like)
    bright = cars.brightness(timestamp_ns).repeat_interleave(2, dim=1).flatten().to(like)
    is_here = (present[cars.actor] > 0).repeat_interleave(4).to(like.device) & (bright > 0)
    radiance = of_cars.radiance_rgb * bright[:, None]
    standing = len(place.lamp_position)
    return LampHeads(
        position_world=torch.cat([place.lamp_position, of_cars.position_world[is_here]]),
        heading_world=torch.cat(
            [torch.zeros_like(place.lamp_position), of_cars.heading_world[is_here]]
        ),
        radiance_rgb=torch.cat([place.lamp_radiance[:, None] * place.lamp_rgb, radiance[is_here]]),
        radius_m=torch.cat([like.new_full((standing,), LAMP_RADIUS_M), of_cars.radius_m[is_here]]),
    )


def ego_beam(
    place: StyledPlace, timestamp_ns: int
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Place between the headlamps and heading of the car that recorded, at a time."""
    before, after, weight = knots_around(place.ego_times_ns, timestamp_ns)
    position = torch.lerp(place.ego_lamp[before], place.ego_lamp[after], weight)
    heading = torch.lerp(place.ego_heading[before], place.ego_heading[after], weight)
    return position, _level(heading[None])[0]


def _level(heading: Float[Tensor, "cars 3"]) -> Float[Tensor, "cars 3"]:
    flat = heading * heading.new_tensor([1.0, 1.0, 0.0])
    return torch.nn.functional.normalize(flat, dim=-1)
