"""`lidarpainter catalog stale` and `cost`: what would have to be redone, and what things took."""

from typing import Annotated, Any

import typer

from flows.cli.output import Cell, format_bytes, print_json, print_table
from flows.cli.shared_options import AsJson

app = typer.Typer()


@app.command("stale")
def stale(as_json: AsJson = False) -> None:
    """Show which runs today's code would make otherwise, why, and what redoing them takes.

    Of the runs of one scene with the same parameters the newest counts. Seconds are those of the
    stages concerned when they were computed; what several runs share counts once in the total.

    Example: lidarpainter catalog stale
    """
    from dataclasses import asdict

    from catalog.questions import stale_runs
    from catalog.store import existing_store
    from tasks.stages import project_source

    store = existing_store()
    found = stale_runs(store, project_source().code_from)
    once = {name: cost for one in found for name, cost in one.artefacts.items()}
    total = {
        name: sum(cost[name] for cost in once.values())
        for name in ("seconds", "cpu_seconds", "num_bytes")
    }
    scenes = len({one.scene_id for one in found})
    if as_json:
        print_json({"scenes": scenes, "total": total, "runs": [asdict(one) for one in found]})
        return
    columns = ["scene", "run", "stages", "changed", "s", "CPU s"]
    rows: list[list[Cell]] = [
        [
            one.scene_id,
            one.run_id,
            ", ".join(sorted({name.partition("/")[0] for name in one.artefacts})),
            ", ".join(one.changed),
            one.total("seconds"),
            one.total("cpu_seconds"),
        ]
        for one in found
    ]
    note = (
        f"{scenes} scenes; to redo them took {total['seconds']:.0f} s, "
        f"{total['cpu_seconds']:.0f} s of CPU, and {format_bytes(total['num_bytes'])}"
    )
    print_table(f"stale in {store.name}", columns, rows, note, num_text_columns=4)


@app.command("cost")
def cost(
    scene: Annotated[str, typer.Argument(help="Scene id, dataset/sequence.")],
    as_json: AsJson = False,
) -> None:
    """Show what a scene has cost: attempts of fleets by cause, and stages as computed.

    Money follows from money_per_hour in the table `budget` of the fleet's manifest.

    Example: lidarpainter catalog cost pandaset/002
    """
    from catalog.questions import cost_of
    from catalog.store import existing_store

    found = cost_of(existing_store(), scene)
    if as_json:
        print_json(found)
        return
    columns = ["what", "how many", "s", "CPU s", "size", "most memory", "money"]
    rows = [_row(f"attempts: {cause}", one) for cause, one in found["by_cause"].items()]
    rows += [_row("all attempts", found["attempts"])] if rows else []
    rows += [_row(f"stage: {kind}", one) for kind, one in found["stages"].items()]
    rows += [_row(f"all stages of {found['runs']} runs", found["stages_total"])]
    print_table(f"cost of {scene}", columns, rows)


def _row(name: str, spent: dict[str, Any]) -> list[Cell]:
    memory, money = spent.get("peak_memory_bytes"), spent.get("money")
    return [
        name,
        spent.get("attempts"),
        spent["seconds"],
        spent["cpu_seconds"],
        format_bytes(spent["num_bytes"]),
        format_bytes(memory) if memory else None,
        money,
    ]
