"""The service's side of one decoder."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from unbend_service.adapters.decoding.sheets import Sheets
from unbend_service.adapters.decoding.wire import Wire
from unbend_service.adapters.renderers.slots import Slot
from unbend_service.application.ports import Bytes
from unbend_service.domain import errors
from unbend_service.domain.errors import ImageTooCostly, InvalidImage, Unavailable, UnbendError

#: What a decoder may say of a file; anything else that it says is of no account.
_VERDICTS: dict[str, type[UnbendError]] = {
    kind.code: kind
    for kind in (
        errors.InvalidImage,
        errors.TooManyPixels,
        errors.ImageTooCostly,
        errors.UnsupportedMediaType,
        errors.EmptyBody,
        errors.InvalidGrid,
        errors.InvalidOption,
        errors.Unavailable,
    )
}
#: A decoder gets what the loader and Python need, and nothing that the service was told.
_ENVIRONMENT = (
    "PATH",
    "PYTHONPATH",
    "PYTHONHOME",
    "LD_LIBRARY_PATH",
    "LANG",
    "LC_ALL",
    "HOME",
    "TMPDIR",
)
_THREAD_LIMITS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_LONGEST_TEXT = 1000
_MOST_SHEETS = 3
#: A decoder ends by itself when its wire is closed, unless it hangs.
_PATIENCE_S = 0.3
_START_PATIENCE_S = 60.0


class DecoderDiedError(Exception):
    """The process ended while it had a file; ``status`` as subprocess has it."""

    def __init__(self, status: int | None) -> None:
        super().__init__(f"exit status {status}")
        self.status = status


@dataclass(frozen=True, slots=True)
class Verdict:
    """What came of a file.

    Attributes:
        fields: as the decoder said, unchecked.
        parts: what it wrote, in the order in which it asked for memory, each (n,) uint8.
    """

    fields: dict[str, Any]
    parts: tuple[Bytes, ...]


class DecoderProcess:
    """A started decoder. Not thread-safe: one caller has it at a time.

    Args:
        begin: ``source_pixels``, ``animation_frames`` and ``memory_bytes``.
    """

    def __init__(self, begin: dict[str, int]) -> None:
        self._wire, theirs = Wire.pair()
        environment = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
        try:
            self._process = subprocess.Popen(
                # -P: a file of the working directory must not stand in for a module of the service
                [sys.executable, "-P", "-m", "unbend_service.adapters.decoding.decoder", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,  # libraries write there what files make them say
                process_group=0,  # an interrupt from the keyboard is for the parent to decide on
                pass_fds=(theirs.fileno(),),
                env={**dict.fromkeys(_THREAD_LIMITS, "1"), **environment},
            )
        except OSError:
            self._wire.close()
            raise
        finally:
            theirs.close()
        self.exhausted = False
        self._ready = False
        with suppress(OSError):  # it is gone already, as the wire will show
            self._wire.send(begin)

    @property
    def gone(self) -> bool:
        """Whether it ended while nobody looked."""
        return self._process.poll() is not None

    @property
    def pid(self) -> int:
        return self._process.pid

    def work(
        self, work: str, body: bytes, options: dict[str, Any], sheets: Sheets, most_bytes: int, deadline_s: float
    ) -> Verdict:
        """Has one file looked at.

        Args:
            most_bytes: that it may ask for at a time.

        Raises:
            DecoderDiedError: it ended, or said what no decoder says.
            ImageTooCostly: it was not done within ``deadline_s``, and is ended.
            InvalidInput: its verdict.
            MemoryFull: there is no memory for its answer.
            Unavailable: it did not start.
        """
        self._await_ready()
        end_s = time.monotonic() + deadline_s
        lent: list[Bytes] = []
        refusal: UnbendError | None = None
        source = sheets.acquire(len(body))
        try:
            source.memory[: len(body)] = np.frombuffer(body, np.uint8)
            self._wire.send({"work": work, "size": len(body), **options}, source.fd)
            while True:
                message, fd = self._wire.receive(max(0.001, end_s - time.monotonic()))
                if fd is not None:
                    os.close(fd)
                if "need" not in message:
                    break
                try:
                    self._grant(message["need"], most_bytes, sheets, lent)
                except UnbendError as error:
                    refusal = error
                    self._wire.send({"size": 0})
        except TimeoutError as error:
            self.end()
            raise ImageTooCostly(
                f"Decoding the file took longer than {deadline_s:g} s.", setting="decode_deadline_s"
            ) from error
        except (EOFError, OSError) as error:
            raise DecoderDiedError(self.end()) from error
        finally:
            sheets.release(source)
        self.exhausted = message.get("last") is not False
        if refusal is not None:
            raise refusal
        if "error" in message:
            raise _verdict(message)
        if not isinstance(message.get("done"), dict):
            raise DecoderDiedError(self.end())
        return Verdict(message["done"], tuple(lent))

    def _await_ready(self) -> None:
        """Its start does not count against its first file."""
        if self._ready:
            return
        try:
            message, fd = self._wire.receive(_START_PATIENCE_S)
        except (TimeoutError, EOFError, OSError) as error:
            self.end()
            raise Unavailable("The decoder did not start.", retry_after_s=1.0) from error
        if fd is not None:
            os.close(fd)
        self._ready = message == {"ready": True}

    def _grant(self, need: object, most_bytes: int, sheets: Sheets, lent: list[Bytes]) -> None:
        if type(need) is not int or not need > 0 or len(lent) >= _MOST_SHEETS:
            raise EOFError
        if need > most_bytes:
            raise ImageTooCostly(f"The decoded file takes {need} bytes.", allowed=f"{most_bytes} bytes")
        sheet: Slot = sheets.acquire(need)
        lent.append(sheets.lend(sheet, need))
        self._wire.send({"size": need}, sheet.fd)

    def end(self) -> int | None:
        """Ends the process; returns how it ended, -N for signal N, None if it had to be killed."""
        self.exhausted = True
        self._wire.close()
        try:
            return self._process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            return None


def _verdict(message: dict[str, Any]) -> UnbendError:
    kind = _VERDICTS.get(str(message.get("error")), InvalidImage)
    allowed, setting = message.get("allowed"), message.get("setting")
    return kind(
        str(message.get("message"))[:_LONGEST_TEXT],
        allowed=str(allowed)[:_LONGEST_TEXT] if allowed else None,
        setting=str(setting)[:_LONGEST_TEXT] if setting else None,
    )
