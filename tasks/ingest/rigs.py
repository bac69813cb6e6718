"""Look into a bag and propose which of its topics are which sensor."""

from pathlib import Path
from typing import Any

from lidarpainter_models.errors import DataError
from lidarpainter_models.readers.bags.chunks import bag_files, list_bags
from lidarpainter_models.readers.bags.proposal import proposed_rig
from lidarpainter_models.readers.bags.rig import rig_text
from lidarpainter_models.readers.bags.survey import survey_bag

NS_PER_S = 1e9


def propose_rig(path: Path) -> dict[str, Any]:
    """What a bag holds, a rig for it, and what is missing.

    Returns:
        `topics` (rows: topic, schema, kind, frame, messages, seconds, hz), `rig` (the text of a
        rig.toml, None where there is no camera), `missing` (a line each).

    Raises:
        DataError: it is no bag, or is damaged.
    """
    names = list_bags(path) if path.exists() else ()
    if len(names) != 1:
        found = f"holds {len(names)} bags" if names else "no such bag"
        raise DataError(f"{path}: {found}, expected an MCAP file, or the folder of a split one")
    survey = survey_bag(bag_files(path, names[0]))
    proposal = proposed_rig(survey)
    rows = []
    for topic in sorted(survey.topics.values(), key=lambda one: one.name):
        times_ns = topic.times_ns("log")
        seconds = float(times_ns[-1] - times_ns[0]) / NS_PER_S if len(times_ns) > 1 else None
        rows.append(
            {
                "topic": topic.name,
                "schema": topic.schema,
                "kind": topic.kind,
                "frame": topic.frame,
                "messages": topic.count,
                "seconds": seconds,
                "hz": (len(times_ns) - 1) / seconds if seconds else None,
            }
        )
    text = None if proposal.rig is None else rig_text(proposal.rig)
    return {"topics": rows, "rig": text, "missing": list(proposal.missing)}
