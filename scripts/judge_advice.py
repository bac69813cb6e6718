"""Whether the doctor's advice about cameras gains: it is followed, and views set aside judge it.

    python scripts/judge_advice.py FOLDER [--seeds 411,412]

Streets are spoilt by the clock, the yaw, the focal length and the readout of a camera, at the
levels of the stress sweep. Where the doctor names a fault, the log is fitted as it is and with
`observation.corrects_cameras=true`, and both are judged on held-out frames. Prints a table, and
exits with 1 if advice that was followed lost more than `LOSS_DB`.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import lidarpainter_models as lp
from lidarpainter_models.gaussians.fitting.config import EffortConfig
from lidarpainter_models.lidar.spatiotemporal_calibration import find_faults
from lidarpainter_models.observations.own_body import own_bodies
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.frame_content import FrameContent
from lidarpainter_models.scenes.rewriting import header_of, write_anew
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.stress.causes import cause_of
from lidarpainter_models.stress.spoiling import spoilt_name, write_spoilt
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS

FRONT = DEFAULT_CAMERAS[0]
READOUTS_MS = (10.0, 20.0, 30.0, 40.0)
CAUSES = ("clock", "camera-yaw", "focal-length")
WIDTH_PX, LOOKS = 320, 100.0
LOSS_DB = 0.05  # two fits that differ in their seed alone differ by as much


def main() -> int:
    """Judge all levels on each street."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", default="411,412", help="streets, by their seeds")
    given = parser.parse_args()
    worst_db = 0.0
    for seed in map(int, given.seeds.split(",")):
        for words, scene in _logs(given.folder, seed):
            gain_db = _judged(f"street {seed}, {words}", scene)
            worst_db = min(worst_db, gain_db)
    sys.stdout.write(f"worst gain of advice that was followed: {worst_db:+.2f} dB\n")
    return 1 if worst_db < -LOSS_DB else 0


def _logs(folder: Path, seed: int) -> Iterator[tuple[str, DrivingScene]]:
    """A street as it is, and with each fault at each level."""
    config = lp.SyntheticStreetConfig(
        seed=seed, num_frames=20, width_px=480, height_px=270, cameras=(FRONT,)
    )
    sound = _street(folder / "sound", config)
    yield "as it is", sound
    for cause in CAUSES:
        for level in cause_of(cause).levels:
            made = folder / "scenes" / "stress" / spoilt_name(sound, cause, level)
            path = made if made.is_dir() else write_spoilt(sound, cause, level, folder)
            yield f"{cause} {level:g} {cause_of(cause).unit}", lp.open_scene(path)
    for readout_ms in READOUTS_MS:
        camera = replace(FRONT, readout_s=readout_ms / 1000)
        drawn = _street(folder / f"readout-{readout_ms:g}", replace(config, cameras=(camera,)))
        yield f"readout {readout_ms:g} ms", _untold(drawn, folder, f"readout-{readout_ms:g}")


def _street(folder: Path, config: lp.SyntheticStreetConfig) -> DrivingScene:
    folder = folder / str(config.seed)
    found = sorted(folder.glob("scenes/*/*/manifest.json"))
    return lp.open_scene(found[0].parent if found else lp.write_street(config, folder))


def _untold(scene: DrivingScene, store: Path, name: str) -> DrivingScene:
    """The same log, with nothing said of how its cameras read their rows."""
    path = store / "scenes" / scene.dataset / f"{name}-{scene.sequence}"
    if not path.is_dir():
        write_anew(scene, store, path.name, header_of(scene, {}), _without_shutters, {})
    return lp.open_scene(path)


def _without_shutters(content: FrameContent) -> FrameContent:
    records = (replace(image.record, rolling_shutter=None) for image in content.images)
    pairs = zip(content.images, records, strict=True)
    return replace(content, images=[replace(image, record=record) for image, record in pairs])


def _judged(words: str, scene: DrivingScene) -> float:
    """What following the advice gains in dB; 0 where none is given."""
    faults = find_faults(scene, scene.views, own_bodies(scene, scene.views))
    if not faults:
        sys.stdout.write(f"{words}: no advice\n")
        sys.stdout.flush()
        return 0.0
    plain_db, corrected_db = (_held_out_db(scene, corrects=corrects) for corrects in (False, True))
    said = "; ".join(f"{name} {fault}" for name, fault in faults.items())
    sys.stdout.write(f"{words}: {said}: {plain_db:.2f} -> {corrected_db:.2f} dB\n")
    sys.stdout.flush()
    return corrected_db - plain_db


def _held_out_db(scene: DrivingScene, *, corrects: bool) -> float:
    split = split_views(scene, "alternate")
    size = lp.ObservationConfig(width_px=WIDTH_PX, corrects_cameras=corrects)
    config = lp.FitConfig(effort=EffortConfig(looks=LOOKS, gaussians_per_pixel=0.2))
    fitted = lp.fit_gaussians(lp.prepare_observations(scene, split, size), config).scene
    return float(lp.evaluate(fitted, scene, split, size, shifts=())["recorded"]["psnr"])


if __name__ == "__main__":
    sys.exit(main())
