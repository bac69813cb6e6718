"""The project's source, by which code is named that made an artefact or a run."""

from functools import cache

from catalog.code_closure import Code, SourceTree

PACKAGES = ("flows", "tasks", "lidarpainter_models")
"""What can decide about a result; the catalog carries bytes and is not followed."""


@cache
def project_source() -> SourceTree:
    """The source as it was when this process first looked."""
    return SourceTree.of_packages(*PACKAGES)


@cache
def code_behind(start: str) -> Code:
    """The code that is reached from a function, named `module:function`."""
    return project_source().code_from((start,))
