"""Refined poses and colours: what a fit corrects of cameras, actors and exposure as it runs."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lidarpainter_models.gaussians.fitting.config import FitConfig
from lidarpainter_models.gaussians.fitting.images import FitImage
from lidarpainter_models.gaussians.model.bending import knots_around
from lidarpainter_models.gaussians.model.gaussian_scene import GaussianScene

CAMERA_NOISE = {"rotation_rad": 2e-3, "translation_m": 0.03}
"""Expected error of a recorded camera pose."""
ACTOR_NOISE = {"rotation_rad": 0.03, "translation_m": 0.2}
"""Expected error of a box's pose."""
CAMERA_PRIOR = 1e-4
"""Weight of squared camera corrections in units of the expected noise."""
ACTOR_PRIOR = 1e-6
"""Weight of squared actor corrections, likewise: an actor fills a small part of the image."""
ACTOR_SMOOTHNESS = 1e-5
"""Weight of squared jumps between an actor's neighbouring corrections, likewise."""
LIGHT_PRIOR, LIGHT_SMOOTHNESS = 1e-5, 1e-4
"""Weights of squared logarithms of actors' gains, and of their jumps between knots."""
BEND_PRIOR = 3e-6
"""Weight of the squared strain of lattices (`Bending.strain`), likewise."""
BEND_NOISE_M = 0.1
"""Expected way of a node."""
BETAS = (0.9, 0.99)


class RowAdam:
    """Adam (Kingma and Ba, 2015) on a table whose rows have their own step sizes and counts.

    A row whose gradient is exactly zero is left alone: value, moments and count. A dense Adam would
    let a correction drift on momentum for the dozen steps until its view is drawn again.
    """

    def __init__(self, table: Tensor) -> None:
        """Start with empty moments; rows are the first dimension (or the first two, flattened)."""
        self.first = torch.zeros_like(table)
        self.second = torch.zeros_like(table)
        self.count = torch.zeros(table.shape[0], dtype=torch.int64, device=table.device)

    def step(
        self,
        table: Tensor,
        gradient: Tensor,
        rate: Float[Tensor, "columns"],
        rows: slice | None = None,
    ) -> None:
        """One step in place on the rows with a gradient; `rate` is per column.

        Whoever knows these rows names them: to look for them, the host waits for the device.
        """
        beta1, beta2 = BETAS
        found = gradient.abs().sum(dim=1).nonzero()[:, 0] if rows is None else rows
        if isinstance(found, Tensor) and not len(found):
            return
        g = gradient[found]
        self.count[found] += 1
        count = self.count[found, None].to(g.dtype)
        first = beta1 * self.first[found] + (1 - beta1) * g
        second = beta2 * self.second[found] + (1 - beta2) * g * g
        self.first[found], self.second[found] = first, second
        spread = (second / (1 - beta2**count)).sqrt() + 1e-15
        with torch.no_grad():
            table[found] -= rate * (first / (1 - beta1**count)) / spread

    def tensors(self) -> dict[str, Tensor]:
        """State to be kept in a checkpoint."""
        return {"first": self.first, "second": self.second, "count": self.count}

    def load(self, tensors: dict[str, Tensor]) -> None:
        """Take over kept state."""
        device = self.first.device
        self.first, self.second, self.count = (
            tensors[name].to(device, copy=True) for name in ("first", "second", "count")
        )


@dataclass(eq=False, kw_only=True)
class Refinement:
    """The corrections of a scene, which of them are refined at a step, and their optimisers."""

    scene: GaussianScene
    """Only its corrections are looked at, and they are those of every scene of the fit."""
    config: FitConfig
    adams: dict[str, RowAdam]

    @classmethod
    def begin(cls, scene: GaussianScene, config: FitConfig) -> "Refinement":
        """Let the corrections collect gradients."""
        adams = {
            "camera_adam": RowAdam(scene.cameras.view_tangent),
            "actor_adam": RowAdam(scene.actors.tangent.flatten(0, 1)),
            "light_adam": RowAdam(scene.actors.light.log_gain.flatten(1)),
            "bend_adam": RowAdam(scene.actors.bending.offset_m.flatten(1)),
            "exposure_adam": RowAdam(scene.exposure.matrix.flatten(1)),
            "gain_adam": RowAdam(scene.exposure.log_gain.view(-1, 1)),
        }
        refinement = cls(scene=scene, config=config, adams=adams)
        for table in refinement._tables():
            table.requires_grad_(True)
        return refinement

    def refines_cameras(self, step: int) -> bool:
        """Whether this step corrects the pose of its view."""
        settings = self.config.refinement
        return settings.cameras and step >= settings.start_step

    def refines_actors(self, step: int) -> bool:
        """Whether this step corrects the poses of the actors."""
        settings = self.config.refinement
        has_actors = bool(self.scene.actors.recorded_tracks)
        return settings.actors and has_actors and step >= settings.start_step

    @property
    def refines_exposure(self) -> bool:
        """One camera alone has no other to differ from."""
        return self.config.refinement.exposure or len(self.scene.exposure.camera_names) > 1

    def world_from_camera(self, row: int, step: int) -> Float[Tensor, "4 4"]:
        """A training view's pose, differentiable where it is refined."""
        pose = self.scene.cameras.world_from_camera(row)
        return pose if self.refines_cameras(step) else pose.detach()

    def exposure(self, image: FitImage) -> Float[Tensor, "3 4"] | None:
        """How the camera of an image exposes it, on its device; None leaves colours as they are."""
        if not self.refines_exposure:
            return None
        shown = self.scene.exposure.map_at(image.camera_name, image.timestamp_ns)
        return None if shown is None else shown.to(image.rgb_u8.device, non_blocking=True)

    def prior(self, row: int, timestamp_ns: int, step: int) -> Float[Tensor, ""]:
        """Corrections are small, and an actor's change little from one knot to the next."""
        tangent, actors = self.scene.cameras.tangent(row), self.scene.actors
        total = tangent.new_zeros(())
        if self.refines_cameras(step):
            total = total + CAMERA_PRIOR * pose_prior(tangent[None], **CAMERA_NOISE)
        if self.refines_actors(step):
            now = actors.tangent_at(timestamp_ns)
            total = total + ACTOR_PRIOR * pose_prior(now, **ACTOR_NOISE)
            for neighbour in actors.knots_beside(timestamp_ns):
                jump = now - actors.tangent[:, neighbour].detach()
                total = total + ACTOR_SMOOTHNESS * pose_prior(jump, **ACTOR_NOISE)
        return total

    def bend_prior(self, timestamp_ns: int, step: int) -> Float[Tensor, ""] | float:
        """Limbs stay near where they rest and near each other; lies where the Gaussians do."""
        if not (self.refines_actors(step) and self._bends):
            return 0.0
        return BEND_PRIOR / BEND_NOISE_M**2 * self.scene.actors.bending.strain(timestamp_ns)

    def light_prior(self, timestamp_ns: int) -> Float[Tensor, ""] | float:
        """Light changes little, and slowly; lies where the Gaussians do."""
        actors = self.scene.actors
        if not actors.recorded_tracks:
            return 0.0
        now = actors.light.log_gain_at(timestamp_ns)
        total = LIGHT_PRIOR * now.square().sum()
        for neighbour in actors.knots_beside(timestamp_ns):
            jump = now - actors.light.log_gain[neighbour].detach()
            total = total + LIGHT_SMOOTHNESS * jump.square().sum()
        return total

    def step(self, step: int, fraction: float, image: FitImage) -> None:
        """Move the corrections that are refined by the gradients they received; drop these.

        So many steps, a fraction of the fit, were made before this one of a recorded view.
        """
        if self.refines_cameras(step):
            table = self.scene.cameras.view_tangent
            self.adams["camera_adam"].step(table, _gradient(table), self._rate("camera", fraction))
            self.scene.cameras.recentre()
        if self.refines_actors(step):
            tangent = self.scene.actors.tangent
            with torch.no_grad():
                gradient = _gradient(tangent).view(-1, 6)
                rate = self._rate("actor", fraction)
                self.adams["actor_adam"].step(tangent.view(-1, 6), gradient, rate)
            if self._bends:
                self._step_bending(fraction, image)
        if self.scene.actors.recorded_tracks:
            self._step_light(fraction, image)
        if self.refines_exposure:
            self._step_exposure(fraction, image)
        for table in self._tables():
            table.grad = None

    @property
    def _bends(self) -> bool:
        return len(self.scene.actors.bending.bodies) > 0

    def _step_bending(self, fraction: float, image: FitImage) -> None:
        bending = self.scene.actors.bending
        near, _ = bending.weights_at(image.timestamp_ns)
        rate = self.config.learning_rates.at("bending_m", fraction)
        with torch.no_grad():
            table = bending.offset_m.view(len(bending.knots_ns), -1)
            gradient = _gradient(bending.offset_m).view(table.shape)
            self.adams["bend_adam"].step(table, gradient, table.new_full((1,), rate), near)

    def _step_light(self, fraction: float, image: FitImage) -> None:
        """Move the gains at the knots around an image; what all knots share is colour."""
        light = self.scene.actors.light
        before, after, _ = knots_around(light.knots_ns, image.timestamp_ns)
        rate = self.config.learning_rates.at("actor_light", fraction)
        with torch.no_grad():
            table, gradient = light.log_gain.flatten(1), _gradient(light.log_gain).flatten(1)
            rows = slice(before, after + 1)
            self.adams["light_adam"].step(table, gradient, table.new_full((1,), rate), rows)
            light.log_gain.sub_(light.log_gain.mean(dim=0))

    def _step_exposure(self, fraction: float, image: FitImage) -> None:
        exposure = self.scene.exposure
        names, matrix = exposure.camera_names, exposure.matrix
        row = names.index(image.camera_name)
        rate = self.config.learning_rates.at("exposure", fraction)
        self._step_gain(row, image.timestamp_ns, rate)
        if row == 0 and len(names) > 1:
            return  # the reference: all cameras together would be free to drift
        with torch.no_grad():
            self.adams["exposure_adam"].step(
                matrix.view(-1, 12),
                _gradient(matrix).flatten(1),
                matrix.new_full((12,), rate),
                slice(row, row + 1),
            )

    def _step_gain(self, row: int, timestamp_ns: int, rate: float) -> None:
        """Move a camera's gain at the knots around a time; what is common to all its knots stays.

        One knot has nothing to differ from.
        """
        log_gain = self.scene.exposure.log_gain
        before, after, _ = self.scene.exposure.neighbours(timestamp_ns)
        knots = log_gain.shape[1]
        with torch.no_grad():
            self.adams["gain_adam"].step(
                log_gain.view(-1, 1),
                _gradient(log_gain).view(-1, 1),
                log_gain.new_full((1,), rate),
                slice(row * knots + before, row * knots + after + 1),
            )
            log_gain[row] -= log_gain[row].mean()

    def _rate(self, kind: str, fraction: float) -> Float[Tensor, "6"]:
        """Step sizes of a tangent's columns."""
        rates = self.config.learning_rates
        rotation_rad = rates.at(f"{kind}_rotation_rad", fraction)
        translation_m = rates.at(f"{kind}_translation_m", fraction)
        return torch.tensor([rotation_rad] * 3 + [translation_m] * 3, dtype=torch.float64)

    def _tables(self) -> tuple[Tensor, ...]:
        scene, exposure = self.scene, self.scene.exposure
        return (
            scene.cameras.view_tangent,
            scene.actors.tangent,
            scene.actors.bending.offset_m,
            scene.actors.light.log_gain,
            exposure.matrix,
            exposure.log_gain,
        )


def pose_prior(
    tangents: Float[Tensor, "rows 6"], *, rotation_rad: float, translation_m: float
) -> Float[Tensor, ""]:
    """Sum of squared corrections in units of the noise that is expected."""
    unit = torch.tensor([rotation_rad] * 3 + [translation_m] * 3, dtype=tangents.dtype)
    return (tangents / unit).square().sum()


def _gradient(table: Tensor) -> Tensor:
    if table.grad is None:
        raise RuntimeError(f"no gradient reached a table of shape {tuple(table.shape)}")
    return table.grad
