"""The service as it is called over the wire: its names, its calls, both ends of them.

Clients of different age know the service by different package names; messages and calls are the
same, so one servicer answers under all of them.
"""

import socket
from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from google.protobuf.message_factory import GetMessageClass

from lidarpainter_models.errors import ConfigError, MissingPackageError
from lidarpainter_models.serving.protos import Message, sensorsim_pb2

if TYPE_CHECKING:
    import grpc

Call = Callable[..., Message]
SERVICE = "SensorsimService"
PACKAGES = ("nre.grpc.protos.sensorsim", "sensorsim", "nurec.grpc.protos.sensorsim")
"""Packages that clients look for the service in; the first one is that of our descriptors."""
MOST_BYTES = 64 * 2**20
"""Of one message, in both directions: what clients allow."""


def grpc_package() -> Any:  # noqa: ANN401  a module
    """The package `grpc`.

    Raises:
        MissingPackageError: it is not installed.
    """
    try:
        import grpc
    except ImportError:
        raise MissingPackageError(
            "simulators are spoken to by grpcio, which is not installed: "
            "pip install 'lidarpainter[simulators]'"
        ) from None
    return grpc


def listening(host: str, port: int) -> socket.socket:
    """A socket that listens; port 0 is any.

    Raises:
        ConfigError: the port cannot be had.
    """
    try:
        return socket.create_server((host, port))
    except OSError:
        raise ConfigError(
            f"port {port} of {host} cannot be had: it is in use or not allowed"
        ) from None


def service_names() -> tuple[str, ...]:
    """The full names that the service answers to."""
    return tuple(f"{package}.{SERVICE}" for package in PACKAGES)


def calls() -> dict[str, tuple[Any, Any]]:
    """Of every call its message and that of its reply."""
    found = sensorsim_pb2.DESCRIPTOR.services_by_name[SERVICE].methods
    return {
        method.name: (GetMessageClass(method.input_type), GetMessageClass(method.output_type))
        for method in found
    }


def handlers(
    servicer: object, wrapped: Callable[[Call], Call] = lambda call: call
) -> list["grpc.GenericRpcHandler"]:
    """What a server registers so that `servicer` answers every call under every name.

    Each call is a method of its own name, which takes the message and gRPC's context.
    """
    grpc = grpc_package()
    methods = {
        name: grpc.unary_unary_rpc_method_handler(
            wrapped(getattr(servicer, name)),
            request_deserializer=request.FromString,
            response_serializer=reply.SerializeToString,
        )
        for name, (request, reply) in calls().items()
    }
    return [grpc.method_handlers_generic_handler(name, methods) for name in service_names()]


def client(channel: "grpc.Channel", package: str = PACKAGES[0]) -> SimpleNamespace:
    """The calls of a server at the other end of a channel, each a function of its message."""
    return SimpleNamespace(
        **{
            name: channel.unary_unary(
                f"/{package}.{SERVICE}/{name}",
                request_serializer=request.SerializeToString,
                response_deserializer=reply.FromString,
            )
            for name, (request, reply) in calls().items()
        }
    )
