"""The connection to the server."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import grpc

from unbend._errors import InvalidOption

#: Pairs that are sent with a call.
Metadata = tuple[tuple[str, str | bytes], ...]

#: A video frame is megabytes: large transport frames and a fixed window instead of 16 KiB frames and a probed one.
OPTIONS: tuple[tuple[str, int], ...] = (
    ("grpc.max_receive_message_length", -1),
    ("grpc.max_send_message_length", -1),  # the server says what is too large, as an error with a name
    ("grpc.http2.max_frame_size", (1 << 24) - 1),
    ("grpc.http2.lookahead_bytes", 4 << 20),
    ("grpc.http2.bdp_probe", 0),
    ("grpc.keepalive_time_ms", 30_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.max_reconnect_backoff_ms", 2_000),
    ("grpc.use_local_subchannel_pool", 1),  # closing one client must not depend on another of the same process
)

TOKEN_VARIABLE = "UNBEND_TOKEN"
PathLike = str | os.PathLike[str]


def to_credentials(
    credentials: grpc.ChannelCredentials | None,
    tls: bool,
    ca_file: PathLike | None,
    cert_file: PathLike | None,
    key_file: PathLike | None,
) -> grpc.ChannelCredentials | None:
    """What the arguments of a client come to; None connects in the clear. Raises InvalidOption."""
    named = any(file is not None for file in (ca_file, cert_file, key_file))
    if credentials is not None and (tls or named):
        raise InvalidOption("Credentials were given, and files for others.", allowed="one of them")
    if not (tls or named):
        return credentials
    if (cert_file is None) != (key_file is None):
        raise InvalidOption("A certificate and its key go together.", allowed="both of cert_file and key_file")
    return grpc.ssl_channel_credentials(_read(ca_file), _read(key_file), _read(cert_file))


def to_metadata(token: str | None, metadata: Sequence[tuple[str, str]]) -> Metadata:
    """The metadata of every call: a token given, else one of the metadata, else that of the environment.

    Raises:
        InvalidOption: a token that cannot be sent. What it is, is not said.
    """
    named = any(key.lower() == "authorization" for key, _ in metadata)
    if token is None and not named:
        token = os.environ.get(TOKEN_VARIABLE) or None
    if token is None:
        return tuple(metadata)
    if not token.isascii() or not token.isprintable() or " " in token:
        raise InvalidOption("The token cannot be sent.", allowed="printable ASCII without spaces")
    rest = [pair for pair in metadata if pair[0].lower() != "authorization"]
    return (*rest, ("authorization", f"Bearer {token}"))


def _read(file: PathLike | None) -> bytes | None:
    if file is None:
        return None
    try:
        return Path(file).read_bytes()
    except OSError as error:
        raise InvalidOption(f"{os.fspath(file)} cannot be read: {error.strerror}.") from error


def open_channel(target: str, credentials: grpc.ChannelCredentials | None) -> grpc.Channel:
    """A channel to host:port; it connects when the first call is made."""
    if credentials is None:
        return grpc.insecure_channel(target, options=OPTIONS)
    return grpc.secure_channel(target, credentials, options=OPTIONS)
