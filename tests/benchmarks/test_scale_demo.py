from __future__ import annotations

from argparse import Namespace

import pytest

from benchmarks import scale_demo
from tests.companions import started


def test_streams_outlive_replicas_and_redis(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two replicas behind HAProxy: one killed, both restarted, Redis away: no frame is lost, no grid changes."""
    monkeypatch.setenv("UNBEND_DECODERS", "1")
    arguments = Namespace(step="all", proxy="haproxy", streams=6, rate=4.0, outage_s=5.0)
    status = started(lambda: scale_demo.run(arguments))
    said = capsys.readouterr().out
    assert status == 0, said
    assert said.splitlines()[-1] == "PASS scale-demo: 3 of 3 steps as promised"


def test_a_promise_that_is_broken_is_said() -> None:
    """One broken promise makes the verdict a failure, and the line says which it was."""
    verdict = scale_demo.Verdict("kill -9")
    verdict.expect(True, "estimates 8")
    verdict.expect(False, "frames lost 3")
    assert not verdict.kept
    assert str(verdict) == "FAIL kill -9: estimates 8, frames lost 3 (BROKEN)"
