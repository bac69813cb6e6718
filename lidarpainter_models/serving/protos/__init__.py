"""Messages of the simulators' interface, generated from the .proto files beside this module.

They are written anew in the root of the repository by `python -m grpc_tools.protoc -I .
--python_out=.` and the paths of both .proto files. Generated code runs with the
protobuf that it was generated for, or a newer one.
"""

from typing import Any, TypeAlias

import google.protobuf

from lidarpainter_models.errors import MissingPackageError

Message: TypeAlias = Any
"""A message of the interface, or a part of one: protobuf's generated code has no types."""
OLDEST = (7, 35, 1)
"""Version of protobuf that the code is generated for."""

if tuple(int(part) for part in google.protobuf.__version__.split(".")[:3]) < OLDEST:
    raise MissingPackageError(
        f"protobuf {google.protobuf.__version__} is too old for the messages of simulators: "
        "pip install 'lidarpainter[simulators]'"
    )
