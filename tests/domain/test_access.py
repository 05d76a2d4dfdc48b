from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unbend_service.domain.access import PREFIX, TOKEN, Grant, Scope, digest_of, line_of, new_token, read_tokens
from unbend_service.domain.errors import InvalidOption

DIGEST = "sha256:" + "ab" * 32


def test_a_token_has_256_random_bits_and_a_form_that_scanners_find() -> None:
    tokens = {new_token() for _ in range(100)}
    assert len(tokens) == 100
    assert all(TOKEN.fullmatch(token) and token.startswith(PREFIX) for token in tokens)


@given(
    st.text("AZaz09._-", min_size=1, max_size=64),
    st.frozensets(st.sampled_from(Scope), min_size=1),
    st.binary(min_size=32, max_size=32),
    st.none() | st.integers(1, 9_999_999_000).map(lambda value: value / 1000),
    st.none() | st.integers(1, 9_999_999),
    st.none() | st.integers(1, 9_999_999),
)
def test_a_line_says_the_whole_grant(
    name: str, scopes: frozenset[Scope], digest: bytes, rate: float | None, burst: int | None, streams: int | None
) -> None:
    grant = Grant(name, scopes, digest, rate, burst, streams)
    assert read_tokens(line_of(grant)) == [grant]


def test_comments_and_empty_lines_are_nothing() -> None:
    assert read_tokens(f"# all of them\n\n a grids {DIGEST} # of the door\n") == [
        Grant("a", frozenset({Scope.GRIDS}), bytes.fromhex("ab" * 32))
    ]
    assert read_tokens("") == []


@pytest.mark.parametrize(
    "line",
    [
        "a correct",
        f"a everything {DIGEST}",
        f"a correct,, {DIGEST}",
        f"a/b correct {DIGEST}",
        f"{'n' * 65} correct {DIGEST}",
        "a correct unbend_secret",
        "a correct sha256:abc",
        f"a correct {DIGEST.upper()}",
        f"a correct {DIGEST} rate=0",
        f"a correct {DIGEST} rate=-1",
        f"a correct {DIGEST} rate=nan",
        f"a correct {DIGEST} burst=0",
        f"a correct {DIGEST} streams=1.5",
        f"a correct {DIGEST} colour=red",
    ],
)
def test_a_line_that_cannot_be_read_is_named_by_its_number_and_not_repeated(line: str) -> None:
    with pytest.raises(InvalidOption, match="Line 2 ") as failure:
        read_tokens(f"good correct {DIGEST}\n{line}\n")
    assert line.split()[-1] not in str(failure.value)
    assert failure.value.setting == "tokens_file"


def test_admin_may_do_everything_and_the_others_what_they_are_for() -> None:
    admin = Grant("a", frozenset({Scope.ADMIN}), digest_of("x"))
    grids = Grant("b", frozenset({Scope.GRIDS}), digest_of("y"))
    assert all(admin.allows(scope) for scope in Scope)
    assert [scope for scope in Scope if grids.allows(scope)] == [Scope.GRIDS]
