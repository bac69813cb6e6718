"""A street so small that every command gets through it in seconds: two cameras that overlap."""

from functools import partial

from commands import settings, succeed

from lidarpainter_models.gaussians.lidar_returns.settings import LidarConfig
from lidarpainter_models.synthetic import RigCamera, RigLidar, SyntheticStreetConfig
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

SEED = 5
WIDTH_PX, HEIGHT_PX, NUM_FRAMES = 96, 54, 6
FRONT, SIDE = "front_camera", "side_camera"
SIDE_GAIN = 0.9
SCENE = f"synthetic/street-{SEED:04d}"
SETTINGS = (
    f"train_cameras={FRONT}",
    f"observation.width_px={WIDTH_PX}",
    "rounds=1",
    'scoring.shifts=[{"lateral_m": 2}, {"up_m": 1.5}]',
    "novel.every_nth=2",
    "fit.steps=40",
    "fit.refinement.start_step=20",  # rounds hold the cameras where this leaves them
    "fit.log_every=20",
    "fit.initialisation.num_gaussians=1500",
    "fit.densification.budget=2000",
    "refine.steps=10",
    "refine.densification.budget=2000",
)
"""The preview preset, shrunk; the side camera is kept to judge by."""
QUICK_LIDAR = partial(
    LidarConfig, num_surfels=5000, steps=20, rays_per_step=2048, rays_per_sweep=4000, hits=12
)
"""In place of `LidarConfig`: what a LiDAR sees of the street is learnt in a second."""
TINY = ("--preset", "brief", *settings(*SETTINGS))


def tiny_street(seed=SEED, **changes):
    """What is driven and with which sensors."""
    side = RigCamera(name=SIDE, focal_per_width=0.8, yaw_rad=-0.35, left_m=-0.5, gain=SIDE_GAIN)
    chosen = {
        "seed": seed,
        "num_frames": NUM_FRAMES,
        "width_px": WIDTH_PX,
        "height_px": HEIGHT_PX,
        "samples_per_axis": 1,
        "cameras": (DEFAULT_CAMERAS[0], side),
        "lidar": RigLidar(beams=32, columns=720),
    }
    return SyntheticStreetConfig(**(chosen | changes))


def swept_street(seed, num_frames):
    """One small camera, and a LiDAR whose sweeps are what matters."""
    return SyntheticStreetConfig(
        seed=seed,
        num_frames=num_frames,
        width_px=64,
        height_px=36,
        cameras=DEFAULT_CAMERAS[:1],
        lidar=RigLidar(columns=900),
    )


def reconstructed(tiny_run, *words):
    """`reconstruct` of the tiny street, with other words behind."""
    return succeed("reconstruct", SCENE, *TINY, *words, store=tiny_run.store)
