"""``AsyncClient``: the service from an event loop."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from types import TracebackType
from typing import Any, TypeVar, Unpack

import grpc

from unbend import _calls as calls
from unbend import _types as types
from unbend._async_stream import AsyncStream
from unbend._channel import PathLike, open_channel, to_credentials, to_metadata
from unbend._client import DEFAULT_TARGET
from unbend._errors import Closed
from unbend._failures import translate
from unbend._images import FrameLayout
from unbend._options import CorrectOptions, EstimateOptions, StreamKeywords
from unbend._retries import Attempts
from unbend._stream_core import StreamOptions

T = TypeVar("T")


class AsyncClient:
    """A connection to an Unbend service; everything is as of :class:`unbend.Client`, but awaited.

    >>> async def straighten(image):
    ...     async with unbend.AsyncClient("127.0.0.1:50051") as client:
    ...         return (await client.correct(image)).image
    >>> asyncio.run(straighten(np.zeros((48, 64, 3), np.uint8))).shape
    (48, 64, 3)
    """

    def __init__(
        self,
        target: str = DEFAULT_TARGET,
        *,
        timeout_s: float = 30.0,
        retries: int = 2,
        token: str | None = None,
        tls: bool = False,
        ca_file: PathLike | None = None,
        cert_file: PathLike | None = None,
        key_file: PathLike | None = None,
        credentials: grpc.ChannelCredentials | None = None,
        metadata: Sequence[tuple[str, str]] = (),
        shared_memory: str | os.PathLike[str] | None = None,
    ) -> None:
        self._metadata = to_metadata(token, metadata)
        self._channel = open_channel(target, to_credentials(credentials, tls, ca_file, cert_file, key_file))
        self._timeout_s = timeout_s
        self._retries = retries
        self._shared_memory = None if shared_memory is None else os.fspath(shared_memory)
        self._closed = False
        self.grids = AsyncGrids(self)

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Ends the connection and the calls under way."""
        self._closed = True
        await asyncio.to_thread(self._channel.close)

    async def correct(
        self, image: types.Image, *, grid: calls.GridLike | None = None, **options: Unpack[CorrectOptions]
    ) -> types.Correction:
        """Straightens one picture; see :meth:`unbend.Client.correct`."""
        if isinstance(grid, types.Grid | types.Guides):
            grid = await self.grids.put(grid)
        return await self._run(calls.correct_call(image, calls.grid_id_of(grid), **options))

    async def estimate(self, image: types.Image, **options: Unpack[EstimateOptions]) -> types.Estimate:
        """Says how a picture is bent, without drawing it; see :meth:`unbend.Client.estimate`."""
        return await self._run(calls.estimate_call(image, **options))

    def stream(
        self,
        width: int | None = None,
        height: int | None = None,
        pixel_format: str = "rgb24",
        **options: Unpack[StreamKeywords],
    ) -> AsyncStream:
        """A stream of frames, to be used in an ``async with`` block; see :meth:`unbend.Client.stream`."""
        self._check_open()
        layout = FrameLayout.of(pixel_format, width, height)
        return AsyncStream(
            self._channel, self._metadata, layout, StreamOptions(**options), self._timeout_s, self._shared_memory
        )

    async def _run(self, call: calls.Call[T]) -> T:
        self._check_open()
        method = self._channel.unary_unary(call.method, calls.serialize, call.answer.FromString)
        attempts = Attempts(self._timeout_s, self._retries, call.repeatable)
        while True:
            try:
                answer = await _awaited(method.future(call.request, timeout=attempts.left_s, metadata=self._metadata))
            except grpc.RpcError as error:
                pause_s = attempts.pause_s(translate(error))
            else:
                return call.parse(answer)
            await asyncio.sleep(pause_s)

    def _check_open(self) -> None:
        if self._closed:
            raise Closed("The client was closed.")


class AsyncGrids:
    """The grids that the server keeps; ``client.grids``.

    >>> async def keep(image):
    ...     async with unbend.AsyncClient("127.0.0.1:50051") as client:
    ...         estimate = await client.estimate(image)
    ...         return (await client.grids.get(estimate.grid_id)).outcome
    >>> asyncio.run(keep(np.zeros((48, 64, 3), np.uint8)))
    <Outcome.CORRECTED: 'corrected'>
    """

    def __init__(self, client: AsyncClient) -> None:
        self._client = client

    async def get(self, grid_id: str) -> types.GridRecord:
        """A stored grid with its lattice and guides. Raises GridNotFound."""
        return await self._client._run(calls.get_grid_call(grid_id))

    async def put(self, content: types.Grid | types.Guides) -> types.GridRecord:
        """Stores a lattice, or the one that guides span. Raises InvalidGrid, FoldedGrid, InvalidGuides."""
        return await self._client._run(calls.put_grid_call(content))

    async def delete(self, grid_id: str) -> None:
        """Forgets a grid. Raises GridNotFound."""
        await self._client._run(calls.delete_grid_call(grid_id))


async def _awaited(call: Any) -> Any:
    """The result of a call under way, which is cancelled with the task that awaits it."""
    loop = asyncio.get_running_loop()
    finished = asyncio.Event()

    def tell(_: Any) -> None:
        if not loop.is_closed():
            loop.call_soon_threadsafe(finished.set)

    call.add_done_callback(tell)
    try:
        await finished.wait()
    except asyncio.CancelledError:
        call.cancel()
        raise
    return call.result()
