"""`lidarpainter evaluate --protocol flicker`: how steady a run looks along shifted paths."""

from typing import TYPE_CHECKING, get_args

from flows.cli.output import print_json, print_table
from flows.cli.progress import shown_progress
from lidarpainter_models.conditioning.sequences import PreviousUse, SequenceConfig
from lidarpainter_models.errors import ConfigError
from tasks.evaluation.flicker import by_image, evaluate_flicker
from tasks.evaluation.scores import FLICKER, load_scores
from tasks.reconstruction.publish import record_scores

if TYPE_CHECKING:
    from catalog.store import Store
    from flows.parameters import ViewParameters
    from tasks.runs import FinishedRun

COLUMNS = ("flicker", "moving_flicker", "valid_share", "psnr", "num_pairs")


def show_flicker(
    store: "Store",
    run: "FinishedRun",
    parameters: "ViewParameters",
    painter: str | None,
    previous: str | None,
    *,
    as_json: bool,
) -> None:
    """Compare neighbouring frames of a run's last scene: rendered, painted, and true if known."""
    chosen = painter or parameters.painter
    sequences = parse_previous(previous)
    with shown_progress():
        judged = evaluate_flicker.fn(
            store.root,
            FLICKER,
            parameters.split_spec,
            run.final,
            parameters.judge_settings,
            chosen,
            sequences,
        )
    found = load_scores(judged.ref)[FLICKER]
    record_scores(store, run.run_id, run.scene_id, by_image(found))
    if as_json:
        about = {"run_id": run.run_id, "scene": run.scene_id, "protocol": FLICKER}
        print_json({**about, "painter": chosen, FLICKER: found})
        return
    rows = [
        [shift, image, *(scores[name] for name in COLUMNS)]
        for shift, images in found.items()
        for image, scores in images.items()
    ]
    title = f"{run.scene_id}, run {run.run_id}: mean rgb difference of neighbouring frames"
    print_table(title, ["view", "image", *COLUMNS], rows, num_text_columns=2)


def parse_previous(text: str | None) -> tuple[SequenceConfig, ...]:
    """What becomes of the frame before: `mixed`, `shown`, or both with a comma between.

    Raises:
        ConfigError: the text says something else.
    """
    if text is None:
        return ()
    names = dict.fromkeys(name.strip() for name in text.split(","))
    uses: dict[str, PreviousUse] = {use: use for use in get_args(PreviousUse)}
    if not names.keys() <= uses.keys():
        raise ConfigError(f"--previous {text!r}: expected {', '.join(uses)}")
    return tuple(SequenceConfig(previous=uses[name]) for name in names)
