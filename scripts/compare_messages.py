"""Hold our messages against somebody else's .proto file, field by field.

    python scripts/compare_messages.py THEIRS.proto [OURS.proto]

It reads text alone, so that files that a file imports need not be there. Messages, enums and calls
go by their own names, whatever package or message holds them. Ends with 1 where a name that both
have means something else; what only one of them has is told and is no fault.
"""

import re
import sys
from pathlib import Path

OURS = Path(__file__).parents[1] / "lidarpainter_models/serving/protos/sensorsim.proto"
COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
OPENING = re.compile(r"(message|enum|service|oneof)\s+(\w+)\s*$")
FIELD = re.compile(r"(?:(repeated|optional)\s+)?([\w.<>, ]+?)\s+(\w+)\s*=\s*(\d+)")
VALUE = re.compile(r"(\w+)\s*=\s*(-?\d+)")
CALL = re.compile(r"rpc\s+(\w+)\s*\(\s*([\w.]+)\s*\)\s*returns\s*\(\s*([\w.]+)\s*\)")


def meanings(text: str) -> dict[str, str]:
    """What every field, value and call of a file is, by its holder and its name."""
    found: dict[str, str] = {}
    holders: list[tuple[str, str]] = []
    for piece in re.split(r"([{};])", COMMENT.sub("", text)):
        words = " ".join(piece.split())
        if words == "{":
            continue
        if words == "}":
            if holders:
                holders.pop()
        elif opening := OPENING.search(words):
            holders.append((opening[1], opening[2]))
        elif holders:
            found |= _meaning(holders, words)
    return found


def _meaning(holders: list[tuple[str, str]], words: str) -> dict[str, str]:
    holder = next(name for kind, name in reversed(holders) if kind != "oneof")
    if call := CALL.match(words):
        return {f"{holder}.{call[1]}": f"{_last(call[2])} -> {_last(call[3])}"}
    if holders[-1][0] == "enum" and (value := VALUE.match(words)):
        return {f"{holder}.{value[1]}": value[2]}
    if field := FIELD.match(words):
        label = "repeated " if field[1] == "repeated" else ""
        return {f"{holder}.{field[3]}": f"{label}{_last(field[2])} = {field[4]}"}
    return {}


def _last(name: str) -> str:
    return name if "<" in name else name.rpartition(".")[2]


def main(theirs: str, ours: str = str(OURS)) -> int:
    """Tell how two files differ."""
    theirs_by, ours_by = (meanings(Path(path).read_text("utf-8")) for path in (theirs, ours))
    shared = theirs_by.keys() & ours_by.keys()
    other = sorted(name for name in shared if theirs_by[name] != ours_by[name])
    for name in other:
        sys.stdout.write(f"{name}: theirs {theirs_by[name]}, ours {ours_by[name]}\n")
    for whose, names in (
        ("theirs", theirs_by.keys() - shared),
        ("ours", ours_by.keys() - shared),
    ):
        for name in sorted(names):
            sys.stdout.write(f"only {whose}: {name}\n")
    sys.stdout.write(f"{len(shared) - len(other)} alike, {len(other)} different\n")
    return 1 if other or not shared else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
