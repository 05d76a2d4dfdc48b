"""The estimator of a node that only renders: it asks a node that estimates."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import grpc
import numpy as np

from unbend.v1 import estimation_pb2, estimation_pb2_grpc, frame_pb2, grid_pb2
from unbend_service.application.ports import Bytes, Estimate, ModelInfo
from unbend_service.domain.decision import Caution
from unbend_service.domain.errors import EstimatorUnavailable, InvalidGuides, QueueFull
from unbend_service.domain.guides import GuideFamily, Guides

_SETTING = "estimator_address"

#: Calls go round all nodes that the name stands for; one that is refused before it was heard is tried elsewhere.
_SERVICE_CONFIG = {
    "loadBalancingConfig": [{"round_robin": {}}],
    "methodConfig": [
        {
            "name": [{"service": "unbend.v1.EstimationService"}],
            "retryPolicy": {
                "maxAttempts": 3,
                "initialBackoff": "0.05s",
                "maxBackoff": "0.5s",
                "backoffMultiplier": 2,
                "retryableStatusCodes": ["UNAVAILABLE"],
            },
        }
    ],
}
_OPTIONS: list[tuple[str, Any]] = [
    ("grpc.service_config", json.dumps(_SERVICE_CONFIG)),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2_000),
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.use_local_subchannel_pool", 1),
]


class RemoteEstimator:
    """Port Estimator over ``unbend.v1.EstimationService.EstimateGuides``; connects when it is asked first.

    Args:
        address: host:port, or any name that gRPC resolves to several, such as ``dns:///host:port``.
        timeout_s: of one estimate, attempts at other nodes included.
        credentials: of the channel; None speaks plain text.
        metadata: sent with every call.
    """

    def __init__(
        self,
        address: str,
        timeout_s: float,
        *,
        credentials: grpc.ChannelCredentials | None = None,
        metadata: tuple[tuple[str, str], ...] = (),
    ) -> None:
        self._address = address
        self._timeout_s = timeout_s
        self._metadata = metadata
        self._channel = (
            grpc.insecure_channel(address, _OPTIONS)
            if credentials is None
            else grpc.secure_channel(address, credentials, _OPTIONS)
        )
        self._stub = estimation_pb2_grpc.EstimationServiceStub(self._channel)
        self._model = ModelInfo(f"remote:{address}", "")

    @property
    def model(self) -> ModelInfo:
        """Of the node that answered last; before that its name says where it will be asked."""
        return self._model

    def estimate(self, grey: Bytes) -> Estimate:
        """(height, width) uint8 grey, any size, upright -> Estimate.

        Raises:
            EstimatorUnavailable: no node answered in time, or not with guides.
            QueueFull: the node has too much to do.
        """
        height, width = grey.shape
        layout = frame_pb2.FrameFormat(pixel_format=frame_pb2.PIXEL_FORMAT_GRAY8, width=width, height=height)
        request = estimation_pb2.EstimateGuidesRequest(format=layout, data=np.ascontiguousarray(grey).tobytes())
        try:
            response = self._stub.EstimateGuides(request, timeout=self._timeout_s, metadata=self._metadata)
            return self._read(response)
        except grpc.RpcError as error:
            raise self._failed(error) from error
        except InvalidGuides as error:
            raise EstimatorUnavailable(
                f"The estimation node {self._address} sent no guides.", setting=_SETTING
            ) from error

    def close(self) -> None:
        """Ends the connections."""
        self._channel.close()

    def _read(self, response: estimation_pb2.EstimateGuidesResponse) -> Estimate:
        said = response.model
        caution = Caution(said.min_confidence, said.full_confidence, said.doubtful_displacement)
        self._model = ModelInfo(said.name, said.sha256, caution)
        return Estimate(
            Guides(_family(response.guides.rows), _family(response.guides.columns)),
            response.confidence,
            response.confidence_kind,
            self._model,
            response.expected_error if response.HasField("expected_error") else None,
        )

    def _failed(self, error: Any) -> EstimatorUnavailable | QueueFull:
        if error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED:
            return QueueFull(f"The estimation node {self._address} has too much to do.", retry_after_s=1.0)
        return EstimatorUnavailable(
            f"The estimation node {self._address} does not answer: {error.code().name}, {error.details()}",
            setting=_SETTING,
            retry_after_s=1.0,
        )


def _family(guides: Iterable[grid_pb2.Guide]) -> GuideFamily:
    anchors = [guide.anchor for guide in guides]
    coefficients = [list(guide.coefficients) for guide in guides]
    if len({len(row) for row in coefficients}) != 1:
        raise InvalidGuides("Guides of one direction need the same number of coefficients.")
    return GuideFamily(np.array(anchors, dtype=np.float64), np.array(coefficients, dtype=np.float64))
