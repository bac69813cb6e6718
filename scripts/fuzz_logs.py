"""Random combinations of odd boxes, masked images, lenses, paths, proxies and home folders.

    python scripts/fuzz_logs.py FOLDER [--combinations 2000] [--seed 0]

A tiny street is written anew with odd boxes, images and lenses, looked at by the doctor, fitted and
judged on the frames held out; and the command is run where a path, a proxy or a home folder is odd.
What many combinations share is done once. Three things must never happen: an error that is not one
of ours, a figure that is not a number, and a loss beside the same log without odd boxes and images
that the doctor did not name. They are printed, and the exit code says whether there were any.
"""

import argparse
import math
import os
import random
import subprocess
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import torch

import lidarpainter_models as lp
from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.gaussians.fitting.config import EffortConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.records import BoxRecord, Distortion
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.scenes.writer import SceneHeader, SceneWriter
from lidarpainter_models.stress.frames import Frame, Shot, read_frame
from lidarpainter_models.stress.spoiling import write_frame
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS
from tasks.ingest.data_checks import findings_about

STREET = lp.SyntheticStreetConfig(
    seed=11, num_frames=10, width_px=96, height_px=54, cameras=DEFAULT_CAMERAS[:1]
)
LOOKS = 40.0
LOSS_DB = 0.5
LENSES_PER_SEED = 8

Change = Callable[[Frame], Frame]


def main(words: Sequence[str] | None = None) -> int:
    """Run the combinations, say what went wrong, and return 1 if anything did."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--combinations", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(words)
    fuzz = Fuzz(given.folder, random.Random(given.seed))  # noqa: S311 no secret
    if sound := fuzz.refusal_of_the_sound_log():
        sys.exit(f"the sound log is refused, so nothing can be held against it: {sound}")
    for number in range(given.combinations):
        for fault in fuzz.faults_of_one():
            sys.stdout.write(f"{number}: {fault}\n")
        if number % 50 == 49:
            sys.stdout.write(f"{fuzz.said(number + 1)}\n")
            sys.stdout.flush()
    sys.stdout.write(f"{fuzz.said(given.combinations)}\n")
    return 1 if fuzz.num_faults else 0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of one log."""

    refusal: str = ""
    fault: str = ""
    """What must not happen."""
    psnr: float = math.nan
    doubts: frozenset[str] = frozenset()
    """Names of the checks that did not say ok, or that they did not look."""


@dataclass
class Fuzz:
    """Draws combinations, and keeps what came of each log and each place."""

    folder: Path
    dice: random.Random
    logs: dict[tuple[str, str, str], Outcome] = field(default_factory=dict)
    places: dict[tuple[str, str, str], Outcome] = field(default_factory=dict)
    reconstructed: set[str] = field(default_factory=set)
    """Paths, proxies and homes with which a scene was made; it takes ten times an ingest."""
    num_faults: int = 0
    num_losses_named: int = 0

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.lenses = {"plain": LENS_AS_IT_IS} | {
            f"lens-{number}": _random_lens(self.dice) for number in range(LENSES_PER_SEED)
        }

    def faults_of_one(self) -> list[str]:
        """The next combination's faults, each new one once."""
        boxes, images = _drawn(self.dice, BOXES), _drawn(self.dice, IMAGES)
        lens = _drawn(self.dice, self.lenses)
        place = _drawn(self.dice, PATHS), _drawn(self.dice, PROXIES), _drawn(self.dice, HOMES)
        found = []
        if (boxes, images, lens) not in self.logs:
            outcome = self._log(boxes, images, lens)
            found += self._found(f"boxes {boxes}, images {images}, {lens}", outcome)
            found += self._silent_loss(boxes, images, lens, outcome)
        if place not in self.places:
            self.places[place] = self._place(*place)
            found += self._found("path {}, proxy {}, home {}".format(*place), self.places[place])
        self.num_faults += len(found)
        return found

    def refusal_of_the_sound_log(self) -> str:
        """Why the log without anything odd is refused; empty if it is not."""
        sound = self._log("plain", "plain", "plain")
        return sound.refusal or sound.fault

    def said(self, count: int) -> str:
        """How many of what there was."""
        everything = [*self.logs.values(), *self.places.values()]
        refused = sum(bool(one.refusal) for one in everything)
        return (
            f"{count} combinations: {len(self.logs)} logs, {len(self.places)} places, {refused} "
            f"refused in one line, {self.num_losses_named} losses that the doctor named, "
            f"{self.num_faults} faults"
        )

    @staticmethod
    def _found(what: str, outcome: Outcome) -> list[str]:
        return [f"{what}: {outcome.fault}"] if outcome.fault else []

    def _silent_loss(self, boxes: str, images: str, lens: str, outcome: Outcome) -> list[str]:
        plain = self._log("plain", "plain", lens)
        loss_db = plain.psnr - outcome.psnr
        if not loss_db > LOSS_DB:  # a log that was refused has none
            return []
        named = outcome.doubts - plain.doubts
        self.num_losses_named += bool(named)
        what = f"boxes {boxes}, images {images}, {lens}: {plain.psnr:.2f} -> {outcome.psnr:.2f} dB"
        return [] if named else [f"{what}, and the doctor says nothing of it"]

    def _log(self, boxes: str, images: str, lens: str) -> Outcome:
        key = boxes, images, lens
        if key not in self.logs:
            changes = BOXES[boxes], IMAGES[images], self.lenses[lens]
            self.logs[key] = self._tried(f"log-{len(self.logs)}", changes)
        return self.logs[key]

    def _tried(self, name: str, changes: Sequence[Change]) -> Outcome:
        try:
            with np.errstate(all="ignore"):
                written = _rewritten(self.street, self.folder / "logs", name, changes)
                return _fitted(lp.open_scene(written))
        except LidarPainterError as error:
            return Outcome(refusal=str(error))
        except Exception:  # noqa: BLE001 what else is raised is what is looked for
            return Outcome(fault=traceback.format_exc(limit=-3).replace("\n", " | "))

    def _place(self, path: str, proxy: str, home: str) -> Outcome:
        """What the command says of the street at an odd path, behind a proxy, without a home."""
        root = self.folder / "places" / str(len(self.places))
        root.mkdir(parents=True, exist_ok=True)
        environment = {**os.environ, **PROXIES[proxy]}
        for variable, value in HOMES[home](root).items():
            environment.pop(variable, None)
            if value is not None:
                environment[variable] = value
        store = root / PATHS[path]
        name = f"{self.street.path.parent.name}/{self.street.path.name}"
        root_and_name = str(self.street.path.parent), self.street.path.name
        commands: list[tuple[str, ...]] = [("ingest", "canonical", *root_and_name)]
        if not {path, proxy, home} <= self.reconstructed:
            commands += [("doctor", name), ("reconstruct", name, *TINY)]
            self.reconstructed |= {path, proxy, home}
        outcomes = [
            _command(environment, root, "--store", str(store), *words) for words in commands
        ]
        first = next((one for one in outcomes if one.fault or one.refusal), Outcome())
        if first.fault or not first.refusal:
            return first
        left = [one for one in (store, store.parent) if one != root and one.is_dir()]
        is_half = any(one.name == "manifest.json" for folder in left for one in folder.rglob("*"))
        is_first = outcomes[0].refusal == first.refusal
        return replace(first, fault="refused, but written") if is_half and is_first else first

    @cached_property
    def street(self) -> DrivingScene:
        """The sound log."""
        folder = self.folder / "street"
        found = sorted(folder.glob("scenes/*/*/manifest.json"))
        return lp.open_scene(found[0].parent if found else lp.write_street(STREET, folder))


TINY = ("--preset", "brief", "--painter", "none", "--rounds", "0", "--set", "fit.steps=5")


def _command(environment: Mapping[str, str], folder: Path, *words: str) -> Outcome:
    command = [sys.executable, "-m", "flows.cli", *words]
    root = Path(__file__).resolve().parents[1]
    path = os.pathsep.join([str(root), environment.get("PYTHONPATH", "")])
    ended = subprocess.run(  # noqa: S603 our own command
        command,
        env={**environment, "PYTHONPATH": path},
        cwd=folder,
        capture_output=True,
        check=False,
    )
    said = ended.stderr.decode(errors="replace")
    if "Traceback" in said or "unexpected" in said or ended.returncode not in (0, 1, 2):
        return Outcome(fault=f"{words[2]} ended with {ended.returncode}: {said[-300:]!r}")
    if ended.returncode == 2:
        return Outcome(refusal=said.strip().splitlines()[-1] if said.strip() else "(silence)")
    return Outcome()


def _fitted(scene: DrivingScene) -> Outcome:
    findings = findings_about(scene)
    doubts = {found.name for found in findings if found.verdict != "ok"}
    doubts |= {f"{found.name}: not checked" for found in findings if "not checked" in found.detail}
    split = split_views(scene, "alternate")
    size = lp.ObservationConfig(width_px=STREET.width_px)
    config = lp.FitConfig(effort=EffortConfig(looks=LOOKS, gaussians_per_pixel=0.2))
    fitted = lp.fit_gaussians(lp.prepare_observations(scene, split, size), config).scene
    psnr = lp.evaluate(fitted, scene, split, size, shifts=())["recorded"]["psnr"]
    return Outcome(
        psnr=psnr,
        doubts=frozenset(doubts),
        fault="" if math.isfinite(psnr) else f"held-out PSNR is {psnr}",
    )


def _rewritten(scene: DrivingScene, store: Path, name: str, changes: Sequence[Change]) -> Path:
    header = SceneHeader(
        licence="CC0",
        global_from_world=scene.global_from_world,
        semantic_classes=scene.semantic_classes,
    )
    with SceneWriter(store, "fuzz", name, header) as writer:
        for frame_index in scene.frame_indices:
            frame = read_frame(scene, frame_index)
            for change in changes:
                frame = change(frame)
            write_frame(writer, frame)
    return writer.path


def _drawn(dice: random.Random, table: Mapping[str, object]) -> str:
    """One name of a table; every third time the first, which is nothing odd."""
    names = list(table)
    return names[0] if dice.random() < 1 / 3 else dice.choice(names)


# --- boxes


def _with_boxes(change: Callable[[Frame, BoxRecord], list[BoxRecord]]) -> Change:
    """Each box becomes those that a function makes of it."""
    return lambda frame: replace(
        frame, boxes=tuple(new for box in frame.boxes for new in change(frame, box))
    )


def _own_box(size_m: tuple[float, float, float]) -> Change:
    """The recording car among the actors, as CARLA lists it."""

    def added(frame: Frame) -> Frame:
        place = frame.world_from_ego.clone()
        place[:3, 3] += 0.5 * size_m[2] * place[:3, 2] + 0.5 * place[:3, 0]
        box = BoxRecord(
            actor_id="ego",
            category="vehicle.car",
            timestamp_ns=frame.timestamp_ns,
            world_from_box=place,
            size_m=size_m,
            is_moving=True,
            num_points=0,
        )
        return replace(frame, boxes=(*frame.boxes, box))

    return added


def _moved(frame: Frame, box: BoxRecord, forward_m: float) -> BoxRecord:
    place = box.world_from_box.clone()
    place[:3, 3] += forward_m * frame.world_from_ego[:3, 0]
    return replace(box, world_from_box=place)


def _turned(box: BoxRecord, turn: Sequence[Sequence[float]]) -> BoxRecord:
    place = box.world_from_box.clone()
    place[:3, :3] = place[:3, :3] @ torch.tensor(turn, dtype=place.dtype)
    return replace(box, world_from_box=place)


def _spoilt(box: BoxRecord, value: float) -> BoxRecord:
    place = box.world_from_box.clone()
    place[0, 3] = value
    return replace(box, world_from_box=place)


BOXES: dict[str, Change] = {
    "plain": lambda frame: frame,
    "own-car": _own_box((4.8, 2.0, 1.7)),
    "own-car-large": _own_box((7.0, 3.0, 2.6)),
    "none": _with_boxes(lambda _frame, _box: []),
    "twice": _with_boxes(lambda _frame, box: [box, box]),
    "same-time": _with_boxes(
        lambda frame, box: [replace(box, timestamp_ns=frame.timestamp_ns - frame.position % 2)]
    ),
    "time-stands": _with_boxes(
        lambda _frame, box: [replace(box, timestamp_ns=box.timestamp_ns // 10**9 * 10**9)]
    ),
    "away-and-back": _with_boxes(lambda frame, box: [] if 3 <= frame.position <= 6 else [box]),
    "new-ids": _with_boxes(
        lambda frame, box: [replace(box, actor_id=f"{box.actor_id}-{frame.frame_index}")]
    ),
    "one-id": _with_boxes(lambda _frame, box: [replace(box, actor_id="one")]),
    "odd-names": _with_boxes(
        lambda _frame, box: [
            replace(box, actor_id=f"../{box.actor_id}\n%2Fé", category="Fahrzeug/Pkw é")
        ]
    ),
    "flat": _with_boxes(lambda _frame, box: [replace(box, size_m=(*box.size_m[:2], 0.0))]),
    "huge": _with_boxes(lambda _frame, box: [replace(box, size_m=(90.0, 60.0, 30.0))]),
    "negative": _with_boxes(lambda _frame, box: [replace(box, size_m=(-4.0, 2.0, 1.5))]),
    "not-a-number": _with_boxes(lambda _frame, box: [_spoilt(box, math.nan)]),
    "endless": _with_boxes(lambda _frame, box: [_spoilt(box, math.inf)]),
    "far": _with_boxes(lambda frame, box: [_moved(frame, box, 1e7)]),
    "beside": _with_boxes(lambda frame, box: [_moved(frame, box, 4.0)]),
    "backwards": _with_boxes(
        lambda _frame, box: [_turned(box, ((-1, 0, 0), (0, -1, 0), (0, 0, 1)))]
    ),
    "mirrored": _with_boxes(lambda _frame, box: [_turned(box, ((1, 0, 0), (0, -1, 0), (0, 0, 1)))]),
    "all-stand": _with_boxes(lambda _frame, box: [replace(box, is_moving=False)]),
    "all-move": _with_boxes(lambda _frame, box: [replace(box, is_moving=True)]),
}
"""Odd boxes by name."""


# --- images


def _with_images(change: Callable[[np.ndarray, Frame], np.ndarray]) -> Change:
    """Pixels of each image changed in place or anew."""
    return lambda frame: replace(
        frame,
        shots=tuple(shot.with_pixels(lambda bgr: change(bgr, frame)) for shot in frame.shots),
    )


def _covered(colour: float, low: float, left: float, right: float) -> Change:
    """Something that stays in place from `low` (share of the height) down, between two sides."""

    def cover(bgr: np.ndarray, _frame: Frame) -> np.ndarray:
        height, width = bgr.shape[:2]
        bgr[int(low * height) :, int(left * width) : int(right * width)] = colour
        return bgr

    return _with_images(cover)


def _framed(bgr: np.ndarray, _frame: Frame) -> np.ndarray:
    bgr[:4] = bgr[-4:] = bgr[:, :4] = bgr[:, -4:] = 0
    return bgr


IMAGES: dict[str, Change] = {
    "plain": lambda frame: frame,
    "bonnet-dark": _covered(20, 0.78, 0.0, 1.0),
    "bonnet-bright": _covered(200, 0.8, 0.0, 1.0),
    "mirror": _covered(15, 0.55, 0.0, 0.25),
    "black-border": _with_images(_framed),
    "black": _with_images(lambda bgr, _frame: 0 * bgr),
    "white": _with_images(lambda bgr, _frame: 0 * bgr + 255),
    "one-black": _with_images(lambda bgr, frame: bgr * (frame.position != 4)),
    "grey": _with_images(lambda bgr, _frame: bgr.mean(axis=2, keepdims=True).repeat(3, axis=2)),
    "upside-down": _with_images(lambda bgr, _frame: bgr[::-1, ::-1]),
}
"""Odd images by name."""


# --- lenses


def LENS_AS_IT_IS(frame: Frame) -> Frame:  # noqa: N802 a change like the constants beside it
    """The pinhole of the street."""
    return frame


def _random_lens(dice: random.Random) -> Change:
    """A lens of any model and any strength, and the images as it would have taken them."""
    model = dice.choice(("brown", "fisheye", "mei"))
    strength = 10 ** dice.uniform(-3, 0.5)
    terms = [dice.gauss(0, strength) * 0.3**place for place in range(4)]
    if model == "brown":
        terms[2:] = [0.01 * term for term in terms[2:]]
    if model == "mei":
        terms = [dice.uniform(0.2, 2.2), *terms[:2], 0.001 * terms[2], 0.001 * terms[3]]
    zoom = dice.choice((0.2, 0.5, 0.8, 1.0, 1.3)) * (1 + terms[0] if model == "mei" else 1)
    distortion = Distortion(model, tuple(terms))
    return lambda frame: replace(
        frame, shots=tuple(_through(shot, distortion, zoom) for shot in frame.shots)
    )


def _through(shot: Shot, distortion: Distortion, zoom: float) -> Shot:
    pinhole = shot.record.camera
    lens = replace(pinhole, fx_px=zoom * pinhole.fx_px, fy_px=zoom * pinhole.fy_px)
    matrix = np.array(
        [[lens.fx_px, 0, lens.cx_px - 0.5], [0, lens.fy_px, lens.cy_px - 0.5], [0, 0, 1.0]]
    )
    grid = np.indices((lens.height_px, lens.width_px)).transpose(1, 2, 0)[..., ::-1]
    pixels, terms = grid.reshape(-1, 1, 2).astype(np.float64), np.array(distortion.terms)
    if distortion.model == "brown":
        rays = cv2.undistortPoints(pixels, matrix, terms)
    elif distortion.model == "fisheye":
        rays = cv2.fisheye.undistortPoints(pixels, matrix, terms)
    else:
        rays = cv2.omnidir.undistortPoints(pixels, matrix, terms[1:], terms[:1], np.eye(3))
    scale = np.array([pinhole.fx_px, pinhole.fy_px])
    centre = np.array([pinhole.cx_px - 0.5, pinhole.cy_px - 0.5])
    places = (np.nan_to_num(rays) * scale + centre).clip(-1e4, 1e4).astype(np.float32)
    places = places.reshape(lens.height_px, lens.width_px, 2)
    seen = shot.with_pixels(
        lambda bgr: cv2.remap(
            bgr, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    )
    return replace(seen, record=replace(seen.record, camera=lens, distortion=distortion))


# --- places

PATHS = {
    "plain": "store",
    "spaces": "a store of mine",
    "beyond-ascii": "Straße é 街",
    "percent": "100%",
    "escape": "a%2Fb",
    "tab": "a\tb",
    "newline": "a\nb",
    "hash": "a#b?c=d",
    "quotes": 'it\'s "mine"',
    "dash": "-store",
    "long": "s" * 200,
    "too-long": "s" * 300,
    "deep": "/".join(["deep"] * 40),
    "dots": "a/../b",
    "star": "*[a]",
}
PROXIES: dict[str, dict[str, str]] = {
    "none": {},
    "http": {"http_proxy": "http://127.0.0.1:9", "HTTP_PROXY": "http://127.0.0.1:9"},
    "all": {"ALL_PROXY": "socks5://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"},
    "broken": {"http_proxy": "::not a proxy::"},
    "empty": {"http_proxy": "", "no_proxy": ""},
    "not-for-us": {"http_proxy": "http://127.0.0.1:9", "no_proxy": "127.0.0.1,localhost"},
}
PREFECT_HOME: dict[str, str | None] = {"PREFECT_HOME": None}


def _file_as_home(root: Path) -> dict[str, str | None]:
    (root / "home-file").write_text("no folder")
    return {"HOME": str(root / "home-file"), **PREFECT_HOME}


HOMES: dict[str, Callable[[Path], dict[str, str | None]]] = {
    "as-it-is": lambda _root: {},
    "own": lambda root: {"HOME": str(root / "home"), **PREFECT_HOME},
    "unset": lambda _root: {"HOME": None, **PREFECT_HOME},
    "missing": lambda _root: {"HOME": "/nonexistent/home", **PREFECT_HOME},
    "not-writable": lambda _root: {"HOME": "/proc", **PREFECT_HOME},
    "a-file": _file_as_home,
    "relative": lambda _root: {"HOME": "home", **PREFECT_HOME},
}
"""Paths, proxies and homes by name; variables that are None are not set."""


if __name__ == "__main__":
    sys.exit(main())
