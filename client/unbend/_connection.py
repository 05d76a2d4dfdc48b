"""One connection of a stream: a CorrectStream call whose events are delivered from a thread.

Both faces of the client use grpc's synchronous channel: its status is right when the server ends a call while the
client is still sending, which that of grpc.aio is not (grpc/grpc#36066), and it is bound to no event loop.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator

import grpc

from unbend._channel import Metadata
from unbend._errors import UnbendError
from unbend._failures import translate
from unbend._stream_core import Answer, read_response

#: A response, the error that the call ended with, or None for its regular end. Nothing comes after an end.
Event = Answer | UnbendError | None

_METHOD = "/unbend.v1.CorrectionService/CorrectStream"
_THREAD_S = 5.0


class Connection:
    """A call under way.

    Args:
        deliver: called with each event, from a thread of the connection.
    """

    def __init__(self, channel: grpc.Channel, metadata: Metadata, deliver: Callable[[Event], None]) -> None:
        self._requests: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._deliver = deliver
        method = channel.stream_stream(_METHOD, None, read_response)
        self._call = method(self._outgoing(), metadata=metadata)
        self._thread = threading.Thread(target=self._read, name="unbend-stream", daemon=True)
        self._thread.start()

    def send(self, request: bytes) -> None:
        """Hands a serialized request over; never blocks."""
        self._requests.put(request)

    def finish(self) -> None:
        """Says that no further request will come."""
        self._requests.put(None)

    def close(self) -> None:
        """Gives the call up, if it has not ended."""
        self._requests.put(None)
        self._call.cancel()  # type: ignore[no-untyped-call] # of the stubs

    def join(self) -> None:
        """Waits for the thread, after the end or :meth:`close`."""
        self._thread.join(_THREAD_S)

    def _outgoing(self) -> Iterator[bytes]:
        while (request := self._requests.get()) is not None:
            yield request

    def _read(self) -> None:
        event: Event = None
        try:
            for response in self._call:
                self._deliver(response)
        except grpc.RpcError as error:
            event = translate(error)
        finally:
            self._requests.put(None)  # lets grpc's sending thread end
        self._deliver(event)
