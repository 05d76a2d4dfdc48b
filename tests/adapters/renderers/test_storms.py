from __future__ import annotations

from unbend_service.adapters.renderers.storms import StormGuard


def test_five_deaths_within_a_minute_are_a_storm_and_it_passes() -> None:
    """Readiness comes back by itself once a minute of deaths has gone by."""
    guard = StormGuard()
    for second in range(4):
        guard.note(float(second), "a crash")
        assert guard.reason(float(second)) == ""
        assert guard.backoff_s(float(second)) == 0
    guard.note(4.0, "a hang")
    assert guard.reason(4.0) == "5 render workers died within 60 s, the last one: a hang."
    assert guard.backoff_s(4.0) > 0
    assert guard.reason(60.5) == ""


def test_workers_are_started_ever_more_slowly_in_a_storm() -> None:
    """The wait doubles with each death and stays bounded."""
    guard = StormGuard()
    waits = []
    for _ in range(40):
        guard.note(0.0, "a crash")
        waits.append(guard.backoff_s(0.0))
    assert waits[4:8] == [0.2, 0.4, 0.8, 1.6]
    assert waits[-1] == 30.0
