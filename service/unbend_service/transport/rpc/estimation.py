"""``unbend.v1.EstimationService``."""

from __future__ import annotations

from unbend.v1 import estimation_pb2, estimation_pb2_grpc
from unbend_service.application.estimation import Estimation
from unbend_service.domain.errors import UnsupportedPixelFormat
from unbend_service.domain.fit import Fit, check_strength
from unbend_service.domain.frames import PixelFormat
from unbend_service.settings import Settings
from unbend_service.transport.rpc.calls import Context
from unbend_service.transport.rpc.convert import from_guides, from_record, to_correct, to_format, to_frame
from unbend_service.transport.rpc.pictures import check_body, check_pixels


class EstimationServicer(estimation_pb2_grpc.EstimationServiceServicer):
    """Estimates raw and encoded pictures."""

    def __init__(self, estimation: Estimation, settings: Settings) -> None:
        self._estimation = estimation
        self._settings = settings

    async def Estimate(  # noqa: N802 the name of the generated base class
        self, request: estimation_pb2.EstimateRequest, context: Context
    ) -> estimation_pb2.EstimateResponse:
        layout = to_format(request.format.pixel_format)
        correct = to_correct(request.correct)
        fit = Fit.parse(request.fit or "keep")
        strength = check_strength(request.strength if request.HasField("strength") else 1.0)
        min_confidence = request.min_confidence if request.HasField("min_confidence") else None
        if isinstance(layout, PixelFormat):
            check_pixels(request.format.width, request.format.height, self._settings.source_pixels)
            frame = to_frame(layout, request.format.width, request.format.height, request.data)
            record = await self._estimation.of_frame(
                frame, correct, fit, strength, min_confidence, request.camera or None
            )
        else:
            body = check_body(request.data, self._settings.body_bytes)
            record = await self._estimation.of_image(
                body, correct, fit, strength, min_confidence, request.camera or None
            )
        return estimation_pb2.EstimateResponse(record=from_record(record, whole=True))

    async def EstimateGuides(  # noqa: N802 as above
        self, request: estimation_pb2.EstimateGuidesRequest, context: Context
    ) -> estimation_pb2.EstimateGuidesResponse:
        layout = to_format(request.format.pixel_format)
        if layout is not PixelFormat.GRAY8:
            raise UnsupportedPixelFormat("Nodes show each other grey pictures.", allowed="gray8")
        check_pixels(request.format.width, request.format.height, self._settings.source_pixels)
        frame = to_frame(layout, request.format.width, request.format.height, request.data)
        estimate = await self._estimation.for_another_node(frame.plane_arrays()[0])
        return estimation_pb2.EstimateGuidesResponse(
            guides=from_guides(estimate.guides),
            confidence=estimate.confidence,
            confidence_kind=estimate.confidence_kind,
            expected_error=estimate.expected_error,
            model=estimation_pb2.Model(
                name=estimate.model.name,
                sha256=estimate.model.sha256,
                min_confidence=estimate.model.caution.min_confidence,
                full_confidence=estimate.model.caution.full_confidence,
                doubtful_displacement=estimate.model.caution.doubtful_displacement,
            ),
        )
