"""Random combinations of odd boxes, masked images, lenses, paths, proxies and home folders.

    python scripts/fuzz_logs.py FOLDER [--combinations 2000] [--seed 0]

A tiny street is written anew with odd boxes, images and lenses, looked at by the doctor, fitted and
judged on the frames held out; and the command is run where a path, a proxy or a home folder is odd.
Combinations are drawn from NUM_LOGS logs and NUM_PLACES places, themselves drawn from the seed, in
which every odd thing occurs several times and together with others; each is tried once, and the
last line says how many different ones were. Three things must never happen: an error that is not
one of ours, a figure that is not a number, and a loss beside the same log without odd boxes and
images that the doctor did not name. They are printed, and the exit code says whether there were
any. What is refused in one line is no fault.
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

import numpy as np
from odd_logs import BOXES, IMAGES, LOOKED_FOR_BY, Change, lens_as_it_is, random_lens

import lidarpainter_models as lp
from lidarpainter_models.errors import LidarPainterError
from lidarpainter_models.gaussians.fitting.config import EffortConfig
from lidarpainter_models.scenes.driving_scene import DrivingScene
from lidarpainter_models.scenes.rewriting import header_of
from lidarpainter_models.scenes.splits import split_views
from lidarpainter_models.scenes.writer import SceneWriter
from lidarpainter_models.stress.frames import read_frame
from lidarpainter_models.synthetic.config import DEFAULT_CAMERAS, RigLidar
from tasks.ingest.data_checks import findings_about

STREET = lp.SyntheticStreetConfig(
    seed=11,
    num_frames=10,
    width_px=192,
    height_px=108,
    cameras=DEFAULT_CAMERAS[:1],
    lidar=RigLidar(columns=900),
)
SMALL_STREET = replace(STREET, width_px=96, height_px=54, lidar=RigLidar(columns=300))
"""The street of the places, where no figure is compared."""
NUM_LOGS, NUM_PLACES = 160, 80
LOOKS = 40.0
LOSS_DB = 0.5
LENSES_PER_SEED = 8


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
    """Names of the checks that did not say ok, that did not look, or that found the own body."""


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
        self.lenses = {"plain": lens_as_it_is} | {
            f"lens-{number}": random_lens(self.dice) for number in range(LENSES_PER_SEED)
        }
        self.log_pool = _pool(self.dice, NUM_LOGS, BOXES, IMAGES, self.lenses)
        self.place_pool = _pool(self.dice, NUM_PLACES, PATHS, PROXIES, HOMES)

    def faults_of_one(self) -> list[str]:
        """The next combination's faults, each new one once."""
        boxes, images, lens = self.dice.choice(self.log_pool)
        place = self.dice.choice(self.place_pool)
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
            f"{count} combinations: {len(self.logs)} different logs, {len(self.places)} different "
            f"places, {refused} refused in one line, {self.num_losses_named} losses that the "
            f"doctor named, {self.num_faults} faults"
        )

    @staticmethod
    def _found(what: str, outcome: Outcome) -> list[str]:
        return [f"{what}: {outcome.fault}"] if outcome.fault else []

    def _silent_loss(self, boxes: str, images: str, lens: str, outcome: Outcome) -> list[str]:
        plain = self._log("plain", "plain", lens)
        loss_db = plain.psnr - outcome.psnr
        if not loss_db > LOSS_DB:  # a log that was refused has none
            return []
        not_looked_for = _not_checked(LOOKED_FOR_BY.get(images, ""))
        named = outcome.doubts - plain.doubts | outcome.doubts & {not_looked_for}
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
        street = self.small_street.path
        name = f"{street.parent.name}/{street.name}"
        root_and_name = str(street.parent), street.name
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
        # os's own test raises nothing where a name is too long
        left = [one for one in (store, store.parent) if one != root and os.path.isdir(one)]  # noqa: PTH112
        is_half = any(one.name == "manifest.json" for folder in left for one in folder.rglob("*"))
        is_first = outcomes[0].refusal == first.refusal
        return replace(first, fault="refused, but written") if is_half and is_first else first

    @cached_property
    def street(self) -> DrivingScene:
        """The sound log."""
        return _street(STREET, self.folder / "street")

    @cached_property
    def small_street(self) -> DrivingScene:
        """What the command is given."""
        return _street(SMALL_STREET, self.folder / "small-street")


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


def _street(config: lp.SyntheticStreetConfig, folder: Path) -> DrivingScene:
    found = sorted(folder.glob("scenes/*/*/manifest.json"))
    return lp.open_scene(found[0].parent if found else lp.write_street(config, folder))


def _not_checked(name: str) -> str:
    return f"{name}: not checked"


def _fitted(scene: DrivingScene) -> Outcome:
    findings = findings_about(scene)
    doubts = {found.name for found in findings if found.verdict != "ok"}
    doubts |= {_not_checked(found.name) for found in findings if "not checked" in found.detail}
    doubts |= {found.name for found in findings if "shows the recording car in" in found.detail}
    split = split_views(scene, "alternate")
    size = lp.ObservationConfig(width_px=STREET.width_px)
    config = lp.FitConfig(effort=EffortConfig(looks=LOOKS, gaussians_per_pixel=0.2))
    fitted = lp.fit_gaussians(lp.prepare_observations(scene, split, size), config).scene
    psnr = lp.evaluate(fitted, scene, split, size, shifts=())["recorded"]["psnr"]
    return Outcome(
        psnr=psnr,
        doubts=frozenset(doubts),
        fault=f"held-out PSNR is {psnr}" if math.isnan(psnr) else "",  # black images: inf
    )


def _rewritten(scene: DrivingScene, store: Path, name: str, changes: Sequence[Change]) -> Path:
    with SceneWriter(store, "fuzz", name, header_of(scene, {})) as writer:
        for frame_index in scene.frame_indices:
            frame = read_frame(scene, frame_index)
            for change in changes:
                frame = change(frame)
            frame.write(writer)
    return writer.path


def _pool(
    dice: random.Random, count: int, *tables: Mapping[str, object]
) -> list[tuple[str, str, str]]:
    """So many times a name of each of three tables; every third is the first, nothing odd."""
    columns = []
    for first, *odd in tables:
        num_odd = count - count // 3
        names = [first] * (count // 3) + [odd[number % len(odd)] for number in range(num_odd)]
        dice.shuffle(names)
        columns.append(names)
    return list(zip(*columns, strict=True))


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
