"""Wrong words on the command line, answered as every other error: in one line."""

import sys
from typing import Any

import typer
from typer.core import TyperGroup

from lidarpainter_models.errors import ConfigError

USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
"""The parent of typer's errors about words; it has no public name in every version of typer."""
NO_WORDS = "NoArgsIsHelpError"


class OneLineGroup(TyperGroup):
    """The whole command; what it cannot read is raised instead of drawn in a box."""

    def main(self, *args: Any, **options: Any) -> Any:  # noqa: ANN401 - as typer has it
        """Run a command and leave with its code.

        Raises:
            ConfigError: an option or argument is missing, unknown or of the wrong kind.
        """
        try:
            code = super().main(*args, **{**options, "standalone_mode": False})
        except USAGE_ERROR as error:
            if type(error).__name__ == NO_WORDS:
                sys.stdout.write(error.ctx.get_help())
                sys.exit(error.exit_code)
            place = f" (see {error.ctx.command_path} --help)" if error.ctx else ""
            raise ConfigError(f"{error.format_message().rstrip('.')}{place}") from None
        sys.exit(code if isinstance(code, int) else 0)
