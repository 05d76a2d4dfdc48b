"""Who may do what: scopes, tokens and what is kept of them."""

from __future__ import annotations

import hashlib
import re
import secrets
from dataclasses import dataclass, replace
from enum import StrEnum

from unbend_service.domain.errors import InvalidOption

#: Every token begins so, which lets scanners of repositories and the log find one that went astray.
PREFIX = "unbend_"
_SECRET_BYTES = 32
#: 32 random bytes in URL-safe base64.
TOKEN = re.compile(PREFIX + r"[A-Za-z0-9_-]{43}")
_NAME = re.compile(r"[A-Za-z0-9._-]{1,64}")
_COUNT = re.compile(r"[1-9][0-9]{0,6}")
_DIGEST = re.compile(r"sha256:([0-9a-f]{64})")


class Scope(StrEnum):
    """What a token is good for. ``ADMIN`` is good for everything."""

    CORRECT = "correct"
    GRIDS = "grids"
    METRICS = "metrics"
    ADMIN = "admin"


@dataclass(frozen=True, slots=True)
class Grant:
    """One token, without its secret.

    Attributes:
        name: stands in logs and metrics; several tokens may share one, the old and the new while one is exchanged.
        digest: 32 bytes, SHA-256 of the token. That is enough: a token has 256 random bits, which nobody can guess
            however fast the digest is, and a slow one would let strangers spend the service's time.
        rate_per_s: pictures and frames a second; None takes the setting.
        burst: of them at once; None takes the setting.
        streams: open at once; None takes the setting.
    """

    name: str
    scopes: frozenset[Scope]
    digest: bytes
    rate_per_s: float | None = None
    burst: int | None = None
    streams: int | None = None

    def allows(self, scope: Scope) -> bool:
        return scope in self.scopes or Scope.ADMIN in self.scopes


def new_token() -> str:
    """A token that nobody has: the prefix and 256 random bits."""
    return PREFIX + secrets.token_urlsafe(_SECRET_BYTES)


def digest_of(token: str) -> bytes:
    """What is kept of a token, 32 bytes."""
    return hashlib.sha256(token.encode()).digest()


def line_of(grant: Grant) -> str:
    """The line of the tokens file: name, scopes, digest, limits."""
    rate = None if grant.rate_per_s is None else f"{grant.rate_per_s:.3f}".rstrip("0").rstrip(".")
    limits = {"rate": rate, "burst": grant.burst, "streams": grant.streams}
    words = [
        grant.name,
        ",".join(scope for scope in Scope if scope in grant.scopes),
        f"sha256:{grant.digest.hex()}",
        *(f"{key}={value}" for key, value in limits.items() if value is not None),
    ]
    return " ".join(words)


def read_tokens(text: str) -> list[Grant]:
    """The grants of a tokens file: one a line, ``#`` begins a comment.

    Raises:
        InvalidOption: a line that cannot be read. It is named by its number only: somebody may have put the token
            itself there.
    """
    grants: list[Grant] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            grants.append(_grant(words))
        except ValueError as error:
            raise InvalidOption(
                f"Line {number} of the tokens file: {error}.",
                allowed="NAME SCOPE,... sha256:DIGEST [rate=R] [burst=N] [streams=N], as `unbend token new` prints it",
                setting="tokens_file",
            ) from None
    return grants


def check_name(name: str) -> str:
    """Raises ValueError."""
    if not _NAME.fullmatch(name):
        raise ValueError("a name has 1 to 64 letters, digits, '.', '_' or '-'")
    return name


def _grant(words: list[str]) -> Grant:
    if len(words) < 3:
        raise ValueError("it has less than name, scopes and digest")
    name, listed, digest, *limits = words
    check_name(name)
    known = {scope.value for scope in Scope}
    if not set(listed.split(",")) <= known:
        raise ValueError(f"scopes are {', '.join(Scope)}")
    found = _DIGEST.fullmatch(digest)
    if found is None:
        raise ValueError("the third word is not sha256: and 64 hexadecimal digits")
    grant = Grant(name, frozenset(map(Scope, listed.split(","))), bytes.fromhex(found[1]))
    for word in limits:
        grant = _limited(grant, word)
    return grant


def _limited(grant: Grant, word: str) -> Grant:
    key, _, value = word.partition("=")
    if key == "rate" and re.fullmatch(r"[0-9]{1,7}(\.[0-9]{1,3})?", value) and float(value) > 0:
        return replace(grant, rate_per_s=float(value))
    if key == "burst" and _COUNT.fullmatch(value):
        return replace(grant, burst=int(value))
    if key == "streams" and _COUNT.fullmatch(value):
        return replace(grant, streams=int(value))
    raise ValueError("after the digest come rate=, burst= or streams= and a number above 0")
