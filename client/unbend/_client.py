"""``Client``: the service from a thread."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from types import TracebackType
from typing import TypeVar

import grpc

from unbend import _calls as calls
from unbend import _types as types
from unbend._channel import PathLike, open_channel, to_credentials, to_metadata
from unbend._errors import Closed
from unbend._failures import translate
from unbend._images import FrameLayout
from unbend._retries import Attempts
from unbend._stream import Stream
from unbend._stream_core import StreamOptions

T = TypeVar("T")

DEFAULT_TARGET = "127.0.0.1:50051"


class Client:
    """A connection to an Unbend service; may be shared by threads.

    >>> import numpy as np, unbend
    >>> with unbend.Client("127.0.0.1:50051") as client:
    ...     correction = client.correct(np.zeros((480, 640, 3), np.uint8))
    ...     print(correction.outcome, correction.image.shape)
    corrected (480, 640, 3)

    Args:
        target: host:port of the service.
        timeout_s: seconds that a call may take, its retries included, and that one answer of a stream may take.
        retries: attempts after the first, of calls that may be repeated, when the server is gone or at a limit.
        token: sent with every call; that of the environment variable UNBEND_TOKEN if left out.
        tls: connect with TLS; the files below say so too.
        ca_file: PEM authorities of the server; those of the system if left out.
        cert_file, key_file: PEM certificate of this client and its key, for a server that asks for one.
        credentials: of ``grpc.ssl_channel_credentials``, instead of the files.
        metadata: pairs that are sent with every call.
        shared_memory: the local socket of a service on this host (its setting ``local_socket``): the raw frames of
            streams then pass through shared memory instead of the connection. Linux only.

    Raises:
        InvalidOption: a file cannot be read, or a token cannot be sent.
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
        self.grids = Grids(self)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Ends the connection and the calls under way."""
        self._closed = True
        self._channel.close()

    def correct(
        self,
        image: types.Image,
        *,
        pixel_format: str | None = None,
        correct: str = "nonlinear",
        fit: str | float = "crop",
        strength: float = 1.0,
        border: types.Border | None = None,
        quality: int | None = None,
        answer_format: str | None = None,
        grid: calls.GridLike | None = None,
        min_confidence: float | None = None,
        camera: str = "",
    ) -> types.Correction:
        """Straightens one picture.

        >>> client.correct(np.zeros((48, 64), np.uint8), fit="full", border=unbend.Border(255, 0, 0)).image.shape
        (48, 64)

        Args:
            image: (height, width), (height, width, 3) RGB or (height, width, 4) RGBA uint8; the bytes of a jpeg, png
                or webp file; a Pillow image, as it lies in memory; or a PyAV frame.
            pixel_format: how an array is to be read if not as above: ``bgr24``, ``bgra``, or ``i420`` and ``nv12`` of
                shape (height * 3 / 2, width); what a Pillow image or a PyAV frame is converted into.
            correct: ``nonlinear``: framing, tilt and perspective stay; ``all``: they are undone too. Ignored with
                ``grid``.
            fit: ``crop`` (no invalid pixel), ``full`` (every source pixel), ``keep``, or 0..1 between crop and full.
            strength: 0..1, blend with the identity.
            border: painted where the source has nothing; opaque black if left out.
            quality: 1..100 of a jpeg or webp answer; the server's default if left out.
            answer_format: ``jpeg``, ``png`` or ``webp`` if a file is to come back as another kind of file.
            grid: used instead of an estimate: an id, a record, an estimate or an earlier correction, a lattice or
                guides.
            min_confidence: 0..1; below it the picture is left alone, from it on corrected all the way. If left out the
                server's setting, or what its model advises: in doubt, a little.
            camera: whose picture it is, a name of your own: what pictures of one camera say of its lens adds up.
                ``exif`` takes it from the file.

        Returns:
            The corrected picture, an array of the same shape or a file, and the grid behind it; ``to_pil()`` and
            ``to_av()`` give it to Pillow and PyAV.

        Raises:
            InvalidInput: the picture or an option; the subclass says which.
            GridNotFound, Overloaded, Unavailable, RenderFailed, DeadlineExceeded.
        """
        return self._run(
            calls.correct_call(
                image,
                self._grid_id(grid),
                pixel_format=pixel_format,
                correct=correct,
                fit=fit,
                strength=strength,
                border=border,
                quality=quality,
                answer_format=answer_format,
                min_confidence=min_confidence,
                camera=camera,
            )
        )

    def estimate(
        self,
        image: types.Image,
        *,
        pixel_format: str | None = None,
        correct: str = "nonlinear",
        fit: str | float = "keep",
        strength: float = 1.0,
        min_confidence: float | None = None,
        camera: str = "",
    ) -> types.Estimate:
        """Says how a picture is bent, without drawing it; arguments and errors as of :meth:`correct`.

        >>> estimate = client.estimate(np.zeros((48, 64, 3), np.uint8))
        >>> estimate.outcome, estimate.grid.source.shape[2]
        (<Outcome.CORRECTED: 'corrected'>, 2)
        """
        return self._run(
            calls.estimate_call(
                image,
                pixel_format=pixel_format,
                correct=correct,
                fit=fit,
                strength=strength,
                min_confidence=min_confidence,
                camera=camera,
            )
        )

    def stream(
        self,
        width: int | None = None,
        height: int | None = None,
        pixel_format: str = "rgb24",
        *,
        stream_id: str | None = None,
        correct: str = "nonlinear",
        fit: str | float = "crop",
        strength: float = 1.0,
        border: types.Border | None = None,
        quality: int | None = None,
        grid: str | types.GridRecord | types.Estimate | types.Guides | None = None,
        frames: int | None = None,
        while_estimating: str = "hold",
        delivery: str = "lossless",
        min_confidence: float | None = None,
        estimate_again: bool = False,
        in_flight: int = 8,
        reconnects: int = 8,
        frame_deadline_s: float | None = None,
    ) -> Stream:
        """A stream of frames, to be used in a ``with`` block.

        >>> frames = (np.zeros((48, 64, 3), np.uint8) for _ in range(2))
        >>> with client.stream(64, 48, "rgb24") as stream:
        ...     for result in stream.correct(frames):
        ...         print(result.index, result.status, result.image.shape)
        0 corrected (48, 64, 3)
        1 corrected (48, 64, 3)

        Args:
            width, height: pixels of every frame; not needed for files.
            pixel_format: gray8, rgb24, bgr24, rgba, bgra, i420, nv12, or files: jpeg, png, webp.
            stream_id: opens an earlier stream again, with its grid; the server chooses one if left out.
            correct, fit, strength, border, quality, min_confidence: as of :meth:`correct`.
            grid: used instead of an estimate.
            frames: 1..64, the number of first frames that the grid is estimated over.
            while_estimating: ``hold``: frames wait for the grid; ``pass_through``: they come back as they are.
            delivery: ``lossless``, or ``latest``: a newer frame replaces a waiting one, which is answered as dropped.
            estimate_again: estimate anew although the stream id has a grid.
            in_flight: frames that are sent ahead of their answers, at most as many as the server allows.
            reconnects: attempts to mend a broken connection before one of them brings an answer.
            frame_deadline_s: a frame that is not done so many seconds after the server read it is answered as failed.

        Raises:
            InvalidInput: what cannot be sent. Entering the block and iterating raise what the server says.
        """
        self._check_open()
        options = StreamOptions(
            stream_id=stream_id,
            correct=correct,
            fit=fit,
            strength=strength,
            border=border,
            quality=quality,
            grid=grid,
            frames=frames,
            while_estimating=while_estimating,
            delivery=delivery,
            min_confidence=min_confidence,
            estimate_again=estimate_again,
            in_flight=in_flight,
            reconnects=reconnects,
            frame_deadline_s=frame_deadline_s,
        )
        layout = FrameLayout.of(pixel_format, width, height)
        return Stream(self._channel, self._metadata, layout, options, self._timeout_s, self._shared_memory)

    def _grid_id(self, grid: calls.GridLike | None) -> str | None:
        if isinstance(grid, types.Grid | types.Guides):
            return self.grids.put(grid).grid_id
        return calls.grid_id_of(grid)

    def _run(self, call: calls.Call[T]) -> T:
        self._check_open()
        method = self._channel.unary_unary(call.method, calls.serialize, call.answer.FromString)
        attempts = Attempts(self._timeout_s, self._retries, call.repeatable)
        while True:
            try:
                answer = method(call.request, timeout=attempts.left_s, metadata=self._metadata)
            except grpc.RpcError as error:
                pause_s = attempts.pause_s(translate(error))
            else:
                return call.parse(answer)
            time.sleep(pause_s)

    def _check_open(self) -> None:
        if self._closed:
            raise Closed("The client was closed.")


class Grids:
    """The grids that the server keeps; ``client.grids``.

    >>> straight = [unbend.Guide(anchor, (anchor, 0.0)) for anchor in (-0.5, 0.5)]
    >>> record = client.grids.put(unbend.Guides(straight, straight))
    >>> client.grids.get(record.grid_id).confidence_kind
    'given'
    """

    def __init__(self, client: Client) -> None:
        self._client = client

    def get(self, grid_id: str) -> types.GridRecord:
        """A stored grid with its lattice and guides. Raises GridNotFound."""
        return self._client._run(calls.get_grid_call(grid_id))

    def put(self, content: types.Grid | types.Guides) -> types.GridRecord:
        """Stores a lattice, or the one that guides span. Raises InvalidGrid, FoldedGrid, InvalidGuides."""
        return self._client._run(calls.put_grid_call(content))

    def delete(self, grid_id: str) -> None:
        """Forgets a grid. Raises GridNotFound."""
        self._client._run(calls.delete_grid_call(grid_id))
