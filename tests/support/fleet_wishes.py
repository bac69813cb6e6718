"""A sequence that a fleet is asked for."""

from dataclasses import replace

from catalog.fleets import Wish


def wish(scene="x/one", **changes):
    """As fleet `night` asks for it, but for some changes."""
    usual = Wish(
        fleet="night",
        scene_id=scene,
        cameras=None,
        position=0,
        priority=0,
        variants=(),
        asked="{}",
        asked_digest="as asked",
        code_digest="the code",
        budget="{}",
    )
    return replace(usual, **changes)
