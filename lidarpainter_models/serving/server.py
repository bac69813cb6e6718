"""The gRPC server: the service under all its names, health and reflection.

Reflection tells of the service under each of its names. Messages of the two further names are
those of the first with another package, in a pool of descriptors of their own: on the wire they are
alike.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING

from google.protobuf import descriptor_pb2, text_format
from google.protobuf.descriptor_pool import DescriptorPool

from lidarpainter_models.serving.protos import Message, common_pb2, sensorsim_pb2
from lidarpainter_models.serving.servicer import SensorsimServicer, answering
from lidarpainter_models.serving.wire import (
    MOST_BYTES,
    PACKAGES,
    grpc_package,
    handlers,
    listening,
    service_names,
)

if TYPE_CHECKING:
    import grpc

SPARE_THREADS = 8
"""Beside those that wait for images: calls that ask for none are answered meanwhile."""
GRACE_S = 0.5
"""For requests that are under way when the server ends."""


@contextmanager
def grpc_server(servicer: SensorsimServicer, *, host: str, port: int) -> Iterator[int]:
    """Serve as long as the block runs; gives the port, which 0 leaves to the system.

    Raises:
        ConfigError: the port cannot be had.
        MissingPackageError: gRPC is not installed.
    """
    grpc = grpc_package()
    from grpc_health.v1 import health, health_pb2, health_pb2_grpc

    size = [(f"grpc.max_{way}_message_length", MOST_BYTES) for way in ("send", "receive")]
    pool = ThreadPoolExecutor(servicer.queue.most_waiting + SPARE_THREADS, "call")
    server = grpc.server(pool, options=[*size, ("grpc.so_reuseport", 0)])
    server.add_generic_rpc_handlers(handlers(servicer, answering))
    state = health.HealthServicer()
    health_pb2_grpc.add_HealthServicer_to_server(state, server)
    _add_reflection(server)
    listening(host, port).close()  # gRPC would write lines of its own about a port it cannot have
    bound = server.add_insecure_port(f"{host}:{port}")
    for name in ("", *service_names()):
        state.set(name, health_pb2.HealthCheckResponse.SERVING)
    server.start()
    try:
        yield bound
    finally:
        state.enter_graceful_shutdown()
        servicer.queue.close()
        server.stop(GRACE_S).wait(2 * GRACE_S)
        pool.shutdown(wait=False, cancel_futures=True)


def described_services() -> Message:
    """Descriptors of the service under each of its names."""
    from grpc_health.v1 import health_pb2

    pool = DescriptorPool()
    for known in (common_pb2, health_pb2):
        pool.AddSerializedFile(known.DESCRIPTOR.serialized_pb)
    own = descriptor_pb2.FileDescriptorProto.FromString(sensorsim_pb2.DESCRIPTOR.serialized_pb)
    for package in PACKAGES:
        text = text_format.MessageToString(own).replace(PACKAGES[0], package)
        file = text_format.Parse(text, descriptor_pb2.FileDescriptorProto())
        file.name = f"{package}/{own.name}"
        pool.Add(file)
    return pool


def _add_reflection(server: "grpc.Server") -> None:
    from grpc_health.v1 import health
    from grpc_reflection.v1alpha import reflection

    names = (*service_names(), health.SERVICE_NAME, reflection.SERVICE_NAME)
    reflection.enable_server_reflection(names, server, pool=described_services())
