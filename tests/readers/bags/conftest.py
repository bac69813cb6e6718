"""A synthetic street as bags of ROS 2 and of Foxglove."""

import pytest
from bag_log import write_foxglove_bag, write_ros_bag


@pytest.fixture(scope="session")
def bags(street, tmp_path_factory):
    """The same drive in files of both kinds."""
    folder = tmp_path_factory.mktemp("bags")
    write_ros_bag(street, folder / "ros.mcap")
    write_foxglove_bag(street, folder / "foxglove.mcap")
    return folder
