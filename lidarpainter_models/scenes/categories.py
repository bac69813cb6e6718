"""One word for what data sets call by many: PandaSet's `Car`, nuScenes' `vehicle.car`."""

import re

_CATEGORIES = {
    "bicycle rack": {"rack"},
    "sign": {"sign", "signs"},
    "pedestrian": {"pedestrian", "human", "person", "signaler"},
    "animal": {"animal", "animals", "dog"},
    "barrier": {"barrier", "barriers"},
    "cone": {"cone", "cones", "trafficcone", "pylon", "pylons", "barrel"},
    "motorcycle": {"motorcycle", "motorcyclist", "motorized", "scooter", "moped"},
    "bicycle": {"bicycle", "bicyclist", "cyclist"},
    "pickup": {"pickup"},
    "van": {"van"},
    "trailer": {"trailer", "towed"},
    "truck": {"truck"},
    "bus": {"bus"},
    "train": {"train", "tram", "subway", "trolley", "railed"},
    "construction vehicle": {"construction"},
    "emergency vehicle": {"emergency", "ambulance", "police"},
    "car": {"car"},
    "vehicle": {"vehicle"},
}
"""Categories by the words that say so; the first that has one of them counts, so `pedestrian` of
`human.pedestrian.police_officer`, `sign` of `MOBILE_PEDESTRIAN_SIGN`, and `pickup` of `Pickup
Truck`. Waymo says no more than
`vehicle`."""


def category_of(label: str) -> str:
    """The category of what a data set calls something; of unknown labels their words."""
    words = re.findall(r"[^\W_]+", label.lower())
    found = (name for name, known in _CATEGORIES.items() if known.intersection(words))
    return next(found, " ".join(words) or label)
