"""Tokens of a running service: exchanged, taken back, bounded, and never told."""

from __future__ import annotations

import itertools
import json
import signal
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator

import grpc
import numpy as np
import pytest

import unbend
from tests.access.conftest import Guarded
from unbend_service.domain.access import Scope, new_token


def answered(
    guarded: Guarded, path: str, token: str | None, body: bytes | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    if token is not None:
        headers["Authorization"] = f"Bearer {token}"
    request = urllib.request.Request(f"http://{guarded.server.http}{path}", data=body, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return answer.status, dict(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, dict(error.headers), error.read()


def within(seconds: float, holds: Callable[[], bool]) -> bool:
    end = time.monotonic() + seconds
    while not (held := holds()) and time.monotonic() < end:
        time.sleep(0.05)
    return held


def test_a_token_opens_what_it_is_for(guarded: Guarded, jpeg: bytes) -> None:
    status, headers, body = answered(guarded, "/v1/correct", guarded.correct, jpeg)
    assert (status, body[:2]) == (200, b"\xff\xd8")
    assert headers["x-content-type-options"] == "nosniff"
    assert answered(guarded, "/openapi.json", guarded.tokens.only[Scope.ADMIN])[0] == 200


def test_a_refusal_says_what_is_wanted_and_not_what_was_sent(guarded: Guarded, jpeg: bytes) -> None:
    unknown = guarded.tokens.unknown
    status, headers, body = answered(guarded, "/v1/correct", unknown, jpeg)
    problem = json.loads(body)
    assert (status, problem["code"]) == (401, "unauthenticated")
    assert headers["www-authenticate"].startswith("Bearer ")
    assert unknown not in body.decode() + str(headers)
    status, headers, body = answered(guarded, "/v1/grids/g0", guarded.correct)
    assert (status, json.loads(body)["code"]) == (403, "permission_denied")
    assert "grids" in json.loads(body)["allowed"]
    assert 'error="insufficient_scope"' in headers["www-authenticate"]


@pytest.mark.parametrize("header", ["", "Bearer", "Bearer ", "Basic dTpw", "Token x", "Bearer " + "x" * 5000])
def test_whatever_is_no_bearer_token_is_refused(guarded: Guarded, header: str) -> None:
    assert answered(guarded, "/openapi.json", None, Authorization=header)[0] == 401


def test_the_document_says_which_scope_a_call_needs(guarded: Guarded) -> None:
    document = json.loads(answered(guarded, "/openapi.json", guarded.correct)[2])
    assert document["paths"]["/v1/grids"]["post"]["security"] == [{"token": ["grids"]}]
    assert document["components"]["securitySchemes"]["token"]["scheme"] == "bearer"
    assert "401" in document["paths"]["/v1/correct"]["post"]["responses"]


def test_tokens_are_exchanged_without_a_restart(guarded: Guarded) -> None:
    """Both are good while they are exchanged, and the old one is refused within two seconds of its end."""
    old = guarded.add("rotated", Scope.CORRECT)
    assert within(2, lambda: answered(guarded, "/openapi.json", old)[0] == 200)
    new = guarded.add("rotated", Scope.CORRECT)
    assert within(2, lambda: answered(guarded, "/openapi.json", new)[0] == 200)
    assert answered(guarded, "/openapi.json", old)[0] == 200
    guarded.take_back(old)
    assert within(2, lambda: answered(guarded, "/openapi.json", old)[0] == 401)
    assert answered(guarded, "/openapi.json", new)[0] == 200


def test_sighup_reads_the_tokens_at_once(guarded: Guarded) -> None:
    token = guarded.add("hangup", Scope.CORRECT)
    guarded.server.process.send_signal(signal.SIGHUP)
    assert within(0.9, lambda: answered(guarded, "/openapi.json", token)[0] == 200)


def test_a_slip_in_the_file_locks_nobody_out_and_is_logged_without_its_text(guarded: Guarded) -> None:
    """Somebody may paste the token itself into the file."""
    before, slip = guarded.file.read_text(), new_token()
    guarded.file.write_text(f"{before}\nslip correct {slip}\n")
    said = "what was there before stays"
    assert within(3, lambda: any(line["event"] == said for line in guarded.server.lines))
    assert answered(guarded, "/openapi.json", guarded.correct)[0] == 200
    assert answered(guarded, "/openapi.json", slip)[0] == 401
    complaint = next(line for line in guarded.server.lines if line["event"] == said)
    assert "Line " in str(complaint["message"])
    assert slip not in str(guarded.server.lines)
    guarded.file.write_text(before)
    assert within(3, lambda: guarded.server.lines[-1]["event"] != said)


def frames(count: int | None = None) -> Iterator[np.ndarray]:
    picture = np.zeros((48, 64), np.uint8)
    return itertools.repeat(picture) if count is None else itertools.repeat(picture, count)


def drained(answers: Iterator[unbend.StreamResult]) -> None:
    for _ in answers:
        time.sleep(0.01)


def test_an_open_stream_ends_when_its_token_is_taken_back(guarded: Guarded) -> None:
    token = guarded.add("streamer", Scope.CORRECT)
    assert within(2, lambda: answered(guarded, "/openapi.json", token)[0] == 200)
    with unbend.Client(guarded.server.grpc, token=token) as client, client.stream(64, 48, "gray8") as stream:
        answers = stream.correct(frames())
        next(answers)
        guarded.take_back(token)
        with pytest.raises(unbend.Unauthenticated):
            drained(answers)


def test_a_caller_over_its_rate_is_told_when_to_come_back(guarded: Guarded, jpeg: bytes) -> None:
    token = guarded.add("slow", Scope.CORRECT, rate=0.5)
    other = guarded.correct
    assert within(2, lambda: answered(guarded, "/openapi.json", token)[0] in (200, 429))
    found = [answered(guarded, "/openapi.json", token) for _ in range(4)]
    refused = [(headers, json.loads(body)) for status, headers, body in found if status == 429]
    assert refused
    assert refused[-1][1]["code"] == "rate_limited"
    assert 1 <= int(refused[-1][0]["retry-after"]) <= 2
    client = unbend.Client(guarded.server.grpc, token=token, retries=0)
    with client, pytest.raises(unbend.RateLimited) as failure:
        client.correct(jpeg)
    assert 0 < (failure.value.retry_after_s or 0) <= 2
    assert answered(guarded, "/openapi.json", other)[0] == 200


def test_a_stream_over_the_rate_of_its_caller_is_slowed_down_and_loses_nothing(guarded: Guarded) -> None:
    token = guarded.add("paced", Scope.CORRECT, rate=20)
    assert within(2, lambda: answered(guarded, "/openapi.json", token)[0] == 200)
    with unbend.Client(guarded.server.grpc, token=token) as client, client.stream(64, 48, "gray8") as stream:
        started = time.monotonic()
        answers = [answer.index for answer in stream.correct(frames(21))]
        seconds = time.monotonic() - started
    assert answers == list(range(21))
    assert seconds >= 0.9


def test_a_caller_has_as_many_streams_as_its_line_says(guarded: Guarded) -> None:
    token = guarded.add("few", Scope.CORRECT, streams=1)
    assert within(2, lambda: answered(guarded, "/openapi.json", token)[0] == 200)
    with unbend.Client(guarded.server.grpc, token=token, retries=0) as client:
        second = client.stream(64, 48, "gray8", reconnects=0)
        with client.stream(64, 48, "gray8"), pytest.raises(unbend.TooManyStreams), second:
            pass
        with client.stream(64, 48, "gray8") as stream:
            assert len(list(stream.correct(frames(2)))) == 2


def test_health_and_metrics_have_a_listener_of_their_own(guarded: Guarded) -> None:
    """Where it is, the listener of the API has them no longer, and metrics still need a token."""
    for path in ("/livez", "/readyz", "/metrics"):
        assert answered(guarded, path, guarded.tokens.only[Scope.METRICS])[0] == 404
    apart = Guarded(guarded.server, guarded.tokens, guarded.file)
    apart.server.http, address = apart.server.ops, apart.server.http
    try:
        assert answered(apart, "/livez", None)[0] == 200
        assert answered(apart, "/readyz", None)[0] == 200
        assert answered(apart, "/metrics", None)[0] == 401
        assert answered(apart, "/metrics", guarded.correct)[0] == 403
        assert b"unbend_requests_total" in answered(apart, "/metrics", guarded.tokens.only[Scope.METRICS])[2]
        assert answered(apart, "/v1/correct", guarded.correct, b"x")[0] == 404
    finally:
        guarded.server.http = address


def test_a_client_takes_its_token_from_the_environment(
    guarded: Guarded, jpeg: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("UNBEND_TOKEN", guarded.correct)
    with unbend.Client(guarded.server.grpc) as client:
        assert client.estimate(jpeg).grid_id
        with pytest.raises(unbend.PermissionDenied, match="grids"):
            client.grids.get("g0")
    stranger = unbend.Client(guarded.server.grpc, token=guarded.tokens.unknown)
    with stranger, pytest.raises(unbend.Unauthenticated):
        stranger.estimate(jpeg)


def test_no_secret_is_ever_logged(guarded: Guarded, channel: grpc.Channel, jpeg: bytes) -> None:
    """Wherever a token is put, at the most talkative level."""
    token = guarded.correct
    for misplaced in (f"/v1/correct?token={token}", f"/v1/grids/{token}", f"/{token}", f"/openapi.json?{token}"):
        answered(guarded, misplaced, token, **{"X-Request-Id": token, "traceparent": token, "Cookie": token})
    answered(guarded, "/v1/correct", token, jpeg)
    for metadata in ((("x-request-id", token), ("authorization", f"Bearer {token}")), (("x-request-id", token),)):
        call = channel.unary_unary("/unbend.v1.GridService/GetGrid")
        with pytest.raises(grpc.RpcError):
            call(b"", metadata=metadata, timeout=10)
    with pytest.raises(grpc.RpcError):
        channel.unary_unary(f"/unbend.v1.GridService/{token}")(b"", timeout=10)
    assert within(5, lambda: sum("unbend_" in str(line) for line in guarded.server.lines) >= 4)
    logged = str(guarded.server.lines)
    assert [secret for secret in guarded.tokens.all() if secret in logged] == []
    assert "only-correct" in logged  # whose token it was is said
