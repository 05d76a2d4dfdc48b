"""Tokens in a file, one a line, digests only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from unbend_service.domain.access import Grant, read_tokens
from unbend_service.domain.errors import InvalidOption

_LARGEST_BYTES = 1 << 20


class TokenFile:
    """Port TokenSource over a file that may be replaced or written at any time.

    A change is seen by the file's identity, size and time, so that of a Kubernetes secret, a link that is exchanged, is
    seen too.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._seen: tuple[int, ...] | None = None

    def read(self) -> Sequence[Grant] | None:
        """The tokens if the file changed since it was looked at last, else None.

        Raises:
            InvalidOption: it cannot be read, or not understood; raised once for each change.
        """
        try:
            status = self._path.stat()
            seen = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
            if seen == self._seen:
                return None
            self._seen = seen
            if status.st_size > _LARGEST_BYTES:
                raise InvalidOption(
                    f"The tokens file has {status.st_size} bytes.",
                    allowed=f"{_LARGEST_BYTES} bytes",
                    setting="tokens_file",
                )
            text = self._path.read_text("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            gone = (-1,)
            if self._seen == gone:
                return None
            self._seen = gone
            reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8"
            raise InvalidOption(f"The tokens file cannot be read: {reason}.", setting="tokens_file") from None
        return read_tokens(text)
