"""``AsyncStream``: frames in, corrected frames out, in an event loop."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, AsyncIterator, Iterable
from types import TracebackType

import grpc

from unbend import _types as types
from unbend._channel import Metadata
from unbend._connection import Connection, Event
from unbend._errors import Closed, DeadlineExceeded, ServerFault, TooManyRegions, Unavailable, UnbendError
from unbend._images import FrameLayout
from unbend._memory import FrameMemory
from unbend._stream_core import StreamCore, StreamOptions, split

Item = types.Image | tuple[types.Image, int]


class AsyncStream:
    """One stream of frames; made by :meth:`unbend.AsyncClient.stream`, used in an ``async with`` block by one task.

    Everything is as of :class:`unbend.Stream`, but answers are given as soon as they are there, while the next frame
    is waited for.

    >>> async def watch(frames):
    ...     async with unbend.AsyncClient("127.0.0.1:50051") as client:
    ...         async with client.stream(64, 48, "gray8") as stream:
    ...             return [result.index async for result in stream.correct(frames)]
    >>> asyncio.run(watch([np.zeros((48, 64), np.uint8)] * 3))
    [0, 1, 2]
    """

    def __init__(
        self,
        channel: grpc.Channel,
        metadata: Metadata,
        layout: FrameLayout,
        options: StreamOptions,
        timeout_s: float,
        shared_memory: str | None = None,
    ) -> None:
        self._channel = channel
        self._metadata = metadata
        self._timeout_s = timeout_s
        self._shared_memory = shared_memory
        self._memory: FrameMemory | None = None
        self._core = StreamCore(layout, options)
        self._inbox: asyncio.Queue[Event] = asyncio.Queue()
        self._connection: Connection | None = None
        self._finishing = False
        self._closed = False

    @property
    def stream_id(self) -> str:
        """Under which the stream can be opened again; known once it is open."""
        return self._core.stream_id

    @property
    def grid(self) -> types.GridRecord | None:
        """The grid of the stream, before fit and strength; None until it is fixed."""
        return self._core.grid

    @property
    def resumed(self) -> bool:
        """Whether the server knew the stream id and reuses its grid."""
        return self._core.resumed

    async def __aenter__(self) -> AsyncStream:
        try:
            await self._connect()
            while not self._core.opened:
                if await self._handle(await self._event()) is not None:
                    raise ServerFault("The server answered before the stream was open.")
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def correct(self, frames: AsyncIterable[Item] | Iterable[Item]) -> AsyncIterator[types.StreamResult]:
        """Answers ``frames``, in their order, each exactly once; see :meth:`unbend.Stream.correct`."""
        if self._closed:
            raise Closed("The stream was closed.")
        if self._core.is_waiting:  # an iteration before this one was given up
            await self._disconnect()
            self._core.forget()
        source = aiter(frames) if isinstance(frames, AsyncIterable) else _each(frames)
        pulling: asyncio.Task[Item | None] | None = None
        taking: asyncio.Task[Event] | None = None
        exhausted = False
        try:
            while not exhausted or self._core.is_waiting:
                if pulling is None and not exhausted and self._core.has_room:
                    pulling = asyncio.create_task(_next(source))
                if taking is None and self._core.is_waiting:
                    taking = asyncio.create_task(self._event())
                under_way = [task for task in (pulling, taking) if task is not None]
                done, _ = await asyncio.wait(under_way, return_when=asyncio.FIRST_COMPLETED)
                if taking is not None and taking in done:
                    event, taking = taking.result(), None
                    if (result := await self._handle(event)) is not None:
                        yield result
                if pulling is not None and pulling in done:
                    item, pulling = pulling.result(), None
                    if item is not None:
                        await self._send(*split(item))
                    else:
                        exhausted = True
                        if self._core.is_waiting and self._core.grid is None:
                            self._finish()  # so that the grid is not waited for: no further frames come for it
            if self._finishing and self._connection is not None:
                await asyncio.to_thread(self._connection.join)
                await self._disconnect()
        finally:
            for task in (pulling, taking):
                if task is not None:
                    task.cancel()
                    await asyncio.gather(task, return_exceptions=True)

    async def close(self) -> None:
        """Ends the stream; frames that are not answered are given up. The server remembers the grid."""
        if self._closed:
            return
        self._closed = True
        if self._connection is not None and self._core.opened and not self._core.is_waiting:
            self._connection.finish()
            await asyncio.to_thread(self._connection.join)
        await self._disconnect()

    async def _connect(self) -> None:
        inbox: asyncio.Queue[Event] = asyncio.Queue()
        loop = asyncio.get_running_loop()

        def deliver(event: Event) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(inbox.put_nowait, event)

        self._inbox = inbox
        if self._shared_memory is not None:
            try:
                self._memory = await asyncio.to_thread(self._core.new_memory, self._shared_memory, self._timeout_s)
            except (TooManyRegions, Unavailable) as error:  # later it may do
                inbox.put_nowait(error)
                return
        self._connection = Connection(self._channel, self._metadata, deliver)
        for request in self._core.first(self._memory):
            self._connection.send(request)
        if self._finishing:
            self._connection.finish()

    async def _disconnect(self) -> None:
        connection, self._connection = self._connection, None
        self._finishing = False
        if connection is not None:
            connection.close()
            await asyncio.to_thread(connection.join)
        if self._memory is not None:
            self._memory.close()
            self._memory = None

    def _finish(self) -> None:
        self._finishing = True
        if self._connection is not None:
            self._connection.finish()

    async def _send(self, image: types.Image, timestamp_us: int) -> None:
        request = self._core.accept(image, timestamp_us)
        if self._connection is None:
            await self._connect()
        else:
            self._connection.send(request)

    async def _event(self) -> Event:
        try:
            async with asyncio.timeout(self._timeout_s):
                return await self._inbox.get()
        except TimeoutError:
            raise DeadlineExceeded(f"The server did not answer within {self._timeout_s:g} s.") from None

    async def _handle(self, event: Event) -> types.StreamResult | None:
        if event is None or isinstance(event, UnbendError):
            await self._reconnect(event)
            return None
        return self._core.receive(event)

    async def _reconnect(self, error: UnbendError | None) -> None:
        finishing = self._finishing
        await self._disconnect()
        pause_s = self._core.lost(error)
        if self._core.is_waiting or not self._core.opened:
            await asyncio.sleep(pause_s)
            self._finishing = finishing
            await self._connect()


async def _next(source: AsyncIterator[Item]) -> Item | None:
    return await anext(source, None)


async def _each(frames: Iterable[Item]) -> AsyncIterator[Item]:
    for frame in frames:
        yield frame
