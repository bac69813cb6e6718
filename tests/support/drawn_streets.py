"""Synthetic streets for all tests of a process: drawing one takes seconds; its seed is all of it.

street = drawn_street(SyntheticStreetConfig(seed=5, num_frames=3))
path = record_street(street, folder)
"""

import copy
from functools import cache

from lidarpainter_models.synthetic import SyntheticStreet, SyntheticStreetConfig


def drawn_street(config):
    """The street of a config's seed, drawn once, seen with the config's sensors."""
    street = copy.copy(_first_drawn(config.seed))
    street.config = config
    return street


@cache
def _first_drawn(seed):
    return SyntheticStreet(SyntheticStreetConfig(seed=seed))
