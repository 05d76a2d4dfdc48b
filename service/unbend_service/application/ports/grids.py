"""Where grids are kept, and how they travel and are drawn."""

from __future__ import annotations

from typing import Protocol

from unbend_service.application.exhibit import Exhibit, Subject
from unbend_service.domain.exchange import DenseMap, ExportedFile, ExportFormat, ImportFormat
from unbend_service.domain.frames import Frame
from unbend_service.domain.maps import BackwardMap
from unbend_service.domain.records import GridRecord


class GridStore(Protocol):
    """Keeps grids by their content-derived id, and which grid a stream was given."""

    async def put(self, record: GridRecord) -> None: ...

    async def get(self, grid_id: str) -> GridRecord:
        """Raises GridNotFound."""
        ...

    async def delete(self, grid_id: str) -> None:
        """Raises GridNotFound."""
        ...

    async def bind_stream(self, stream_id: str, grid_id: str, *, replace: bool = True) -> str:
        """Remembers the grid of a stream, so that a resumed stream gets the same one without a new estimate.

        Returns the grid id that is bound now: without ``replace`` the one that was, while its grid is kept.
        """
        ...

    async def stream_grid(self, stream_id: str) -> str | None:
        """The grid id that was bound, None if there is none (any more)."""
        ...

    async def claim_stream(self, stream_id: str, token: str, lease_s: float) -> bool:
        """Whether the grid of a stream is ``token``'s to estimate; nobody else's for the next ``lease_s`` seconds.

        Asked again with the same token, the lease begins anew. A holder that dies loses it by time.
        """
        ...

    async def release_stream(self, stream_id: str, token: str) -> None:
        """Gives a claim up; without effect if it is not ``token``'s."""
        ...

    async def camera(self, name: str) -> bytes | None:
        """What is remembered of a camera, None if nothing (any more)."""
        ...

    async def swap_camera(self, name: str, known: bytes | None, value: bytes | None) -> bool:
        """Replaces what is remembered of a camera, if that is still ``known``; None stands for nothing on both sides.

        Returns:
            Whether it was: someone else may have been faster.
        """
        ...

    async def close(self) -> None: ...


class GridFiles(Protocol):
    """Grids as the files of other programs. Thread-safe; blocking."""

    def write_record(self, record: GridRecord) -> ExportedFile:
        """The JSON of the API."""
        ...

    def read_record(self, body: bytes) -> GridRecord:
        """Inverse of :meth:`write_record`; a grid or guides alone are accepted too.

        Raises:
            InvalidGrid, InvalidGuides.
        """
        ...

    def write_map(self, kind: ExportFormat, dense: DenseMap) -> ExportedFile:
        """Any format but json.

        Raises:
            InvalidOption: a size that the format cannot hold.
            Unavailable: the library that writes it is not installed.
        """
        ...

    def read_map(self, kind: ImportFormat, body: bytes) -> BackwardMap:
        """Any format but json; target -> source, centred.

        Raises:
            InvalidGrid: the file is broken or holds something else.
            Unavailable: the library that reads it is not installed.
        """
        ...


class Illustrator(Protocol):
    """Draws figures of what was estimated of a picture. Thread-safe; blocking.

    Both raise InvalidFrame for a planar frame, and InvalidOption for guides of a grid that has none.
    """

    def raster(self, subject: Subject, exhibit: Exhibit) -> Frame:
        """The figure as rgb24: overlays have the size of the picture, others that of their panels."""
        ...

    def vector(self, subject: Subject, exhibit: Exhibit) -> bytes:
        """The same figure as SVG, UTF-8."""
        ...
