"""Calls that are refused, that come too late, and whose callers go away."""

from __future__ import annotations

import asyncio
import threading

import httpx
import numpy as np
import pytest

from tests.fakes import FAKE_MODEL, barrel_guides
from unbend_service.adapters.metrics.prometheus import PrometheusMeter
from unbend_service.application.admission import Admission
from unbend_service.application.ports import Estimate
from unbend_service.transport.rest.admitting import Admitting

from .conftest import Bench


class SlowEstimator:
    """Estimates once it may."""

    model = FAKE_MODEL

    def __init__(self) -> None:
        self.may_answer = threading.Event()
        self.asked = 0

    def estimate(self, grey: np.ndarray) -> Estimate:
        self.asked += 1
        self.may_answer.wait(20)
        return Estimate(barrel_guides(), 0.9, "mirror_agreement", FAKE_MODEL)


@pytest.fixture
def slow(bench: Bench) -> SlowEstimator:
    estimator = SlowEstimator()
    bench.service.estimation._estimator = estimator
    return estimator


async def test_one_call_too_many_is_refused_with_when_to_come_back(
    bench: Bench, slow: SlowEstimator, jpeg: bytes
) -> None:
    """429 with Retry-After and the setting, while those that were let in are answered."""
    bench.service.admission._singles_at_most = 2
    calls = [asyncio.create_task(bench.client.post("/v1/estimate", content=jpeg)) for _ in range(2)]
    await asyncio.sleep(0.1)
    refused = await bench.client.post("/v1/estimate", content=jpeg)
    assert (refused.status_code, refused.json()["code"]) == (429, "queue_full")
    assert refused.json()["setting"] == "queue_frames"
    assert int(refused.headers["retry-after"]) >= 1
    slow.may_answer.set()
    assert [(await call).status_code for call in calls] == [200, 200]
    assert 'unbend_rejections_total{reason="queue_full"} 1.0' in (await bench.client.get("/metrics")).text


async def test_the_time_of_the_caller_holds_at_every_stage(bench: Bench, slow: SlowEstimator, jpeg: bytes) -> None:
    """504 after Unbend-Timeout-S, with nothing left under way; a value that is no time is refused."""
    answer = await bench.client.post("/v1/correct", content=jpeg, headers={"Unbend-Timeout-S": "0.05"})
    assert (answer.status_code, answer.json()["code"]) == (504, "deadline_exceeded")
    assert bench.service.admission.active == 0
    slow.may_answer.set()
    for wrong in ("soon", "0", "-1", "nan", "1e9"):
        answer = await bench.client.post("/v1/correct", content=jpeg, headers={"Unbend-Timeout-S": wrong})
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid_option")
    answer = await bench.client.post("/v1/correct", content=jpeg, headers={"Unbend-Timeout-S": "20"})
    assert answer.status_code == 200


async def test_work_ends_when_its_caller_is_gone() -> None:
    """A caller who closes his connection after the request has the work on it cancelled, and is counted as gone."""
    cancelled = asyncio.Event()
    gone = asyncio.Event()
    sent: list[int] = []

    async def app(scope: object, receive: object, send: object) -> None:
        while (await receive())["more_body"]:
            pass
        try:
            await asyncio.sleep(20)
        except asyncio.CancelledError:
            cancelled.set()
            raise

    messages = [
        {"type": "http.request", "body": b"a", "more_body": True},
        {"type": "http.request", "body": b"b", "more_body": False},
    ]

    async def receive() -> dict[str, object]:
        if messages:
            return messages.pop(0)
        await gone.wait()
        return {"type": "http.disconnect"}

    async def send(message: dict[str, object]) -> None:
        sent.append(message.get("status"))

    admission = Admission()
    middleware = Admitting(app, admission, PrometheusMeter())
    scope = {"type": "http", "path": "/v1/correct", "headers": [], "state": {"request_id": "x"}}
    call = asyncio.create_task(middleware(scope, receive, send))
    await asyncio.sleep(0.01)
    assert admission.active == 1
    gone.set()
    await asyncio.wait_for(call, 5)
    assert cancelled.is_set()
    assert sent[0] == 499
    assert admission.active == 0


async def test_answers_are_not_given_up(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """Watching the caller takes nothing from calls that are answered, one after the other or together."""
    answers = await asyncio.gather(*(client.post("/v1/correct", content=jpeg) for _ in range(8)))
    assert [answer.status_code for answer in answers] == [200] * 8
