"""The digest by which a stage knows which painter it used."""

from lidarpainter_models.painter.selection import NO_PAINTER, PainterChoice

__all__ = ["NO_PAINTER", "painter_digest"]


def painter_digest(name_or_path: str) -> str:
    """See `PainterChoice.digest`."""
    return PainterChoice.of(name_or_path).digest
