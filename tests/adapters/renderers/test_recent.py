from __future__ import annotations

from unbend_service.adapters.renderers.recent import Recent


def test_the_least_recently_used_goes_first() -> None:
    """What is in use stays; what goes is handed over to be released."""
    gone: list[str] = []
    recent: Recent[int, str] = Recent(10, gone.append)
    recent.put(1, "one", 4)
    recent.put(2, "two", 4)
    assert recent.get(1) == "one"
    recent.put(3, "three", 4)
    assert gone == ["two"]
    assert recent.get(2) is None
    assert (recent.size_bytes, len(recent)) == (8, 2)
    recent.clear()
    assert sorted(gone) == ["one", "three", "two"]
    assert (recent.size_bytes, len(recent)) == (0, 0)


def test_the_newest_stays_even_if_it_is_too_large() -> None:
    """A frame under way keeps its own maps, whatever the bound."""
    recent: Recent[str, str] = Recent(10)
    recent.put("small", "s", 1)
    recent.put("large", "l", 100)
    assert recent.get("large") == "l"
    assert recent.get("small") is None
