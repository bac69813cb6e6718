"""Which images of a recording are compared with each other."""

import pytest

from lidarpainter_models.lidar.hub_images import compared_images, hub_neighbours


@pytest.mark.parametrize(("num_images", "most_read"), [(1, 1), (5, 5), (28, 28), (1000, 40)])
def test_of_a_long_log_few_images_are_read(num_images, most_read):
    hubs = hub_neighbours(num_images)
    assert [hubs[0][0], hubs[-1][0]] == [0, num_images - 1]
    assert all(own in around for own, around in hubs)
    read = compared_images(num_images)
    assert len(read) <= most_read
    assert compared_images(0) == []
    assert set(read) == {index for _, around in hubs for index in around} <= set(range(num_images))
