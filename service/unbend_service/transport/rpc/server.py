"""The gRPC server: which services it has and how its transport is set for video frames."""

from __future__ import annotations

from collections.abc import Iterator

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection, reflection_pb2

from unbend.v1 import correction_pb2, estimation_pb2, estimation_pb2_grpc, grid_pb2, grid_pb2_grpc
from unbend_service.application.service import Service
from unbend_service.settings import Settings
from unbend_service.transport.rpc.calls import CallInterceptor
from unbend_service.transport.rpc.correction import SERVICE, CorrectionServicer, add_to_server
from unbend_service.transport.rpc.estimation import EstimationServicer
from unbend_service.transport.rpc.grids import GridServicer
from unbend_service.transport.rpc.health import HealthServicer
from unbend_service.transport.rpc.scopes import check
from unbend_service.transport.tls import Certificates

_SERVICES = (
    estimation_pb2.DESCRIPTOR.services_by_name["EstimationService"].full_name,
    SERVICE,
    grid_pb2.DESCRIPTOR.services_by_name["GridService"].full_name,
)
_HEALTH = "grpc.health.v1.Health"


def server_options(settings: Settings) -> list[tuple[str, int]]:
    """Channel arguments.

    A video frame is megabytes: with gRPC's defaults it travels in frames of 16 KiB, each with its own bookkeeping, and
    waits for a flow-control window that grows from 64 KiB by probing. With large frames and a fixed window of about one
    raw 1080p frame it is sent at once.
    """
    return [
        ("grpc.max_receive_message_length", settings.grpc_message_bytes),
        ("grpc.max_send_message_length", -1),  # an answer is as large as what was accepted
        ("grpc.http2.max_frame_size", (1 << 24) - 1),
        ("grpc.http2.lookahead_bytes", 4 << 20),  # per stream, buffered before it is read
        ("grpc.http2.bdp_probe", 0),
        ("grpc.keepalive_time_ms", 30_000),  # finds clients that vanished without a word
        ("grpc.keepalive_timeout_ms", 10_000),
        ("grpc.keepalive_permit_without_calls", 1),
        ("grpc.http2.min_ping_interval_without_data_ms", 10_000),  # clients may ping as often as ours does
        ("grpc.http2.max_ping_strikes", 3),
        ("grpc.server_handshake_timeout_ms", round(1000 * settings.handshake_s)),
        ("grpc.max_metadata_size", settings.grpc_metadata_bytes),
        ("grpc.absolute_max_metadata_size", 2 * settings.grpc_metadata_bytes),  # between the two refusal is by chance
        ("grpc.max_concurrent_streams", settings.grpc_calls),  # of one connection
        ("grpc.so_reuseport", 0),  # a second server on the port is a mistake, not a load balancer
    ]


def create_server(service: Service, settings: Settings) -> grpc.aio.Server:
    """A server with all services, not yet listening. Must be called in a running event loop."""
    check(_methods())
    server = grpc.aio.server(
        interceptors=(CallInterceptor(service),),
        options=server_options(settings),
        maximum_concurrent_rpcs=settings.grpc_calls,  # of all connections
    )
    estimation_pb2_grpc.add_EstimationServiceServicer_to_server(
        EstimationServicer(service.estimation, settings), server
    )
    add_to_server(CorrectionServicer(service.correction, service.streams, settings), server)
    grid_pb2_grpc.add_GridServiceServicer_to_server(GridServicer(service.grids), server)
    health_pb2_grpc.add_HealthServicer_to_server(HealthServicer(service, _SERVICES), server)
    reflection.enable_server_reflection((*_SERVICES, _HEALTH, reflection.SERVICE_NAME), server)
    service.admission.on_drain(service.streams.drain)
    return server


def _methods() -> Iterator[str]:
    """The full name of every method that the server has."""
    for file in (estimation_pb2, correction_pb2, grid_pb2, health_pb2, reflection_pb2):
        for service in file.DESCRIPTOR.services_by_name.values():
            for method in service.methods:
                yield f"/{service.full_name}/{method.name}"


async def start_server(
    service: Service, settings: Settings, certificates: Certificates | None = None
) -> tuple[grpc.aio.Server, int]:
    """A server that listens, and the port that it took; in plain text without certificates.

    Raises:
        OSError: the address is taken.
    """
    server = create_server(service, settings)
    host = f"[{settings.grpc_host}]" if ":" in settings.grpc_host else settings.grpc_host
    address = f"{host}:{settings.grpc_port}"
    try:
        if certificates is None:
            port = server.add_insecure_port(address)
        else:
            port = server.add_secure_port(address, certificates.grpc())
    except RuntimeError as error:
        raise OSError(f"gRPC cannot listen on {address}") from error
    await server.start()
    return server, port
