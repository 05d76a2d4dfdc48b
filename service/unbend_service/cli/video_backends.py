"""Who estimates and draws the frames of a video: a private service, or a server."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass

import numpy as np

import unbend
from unbend_service.application.correction import CorrectOptions, leaves_alone
from unbend_service.application.service import Service
from unbend_service.application.video import DrawFrame, estimate_over
from unbend_service.cli.grid_source import record_of, translated
from unbend_service.cli.private import private_service
from unbend_service.cli.server import Server
from unbend_service.domain.errors import InvalidFrame
from unbend_service.domain.frames import Bytes, Frame
from unbend_service.domain.orientation import Orientation
from unbend_service.domain.records import GridRecord
from unbend_service.settings import Settings


@dataclass(frozen=True, slots=True)
class Prepared:
    """A grid, and what draws through it.

    Attributes:
        window: frames that are worth having under way at once.
    """

    record: GridRecord
    draw: DrawFrame
    window: int


class PrivateBackend:
    """The use cases inside this process."""

    def __init__(self, service: Service) -> None:
        self._service = service

    async def prepare(
        self,
        samples: Sequence[Frame],
        given: GridRecord | None,
        options: CorrectOptions,
        orientation: Orientation,
    ) -> Prepared:
        """Fixes the grid: ``given``, or one that is estimated over ``samples``; both are of the pictures as shown.

        Args:
            orientation: how the frames that are drawn are shown.
        """
        correction = self._service.correction
        record = given or await estimate_over(
            samples, self._service.estimation, self._service.blocking, options.correct, options.min_confidence
        )
        if leaves_alone(record):
            return Prepared(record, _unchanged, 4)
        grid = orientation.stored(await correction.fitted(record, options))

        async def draw(frame: Frame) -> Bytes:
            return await correction.draw(frame, grid, options.border)

        return Prepared(record, draw, 4 * max(1, correction.render_workers))


class ServerBackend:
    """A server that is running somewhere."""

    def __init__(self, client: unbend.AsyncClient, server: Server) -> None:
        self._client = client
        self._server = server

    async def prepare(
        self,
        samples: Sequence[Frame],
        given: GridRecord | None,
        options: CorrectOptions,
        orientation: Orientation,
    ) -> Prepared:
        """As :meth:`PrivateBackend.prepare`, by the server."""
        try:
            record = given or await self._estimated(samples, options)
            if leaves_alone(record):
                return Prepared(record, _unchanged, 4)
            drawn = orientation.stored(record.grid)
            await self._client.grids.put(unbend.Grid(drawn.source))
        except unbend.UnbendError as error:
            raise translated(error, self._server) from error

        async def draw(frame: Frame) -> Bytes:
            try:
                answer = await self._client.correct(
                    _array(frame), pixel_format="i420", grid=drawn.id, fit=str(options.fit), strength=options.strength
                )
            except unbend.UnbendError as error:
                raise translated(error, self._server) from error
            return np.asarray(answer.image, dtype=np.uint8).reshape(-1)

        return Prepared(record, draw, 8)

    async def _estimated(self, samples: Sequence[Frame], options: CorrectOptions) -> GridRecord:
        """One estimate over several frames is what a stream makes over its first ones."""
        if not samples:
            raise InvalidFrame("The video has no picture.")
        stream = self._client.stream(
            samples[0].width,
            samples[0].height,
            "i420",
            correct=options.correct.value,
            fit=str(options.fit),
            strength=options.strength,
            frames=len(samples),
            min_confidence=options.min_confidence,
        )
        async with stream:
            async for _ in stream.correct([_array(frame) for frame in samples]):
                pass
            grid = stream.grid
        if grid is None:
            raise InvalidFrame("The server gave the stream no grid.")
        return record_of(await self._client.grids.get(grid.grid_id))


@asynccontextmanager
async def opened_backend(settings: Settings, server: Server | None) -> AsyncIterator[PrivateBackend | ServerBackend]:
    """A private service that is started and ended here, or the server at ``host:port``."""
    if server is None:
        async with private_service(settings) as service:
            yield PrivateBackend(service)
    else:
        try:
            client = unbend.AsyncClient(server.address, **server.arguments)
        except unbend.UnbendError as error:
            raise translated(error, server) from error
        async with client:
            yield ServerBackend(client, server)


async def _unchanged(frame: Frame) -> Bytes:
    return frame.data


def _array(frame: Frame) -> Bytes:
    """(height * 3 / 2, width) uint8, as the client takes i420."""
    if frame.width % 2 or frame.height % 2:
        raise InvalidFrame("A server takes i420 of even sizes only.", allowed="a private service, without --server")
    return frame.data.reshape(frame.height * 3 // 2, frame.width)
