"""What opens an estimation node that asks for tokens or speaks TLS."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import grpc

from unbend_service.domain.errors import InvalidOption
from unbend_service.settings import Settings


class NodeCredentials(NamedTuple):
    """Of the channel (None speaks plain text), and the metadata of every call."""

    channel: grpc.ChannelCredentials | None
    metadata: tuple[tuple[str, str], ...]


def read_node_credentials(settings: Settings) -> NodeCredentials:
    """As the settings name them; the own certificate is shown to a node that asks for one.

    Raises:
        InvalidOption: a file cannot be read.
    """
    metadata: tuple[tuple[str, str], ...] = ()
    if settings.estimator_token_file is not None:
        token = _read("estimator_token_file", settings.estimator_token_file).strip()
        if not token.isascii() or not token.translate(None, b"_-").isalnum():
            raise InvalidOption("The file holds no token.", setting="estimator_token_file")
        metadata = (("authorization", f"Bearer {token.decode()}"),)
    if settings.estimator_ca is None:
        return NodeCredentials(None, metadata)
    authorities = _read("estimator_ca", settings.estimator_ca)
    key = cert = None
    if settings.tls_cert is not None and settings.tls_key is not None:
        key, cert = _read("tls_key", settings.tls_key), _read("tls_cert", settings.tls_cert)
    return NodeCredentials(grpc.ssl_channel_credentials(authorities, key, cert), metadata)


def _read(setting: str, path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InvalidOption(f"{path} cannot be read: {error.strerror}.", setting=setting) from None
