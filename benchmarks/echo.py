"""The bare peer of the streams: a gRPC echo of the same messages, in a process of its own, tuned alike."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager

import grpc

from unbend_service.settings import Settings
from unbend_service.transport.rpc.server import server_options

METHOD = "/benchmarks.Echo/Stream"


@contextmanager
def echo_served() -> Iterator[str]:
    """The echo as a process; gives its host:port."""
    process = subprocess.Popen([sys.executable, "-m", "benchmarks.echo"], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield f"127.0.0.1:{int(process.stdout.readline())}"
    finally:
        process.terminate()
        process.wait(10)
        process.stdout.close()


async def _stream(requests: AsyncIterator[bytes], context: grpc.aio.ServicerContext[bytes, bytes]) -> None:
    async for request in requests:
        await context.write(request)


async def _serve() -> None:
    server = grpc.aio.server(options=server_options(Settings()))
    handler = grpc.stream_stream_rpc_method_handler(_stream)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("benchmarks.Echo", {"Stream": handler}),))
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    print(port, flush=True)
    await server.wait_for_termination()


if __name__ == "__main__":
    try:
        import uvloop

        uvloop.run(_serve())
    except (KeyboardInterrupt, asyncio.CancelledError):
        pass
