"""What a check of the GPU found, and the page that it makes of it."""

import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

PAPER_MS, PAPER_GB = 870, 10.5
"""Of the paper's painter at 1024x576, as its authors measured it."""


MOST_KERNELS = 12
"""Named of a step."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """A part of the program run on two devices or backends."""

    what: str
    compared: str
    error: float
    allowed: float

    @property
    def holds(self) -> bool:
        return self.error <= self.allowed  # not a number holds nothing


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a part takes."""

    what: str
    first_ms: float
    """The first time: compilation and warming included."""
    ms: float
    """Median of the later ones."""
    peak_bytes: int
    """Largest allocation of torch on the GPU; on the CPU the resident set of the process."""

    def of_one(self, steps: int) -> "Cost":
        """What one of some equal steps takes."""
        return replace(self, first_ms=self.first_ms / steps, ms=self.ms / steps)


@dataclass(frozen=True, kw_only=True)
class StepPart:
    """A kernel's part in a step of a fit."""

    kernel: str
    launches: float
    ms: float


@dataclass(kw_only=True)
class Findings:
    """Everything that was found, in order."""

    machine: dict[str, str]
    is_gpu: bool
    agreements: list[Agreement] = field(default_factory=list)
    costs: list[Cost] = field(default_factory=list)
    painters: list[Cost] = field(default_factory=list)
    step: list[StepPart] = field(default_factory=list)
    """What a step of a fit launches, the longest first."""
    failed: list[str] = field(default_factory=list)
    unchecked: list[str] = field(default_factory=list)

    @contextmanager
    def part(self, what: str) -> Iterator[None]:
        """A part of the check; whatever is raised in it is a finding, and the others go on."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 - it must come to its end on any machine
            traceback.print_exc()
            lines = str(error).splitlines() or [""]
            self.failed.append(f"{what}: {type(error).__name__}: {lines[0]}")

    @property
    def is_fit(self) -> bool:
        return not self.failed and all(found.holds for found in self.agreements)

    @property
    def first_line(self) -> str:
        """What was checked where, and how it went."""
        held = sum(found.holds for found in self.agreements)
        went = (
            f"{held} of {len(self.agreements)} parts agree, {len(self.failed)} failed, "
            f"{len(self.unchecked)} not checked"
        )
        if self.is_gpu:
            return f"GPU check on {self.machine['device']}: {went}"
        return (
            "No GPU was found. On the CPU instead: torch against numba, Triton in its interpreter "
            f"at a tiny size, costs as a rehearsal: {went}"
        )

    def page(self) -> str:
        """All of it in Markdown, to be put into docs/benchmarks.md."""
        parts = [self.first_line, "", "### Checked on a GPU" if self.is_gpu else "### Rehearsal"]
        parts += ["", *(f"- {name}: {value}" for name, value in self.machine.items())]
        if self.agreements:
            parts += ["", *_table(("part", "compared", "error", "allowed", ""), self._agreed())]
        header: tuple[str, ...]
        where = "GPU memory, GB" if self.is_gpu else "process, GB"
        if self.costs:
            header = ("stage", "first, ms", "then, ms", where)
            parts += ["", *_table(header, map(_cost_row, self.costs))]
        if self.painters:
            header = ("painter, one view", "first, ms", "then, ms", where)
            rows = [*map(_cost_row, self.painters)]
            rows.append(("the paper, at 1024x576", "", str(PAPER_MS), str(PAPER_GB)))
            parts += ["", *_table(header, rows)]
        if self.step:
            header = ("kernel of a step", "launches", "ms")
            parts += ["", *_table(header, self._step_rows())]
        for title, lines in (("Failed", self.failed), ("Not checked", self.unchecked)):
            parts += ["", f"{title}:", "", *(f"- {line}" for line in lines or ["nothing"])]
        return "\n".join(parts) + "\n"

    def _agreed(self) -> Iterator[tuple[str, ...]]:
        for found in self.agreements:
            verdict = "agrees" if found.holds else "**differs**"
            yield found.what, found.compared, f"{found.error:.1e}", f"{found.allowed:.0e}", verdict

    def _step_rows(self) -> Iterator[tuple[str, ...]]:
        rest = self.step[MOST_KERNELS:]
        others = StepPart(
            kernel=f"{len(rest)} others",
            launches=sum(part.launches for part in rest),
            ms=sum(part.ms for part in rest),
        )
        for part in (*self.step[:MOST_KERNELS], others):
            yield f"`{part.kernel[:60]}`", f"{part.launches:.1f}", f"{part.ms:.3f}"


def _cost_row(cost: Cost) -> tuple[str, ...]:
    return cost.what, f"{cost.first_ms:.0f}", f"{cost.ms:.1f}", f"{cost.peak_bytes / 1e9:.2f}"


def _table(header: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    lines = [header, ("---",) * len(header), *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]
