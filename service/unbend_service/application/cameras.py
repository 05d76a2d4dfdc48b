"""Pictures that name their camera: what each says of the lens adds up."""

from __future__ import annotations

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.ports import Estimate, GridStore, ModelInfo
from unbend_service.domain.aggregation import Look
from unbend_service.domain.camera_record import CameraRecord, check_camera_name
from unbend_service.domain.errors import GridNotFound, InvalidGrid

_ATTEMPTS = 8
"""Of writing a record that others write at the same time."""


class Cameras:
    """Keeps one record per camera name in the grid store; safe with other processes that share it."""

    def __init__(self, store: GridStore, blocking: BlockingWork, model: ModelInfo) -> None:
        self._store = store
        self._blocking = blocking
        self._model = model

    async def locked(self, name: str, aspect: float) -> Estimate | None:
        """What the camera's pictures say together, once no further one would change it; None before that.

        Raises:
            InvalidOption: as :meth:`add`.
        """
        record = _parsed(await self._store.camera(check_camera_name(name)))
        if record is None or record.model != self._model.name or not record.is_locked:
            return None
        record.check_aspect(aspect)
        return self._together(record)

    async def add(self, name: str, aspect: float, estimate: Estimate, picture: str) -> Estimate:
        """What the camera's pictures say together, this one included.

        Args:
            aspect: width over height of the upright picture.
            picture: digest of the picture; a picture counts once.

        Raises:
            InvalidOption: a name that is none, or a picture of other proportions than the camera's others.
            GridStoreUnavailable.
        """
        check_camera_name(name)
        look = Look(estimate.guides, estimate.confidence, estimate.expected_error)
        for _ in range(_ATTEMPTS):
            stored = await self._store.camera(name)
            known = _parsed(stored)
            if known is None or known.model != self._model.name:
                version = 1 if known is None else known.version + 1
                kind = estimate.confidence_kind
                record = CameraRecord.first(self._model.name, kind, aspect, look, picture, version)
            else:
                known.check_aspect(aspect)
                record = await self._blocking.run("grid", known.with_look, look, picture)
            if record is known or await self._store.swap_camera(name, stored, record.to_bytes()):
                break
        return self._together(record)

    async def get(self, name: str) -> CameraRecord:
        """Raises GridNotFound: no picture has named this camera."""
        record = _parsed(await self._store.camera(check_camera_name(name)))
        if record is None:
            raise GridNotFound(f"No picture of the camera {name!r} is remembered.")
        return record

    def _together(self, record: CameraRecord) -> Estimate:
        fused = record.fused
        return Estimate(fused.guides, fused.confidence, record.confidence_kind, self._model, fused.expected_error)

    async def reset(self, name: str) -> None:
        """Forgets a camera. Raises GridNotFound."""
        for _ in range(_ATTEMPTS):
            stored = await self._store.camera(check_camera_name(name))
            if stored is None:
                raise GridNotFound(f"No picture of the camera {name!r} is remembered.")
            if await self._store.swap_camera(name, stored, None):
                return


def _parsed(stored: bytes | None) -> CameraRecord | None:
    if stored is None:
        return None
    try:
        return CameraRecord.from_bytes(stored)
    except InvalidGrid:
        return None  # of an older make: it is begun anew, and written over
