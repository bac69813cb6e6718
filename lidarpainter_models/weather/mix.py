"""Which styles, how strong, and when: `foggy:0.5+night:0..1`, read and written.

Free of tensors, so that a command refuses what it cannot read before anything heavy is loaded.
"""

import math
import re
from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError

CLEAR = "clear"
STYLE_PROMPTS = (CLEAR, "foggy", "night", "rain")
"""Prompts that a style stands behind; the first changes nothing."""
FOG_VISIBILITY_M = 120.0
"""Where contrast has fallen to 2 %; below 1000 m it is called fog."""

_NUMBER = r"\d+(?:\.\d+)?|\.\d+"
_SHARE = re.compile(rf"([a-z]+)(?::({_NUMBER})(?:\.\.({_NUMBER}))?)?")
_FORM = "expected NAME, NAME:STRENGTH or NAME:FROM..TO with + between, such as foggy:0.5+night:0..1"


def check_prompt(prompt: str) -> str:
    """The prompt, if a style stands behind it.

    Raises:
        ConfigError: none does.
    """
    if prompt not in STYLE_PROMPTS:
        raise ConfigError(f"no style {prompt!r}, expected {', '.join(STYLE_PROMPTS)}")
    return prompt


@dataclass(frozen=True, slots=True, kw_only=True)
class StyleShare:
    """One style of a mix; its strength goes from `first` to `last` while the log passes."""

    prompt: str
    first: float = 1.0
    last: float = 1.0

    def __post_init__(self) -> None:
        check_prompt(self.prompt)
        for strength in (self.first, self.last):
            if not 0 <= strength <= 1:
                raise ConfigError(
                    f"the strength of {self.prompt} must be from 0 to 1, got {strength:g}"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class StyleMix:
    """Styles that hold together, each once."""

    shares: tuple[StyleShare, ...]
    visibility_m: float = FOG_VISIBILITY_M
    """In fog of strength 1; extinction grows in proportion to strength."""

    def __post_init__(self) -> None:
        names = [share.prompt for share in self.shares]
        if len(set(names)) != len(names):
            raise ConfigError(f"{self.text!r} names a style twice")
        if not 0 < self.visibility_m < math.inf:
            raise ConfigError(f"visibility must be above 0 metres, got {self.visibility_m:g}")

    @classmethod
    def parse(
        cls, text: str, *, strength: float = 1.0, visibility_m: float | None = None
    ) -> "StyleMix":
        """Read a mix; `strength` multiplies all of it.

        Raises:
            ConfigError: the text says something else, a strength is out of range, or visibility is
                given where there is no fog.
        """
        if not 0 <= strength <= 1:
            raise ConfigError(f"strength must be from 0 to 1, got {strength:g}")
        shares = []
        for part in text.split("+"):
            match = _SHARE.fullmatch(part.strip())
            if match is None:
                raise ConfigError(f"style {text!r}: {_FORM}")
            name, first, last = match.groups()
            start = float(first) if first else 1.0
            StyleShare(prompt=name, first=start, last=float(last) if last else start)
            end = strength * (float(last) if last else start)
            shares.append(StyleShare(prompt=name, first=strength * start, last=end))
        if visibility_m is not None and "foggy" not in {share.prompt for share in shares}:
            raise ConfigError(f"visibility needs fog, and style {text!r} has none")
        return cls(
            shares=tuple(shares),
            visibility_m=FOG_VISIBILITY_M if visibility_m is None else visibility_m,
        )

    @property
    def text(self) -> str:
        """As `parse` reads it."""
        return "+".join(
            f"{share.prompt}:{share.first:g}"
            + (f"..{share.last:g}" if share.last != share.first else "")
            for share in self.shares
        )

    def strengths(self, progress: float) -> dict[str, float]:
        """The strength of every style that changes anything, at a share of the log's time."""
        found = {
            share.prompt: share.first + min(max(progress, 0.0), 1.0) * (share.last - share.first)
            for share in self.shares
            if share.prompt != CLEAR
        }
        return {prompt: strength for prompt, strength in found.items() if strength > 0}
