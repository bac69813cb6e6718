"""What data sets say, and the one category that assets have of it."""

import pytest

from lidarpainter_models.scenes.categories import category_of


@pytest.mark.parametrize(
    ("category", "labels"),
    [
        ("car", ["car", "Car", "vehicle.car"]),
        ("pickup", ["pickup", "Pickup Truck"]),
        ("truck", ["Medium-sized Truck", "Semi-truck", "vehicle.truck"]),
        ("bus", ["Bus", "vehicle.bus.bendy"]),
        ("trailer", ["Towed Object", "vehicle.trailer"]),
        ("construction vehicle", ["Other Vehicle - Construction Vehicle", "vehicle.construction"]),
        ("emergency vehicle", ["Emergency Vehicle", "vehicle.emergency.police"]),
        ("vehicle", ["vehicle", "Other Vehicle - Uncommon"]),
        ("motorcycle", ["Motorcycle", "Motorized Scooter", "vehicle.motorcycle"]),
        ("bicycle", ["Bicycle", "cyclist", "vehicle.bicycle"]),
        ("bicycle rack", ["static_object.bicycle_rack"]),
        ("pedestrian", ["Pedestrian with Object", "human.pedestrian.police_officer"]),
        ("pedestrian", ["human.pedestrian.construction_worker", "Person_sitting"]),
        ("animal", ["Animals - Bird", "animal"]),
        ("cone", ["Cones", "Pylons", "movable_object.trafficcone"]),
        ("barrier", ["Temporary Construction Barriers", "movable_object.barrier"]),
        ("sign", ["Construction Signs", "sign"]),
        ("train", ["Train", "Tram / Subway"]),
        ("rolling containers", ["Rolling Containers"]),  # no category: its own words
        ("cart", ["Cart"]),  # no car
        ("street", ["street"]),
        ("-", ["-"]),
    ],
)
def test_what_data_sets_call_by_many_words_is_one_category(category, labels):
    assert {category_of(label) for label in labels} == {category}
