"""`lidarpainter settings`: everything that `--set` knows."""

import json
from dataclasses import asdict
from typing import Annotated, Literal

import typer

from flows.cli.output import Cell, print_json, print_table
from flows.cli.shared_options import AsJson, described

WORDS = """
prefix: Beginning of the settings to list, such as fit or fit.densification; all if absent.
preset: Preset whose defaults are shown: brief, preview, balanced or paper.
of: Commands whose settings are listed: reconstruct (and demo), or train (painter train and
  harvest).
"""


@described(WORDS)
def settings(
    prefix: Annotated[str, typer.Argument()] = "",
    preset: str = "preview",
    of: Literal["reconstruct", "train"] = "reconstruct",
    as_json: AsJson = False,
) -> None:
    """List what --set knows: path, type, default and reason.

    Example: lidarpainter settings fit.densification

    Then: lidarpainter reconstruct pandaset/002 --set fit.densification.budget=100000
    """
    from flows.overrides import known_settings

    if of == "train":
        from flows.painter_parameters import TrainPainterParameters

        found = known_settings(TrainPainterParameters(), prefix)
        title = "settings of painter train"
    else:
        from flows.presets import preset as preset_named

        found = known_settings(preset_named(preset, "dataset/sequence"), prefix)
        title = f"settings of reconstruct, preset {preset}"
    if as_json:
        print_json({"of": of, "preset": preset, "settings": [asdict(one) for one in found]})
        return
    rows: list[list[Cell]] = [
        [one.path, one.type, json.dumps(one.default), one.reason] for one in found
    ]
    print_table(title, ["setting", "type", "default", "reason"], rows, num_text_columns=4)
