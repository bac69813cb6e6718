"""`lidarpainter edit`: take actors out of a run, put them in, let them go elsewhere."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from flows.cli.output import Cell, print_json, print_pairs, print_table
from flows.cli.shared_options import AsJson, check_painter, described, named_run
from lidarpainter_models.errors import ConfigError

ACTORS = "actors"
MANY = ("remove",)
"""Operations on any number of actors."""
NOBODY = ("freeze", "crop", "style", "drive")
"""Operations on nobody in particular."""
NAMED = {"insert": "name", "join": "run"}
"""What the name of an operation is, where it is not an actor that is there."""
MOST_SCRIPT_BYTES = 10_000_000
_NUMBER = re.compile(r"factor|speed|strength|.*_(m|s|deg|mps)")
"""Fields whose name says that they are numbers."""
_WHOLE_NUMBER = "seed"
LEAST_NAME = 8
"""Characters of an actor's id in a table, which name it to `edit` too."""

WORDS = """
words: The word actors, which lists them; or an operation of docs/editing.md (remove, insert, move,
  swap, ...), the actor, and field=value. An actor is its id, the beginning of it, or nearest-ahead.
script: File with a JSON list of operations; several files are done one after the other.
painter: Painter of what no camera saw: none, overlay, warp, nano, a .safetensors file, or a model.
  The run's own if absent.
allow_collisions: Let actors and the camera go through what LiDAR saw standing there.
out: Folder that images along the script's `drive` are written to, painted where it is a clear day.
"""


@described(WORDS)
def edit(
    run: str,
    words: Annotated[list[str] | None, typer.Argument(show_default=False)] = None,
    script: list[Path] | None = None,
    painter: str | None = None,
    allow_collisions: bool = False,
    out: Path | None = None,
    as_json: AsJson = False,
) -> None:
    """Edit a finished run: who is where. Makes a new run; the old one stays as it is.

    Example: lidarpainter edit latest remove nearest-ahead

    A lane change: lidarpainter edit latest move car-3 trajectory=lane-change:-3.5@1s+2s

    Several at once: lidarpainter edit latest --script edits.json --out pictures
    """
    if words == [ACTORS] and not script:
        _list(run, as_json=as_json)
        return
    operations: list[Any] = []
    for path in script or ():
        operations += _read_script(path)
    operations += [_operation(words)] if words else []
    from catalog.store import existing_store
    from lidarpainter_models.editing.script import parse_operations

    known = parse_operations(operations, "edit")
    run_id = named_run(run)
    check_painter(painter)
    from flows.cli.progress import shown_progress
    from flows.edit import edit_run, shown_edit

    store = existing_store()
    how: dict[str, Any] = {"painter": painter, "allows_collisions": allow_collisions}
    with shown_progress():
        result = edit_run(store, run_id, known, **how)
        if out is not None:
            result["images"] = shown_edit(store, result, out.absolute(), **how)
    print_json(result) if as_json else _show(result)


def _show(result: dict[str, Any]) -> None:
    summary = result["summary"]
    pairs: dict[str, Cell] = {
        "run": result["run_id"],
        "derived from": result["derived_from"],
        "Gaussians": result["num_gaussians"],
        "filled in": summary["num_filled"],
        "meetings": "; ".join(summary["encounters"]) or "none",
        "trajectory": result["trajectory"],
    }
    print_pairs(f"edited {result['scene']}", pairs)


def _list(run: str, *, as_json: bool) -> None:
    """Who is in the run, the nearest first."""
    from catalog.store import existing_store

    store = existing_store()
    run_id = named_run(run)
    from flows.edit import list_actors

    rows = list_actors(store, run_id)
    if as_json:
        print_json({"run": run, "actors": rows})
        return
    names = shortest_names([row["actor_id"] for row in rows])
    columns = ["actor_id", "category", "is_moving", "length_m", "width_m", "height_m"]
    columns += ["frames", "num_gaussians", "distance_m"]
    cells = [
        [name, *(row[column] for column in columns[1:])]
        for name, row in zip(names, rows, strict=True)
    ]
    print_table(f"actors of run {run_id}", columns, cells, num_text_columns=2)


def shortest_names(ids: Sequence[str]) -> list[str]:
    """The beginnings of ids that still tell them apart, all of one length."""
    length = LEAST_NAME
    while len({one[:length] for one in ids}) < len(set(ids)):
        length += 1
    return [one[:length] for one in ids]


def _operation(words: list[str]) -> dict[str, Any]:
    """`move car-3 trajectory=lateral:2` as an operation of a script."""
    op, *rest = words
    names = [word for word in rest if "=" not in word]
    found: dict[str, Any] = {"op": op}
    if op in MANY:
        found["actors"] = names
    elif op not in NOBODY:
        if len(names) != 1:
            raise ConfigError(f"edit: {op} takes one name, got {', '.join(names) or 'none'}")
        found[NAMED.get(op, "actor")] = names[0]
    elif names:
        raise ConfigError(f"edit: {op} takes no name, got {', '.join(names)}")
    for word in rest:
        field, is_field, text = word.partition("=")
        if is_field:
            outer, has_inner, inner = field.partition(".")
            value = _value(field, text)
            found |= {outer: found.get(outer, {}) | {inner: value}} if has_inner else {field: value}
    return found


def _value(field: str, text: str) -> str | float:
    is_whole = field == _WHOLE_NUMBER
    if not (is_whole or _NUMBER.fullmatch(field)):
        return text
    try:
        return int(text) if is_whole else float(text)
    except ValueError:
        kind = "whole number" if is_whole else "number"
        raise ConfigError(f"edit: {field}={text}: expected a {kind}") from None


def _read_script(path: Path) -> list[Any]:
    """The operations of a file, checked."""
    from lidarpainter_models.editing.script import parse_script

    try:
        if path.stat().st_size > MOST_SCRIPT_BYTES:
            raise ConfigError(f"script {path}: expected at most {MOST_SCRIPT_BYTES / 1e6:g} MB")
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"script {path} cannot be read: {error}") from None
    return [one.model_dump(exclude_defaults=True) for one in parse_script(text, f"script {path}")]
