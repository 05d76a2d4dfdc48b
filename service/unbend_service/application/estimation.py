"""Estimate: one picture in, the grid that straightens it out."""

from __future__ import annotations

import dataclasses
from collections.abc import Awaitable, Callable, Sequence

from unbend_service.application.blocking import BlockingWork
from unbend_service.application.cameras import Cameras
from unbend_service.application.fitting import FittedGrids
from unbend_service.application.grey import grey_of_frame
from unbend_service.application.known import HASHED_AT_ONCE_BYTES, Known, digest
from unbend_service.application.ports import Bytes, Estimate, Estimator, GridStore, ImageCodec, Meter
from unbend_service.domain.aggregation import Look, fuse
from unbend_service.domain.decision import TRUSTING, Caution, decide
from unbend_service.domain.errors import InvalidOption, NotServedHere
from unbend_service.domain.fit import KEEP, Fit
from unbend_service.domain.frames import Frame
from unbend_service.domain.records import Correct, GridRecord

#: Names the camera that the picture's own EXIF block names.
EXIF_CAMERA = "exif"
#: Longer side to which pictures are reduced before an estimator sees them.
ESTIMATE_LONGEST_PX = 1024


def check_confidence(min_confidence: float) -> float:
    """Raises InvalidOption unless 0 <= min_confidence <= 1."""
    if not 0 <= min_confidence <= 1:
        raise InvalidOption(f"min_confidence={min_confidence!r} is out of range.", allowed="0..1")
    return min_confidence


def fused_estimate(estimates: Sequence[Estimate]) -> Estimate:
    """What several estimates of one camera's pictures say together; blocking.

    Raises:
        InvalidGuides: no estimate, or none with guides that intersect.
    """
    fused = fuse([Look(one.guides, one.confidence, one.expected_error) for one in estimates])
    return dataclasses.replace(
        estimates[0], guides=fused.guides, confidence=fused.confidence, expected_error=fused.expected_error
    )


class Estimation:
    """Runs the estimator off the event loop, decides, and stores what was decided.

    A picture that was seen before, or is being looked at, is not looked at again.

    Args:
        min_confidence: below which a picture is left alone, and from which on it is corrected all the way; None takes
            the estimator's advice, which speaks of the lens and is therefore not followed where the whole of the map
            was asked for.
        known_images: pictures whose estimate is kept.
        elsewhere: where calls of the estimator wait if it is on another node; they take no core here.
    """

    def __init__(
        self,
        estimator: Estimator,
        codec: ImageCodec,
        store: GridStore,
        grids: FittedGrids,
        blocking: BlockingWork,
        meter: Meter,
        *,
        grid_points: int,
        min_confidence: float | None,
        known_images: int = 1024,
        elsewhere: BlockingWork | None = None,
    ) -> None:
        self._known: Known[Estimate] = Known(known_images)
        self.cameras = Cameras(store, blocking, estimator.model)
        self._estimator = estimator
        self._codec = codec
        self._store = store
        self._grids = grids
        self._blocking = blocking
        self._meter = meter
        self._grid_points = grid_points
        self._min_confidence = min_confidence
        self._elsewhere = elsewhere

    async def of_grey(self, grey: Bytes) -> Estimate:
        """What the estimator says of a (height, width) uint8 picture; EstimatorUnavailable if it is away."""
        return await (self._elsewhere or self._blocking).run("estimate", self._estimator.estimate, grey)

    async def for_another_node(self, grey: Bytes) -> Estimate:
        """As :meth:`of_grey`, but never asked of a third node. Raises NotServedHere."""
        if self._elsewhere is not None:
            raise NotServedHere("This node renders only.", allowed="role all or estimate", setting="role")
        return await self.of_grey(grey)

    async def record(self, estimate: Estimate, correct: Correct, min_confidence: float | None = None) -> GridRecord:
        """The decision on an estimate, before the strength and fit of a request; stored and counted."""
        caution = self._caution(estimate, correct, min_confidence)
        record = await self._blocking.run(
            "grid",
            decide,
            estimate.guides,
            estimate.confidence,
            estimate.confidence_kind,
            estimate.model.name,
            correct=correct,
            caution=caution,
            points=self._grid_points,
        )
        self._meter.estimate(record.outcome.value)
        await self._store.put(record)
        return record

    def _caution(self, estimate: Estimate, correct: Correct, asked: float | None) -> Caution:
        threshold = self._min_confidence if asked is None else check_confidence(asked)
        if threshold is not None:
            return Caution(threshold, threshold)
        return estimate.model.caution if correct is Correct.NONLINEAR else TRUSTING

    async def of_image(
        self,
        body: bytes,
        correct: Correct = Correct.NONLINEAR,
        fit: Fit = KEEP,
        strength: float = 1.0,
        min_confidence: float | None = None,
        camera: str | None = None,
    ) -> GridRecord:
        """Estimates an encoded picture; the stored grid is the one that correct, fit and strength describe.

        Args:
            camera: whose picture it is: what its other pictures said counts too, see `cameras`. ``exif`` takes the
                make, model, lens and focal length that the file names, or nothing if it names none.

        Raises:
            EmptyBody, UnsupportedMediaType, InvalidImage, TooManyPixels, InvalidOption, QueueFull.
        """

        async def look() -> Estimate:
            return await self.of_grey(
                await self._blocking.run("decode", self._codec.decode_grey, body, ESTIMATE_LONGEST_PX)
            )

        aspect = 0.0
        if camera:
            origin = await self._blocking.run("decode", self._codec.origin, body)
            aspect, camera = origin.aspect, origin.camera if camera == EXIF_CAMERA else camera
        estimate = await self._looked(await self._digest(body), look, camera, aspect)
        return await self._described(estimate, correct, fit, strength, min_confidence)

    async def of_frame(
        self,
        frame: Frame,
        correct: Correct = Correct.NONLINEAR,
        fit: Fit = KEEP,
        strength: float = 1.0,
        min_confidence: float | None = None,
        camera: str | None = None,
    ) -> GridRecord:
        """As :meth:`of_image`, for a raw picture, which has no EXIF block."""
        layout = f"{frame.pixel_format} {frame.width} {frame.height}".encode()

        async def look() -> Estimate:
            return await self.of_grey(await self._blocking.run("decode", grey_of_frame, frame, ESTIMATE_LONGEST_PX))

        picture = await self._digest(layout, frame.data)
        named = None if camera == EXIF_CAMERA else camera
        estimate = await self._looked(picture, look, named, frame.width / frame.height)
        return await self._described(estimate, correct, fit, strength, min_confidence)

    async def _looked(
        self, picture: bytes, look: Callable[[], Awaitable[Estimate]], camera: str | None, aspect: float
    ) -> Estimate:
        """The estimate of a picture, with what its camera's other pictures said."""
        if not camera:
            return await self._known.get(picture, look)
        locked = await self.cameras.locked(camera, aspect)
        return locked or await self.cameras.add(camera, aspect, await self._known.get(picture, look), picture.hex())

    async def _digest(self, *parts: bytes | Bytes) -> bytes:
        if sum(len(part) for part in parts) <= HASHED_AT_ONCE_BYTES:
            return digest(*parts)
        return await self._blocking.run("decode", digest, *parts)

    async def _described(
        self, estimate: Estimate, correct: Correct, fit: Fit, strength: float, min_confidence: float | None
    ) -> GridRecord:
        record = await self.record(estimate, correct, min_confidence)
        grid = await self._grids.get(record.grid, fit, strength)
        if grid is record.grid:
            return record
        described = dataclasses.replace(record, grid=grid, strength=record.strength * strength)
        await self._store.put(described)
        return described
