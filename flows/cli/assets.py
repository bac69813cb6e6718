"""`lidarpainter assets`: what runs yield for use elsewhere."""

from typing import Annotated

import typer

from flows.cli.output import print_json, print_table, say_status
from flows.cli.shared_options import AsJson

app = typer.Typer(help="Actors, streets and skies for use elsewhere.", no_args_is_help=True)


@app.command()
def publish(
    runs: Annotated[
        list[str],
        typer.Argument(help="Run ids, unique prefixes of them, or latest.", show_default=False),
    ],
    as_json: AsJson = False,
) -> None:
    """Take actors, street, sky and trajectories out of finished runs into the library.

    Example: lidarpainter assets publish latest
    """
    from catalog.store import existing_store
    from tasks.runs import open_run

    store = existing_store()
    for run in runs:
        open_run(store, run)
    say_status(f"opening {', '.join(runs)}")
    from flows.assets import publish_run
    from flows.cli.progress import shown_progress

    with shown_progress():
        results = [publish_run(store, run) for run in runs]
    if as_json:
        print_json({"published": results})
        return
    columns = ("run_id", "scene", "style", "num_actor", "num_street", "num_assets", "seconds")
    print_table("published", columns, [[one[name] for name in columns] for one in results])
