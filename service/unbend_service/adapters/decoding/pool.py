"""Decoders, as many as are needed at once and no more than are allowed."""

from __future__ import annotations

import queue
import signal
from typing import Any

import structlog

from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.decoding.process import DecoderDiedError, DecoderProcess, Verdict
from unbend_service.adapters.decoding.sheets import Sheets
from unbend_service.application.ports import Meter
from unbend_service.domain.dense_maps import MAX_MAP_PIXELS
from unbend_service.domain.errors import ImageTooCostly, InvalidImage, Unavailable, UnbendError
from unbend_service.settings import Settings

log = structlog.get_logger(__name__)

#: Warm memory that is kept for the next picture.
_KEPT_BYTES = 256 << 20
#: More are started when they are needed.
_STARTED_AT_ONCE = 2


class DecoderPool:
    """Has files decoded in processes of their own. Thread-safe; blocking.

    A decoder that dies, hangs or runs out of memory takes nothing with it but the file it had, and is replaced.

    Args:
        settings: ``decoders``, ``decode_memory_bytes``, ``decode_deadline_s``, ``pictures_bytes``, ``source_pixels``
            and ``animation_frames`` are used.
        meter: told of decoders that had to be replaced.
    """

    def __init__(self, settings: Settings, meter: Meter) -> None:
        self._meter = meter
        self._deadline_s = settings.decode_deadline_s
        self._begin = {
            "source_pixels": settings.source_pixels,
            "animation_frames": settings.animation_frames,
            "memory_bytes": settings.decode_memory_bytes,
        }
        self._most_bytes = max(4 * settings.source_pixels, 8 * MAX_MAP_PIXELS, 1 << 20)
        self._sheets = Sheets(settings.pictures_bytes, _KEPT_BYTES, "pictures_bytes")
        self._count = settings.decoders or usable_cores()
        # last in, first out: those that worked last are warm, and those that are not needed are never started
        self._seats: queue.LifoQueue[DecoderProcess | None] = queue.LifoQueue()
        for _ in range(self._count):
            self._seats.put(None)
        self._closed = False

    def start(self) -> None:
        """Starts the first decoders, and does not wait until they are ready."""
        started = min(self._count, _STARTED_AT_ONCE)
        seats = [self._seats.get() for _ in range(started)]
        for seat in seats:
            self._seats.put(seat or self._started())

    def work(self, work: str, body: bytes, **options: Any) -> Verdict:
        """What comes of a file.

        Raises:
            InvalidImage, TooManyPixels, UnsupportedMediaType, InvalidGrid ...: the verdict of the decoder; InvalidImage
                too when the file crashes it.
            ImageTooCostly: it takes too long or too much memory.
            MemoryFull: the decoded pictures that are held leave no room.
            Unavailable: no decoder can be started.
        """
        for attempt in (1, 2):
            try:
                return self._once(work, body, options)
            except DecoderDiedError as error:
                killed = error.status is None or error.status in (-signal.SIGKILL, 0)
                self._meter.worker_restarted("decoder_killed" if killed else "decoder_crashed")
                log.warning("decoder died", status=error.status, work=work, size_bytes=len(body), attempt=attempt)
                if not killed:
                    raise InvalidImage("The decoder crashed over this file.") from error
        raise ImageTooCostly("The decoder was killed over this file, twice.")

    def pids(self) -> list[int]:
        """Of the decoders that have nothing to do just now."""
        return [seat.pid for seat in list(self._seats.queue) if seat is not None]

    def close(self) -> None:
        """Ends the decoders; one that works is ended by whoever waits for it."""
        self._closed = True
        while True:
            try:
                seat = self._seats.get_nowait()
            except queue.Empty:
                break
            if seat is not None:
                seat.end()
        self._sheets.close()

    def _once(self, work: str, body: bytes, options: dict[str, Any]) -> Verdict:
        seat = self._seats.get()
        process = seat
        try:
            if process is not None and process.gone:  # not this file's fault
                self._meter.worker_restarted("decoder_killed")
                process.end()
                process = None
            process = process or self._started()
            return process.work(work, body, options, self._sheets, self._most_bytes, self._deadline_s)
        except ImageTooCostly:
            self._meter.worker_restarted("decoder_exhausted")
            raise
        except (DecoderDiedError, UnbendError):
            raise
        except BaseException:
            if process is not None:
                process.end()  # in the middle of something
            raise
        finally:
            if process is not None and (process.exhausted or self._closed):
                process.end()
                process = None
            self._seats.put(process)

    def _started(self) -> DecoderProcess:
        try:
            return DecoderProcess(self._begin)
        except OSError as error:
            raise Unavailable(f"No decoder can be started: {error.strerror}.", retry_after_s=1.0) from error
