"""Who could reach a service with these settings, and whether it would ask who he is."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterator

from unbend_service.domain.errors import InvalidOption
from unbend_service.settings import Settings

_REMEDY = "UNBEND_TOKENS_FILE, or UNBEND_TLS_CLIENT_CA, or UNBEND_OPEN_ACCESS=true if that is meant"


def check_exposure(settings: Settings) -> list[str]:
    """Looks at every address that the service would listen on.

    Returns:
        Warnings, one sentence each: an address that others reach, where nobody has to show who he is.

    Raises:
        InvalidOption: the same, on every address of the machine, and ``open_access`` does not say that it is meant;
            or TLS is required and there is no certificate.
    """
    if settings.tls_required and settings.tls_cert is None:
        raise InvalidOption(
            "TLS is required and there is no certificate.", allowed="UNBEND_TLS_CERT and UNBEND_TLS_KEY"
        )
    warnings = []
    for setting, host, asked in _listeners(settings):
        if asked or settings.open_access:
            continue
        addresses = _addresses(host)
        if any(address.is_unspecified for address in addresses):
            raise InvalidOption(
                f"{host or 'An empty host'} is every address of this machine, and anybody may call.",
                allowed=_REMEDY,
                setting=setting,
            )
        if not all(address.is_loopback for address in addresses):
            warnings.append(f"Anybody who reaches {host} may call ({setting}). Remedy: {_REMEDY}.")
    return warnings


def _listeners(settings: Settings) -> Iterator[tuple[str, str, bool]]:
    """Setting, host, and whether callers there have to show who they are."""
    asked = settings.tokens_file is not None or settings.tls_client_ca is not None
    yield "http_host", settings.http_host, asked
    yield "grpc_host", settings.grpc_host, asked
    if settings.ops_port is not None:  # where no client certificate is asked for, since probes have none
        yield "ops_host", settings.ops_host, settings.tokens_file is not None


def _addresses(host: str) -> list[ipaddress.IPv4Address | ipaddress.IPv6Address]:
    """What the name stands for; nothing if it is not known, which binding will say in better words."""
    if host in ("", "*"):
        return [ipaddress.IPv4Address(0)]
    try:
        found = socket.getaddrinfo(host.strip("[]"), None, type=socket.SOCK_STREAM)
    except OSError:
        return []
    addresses = [ipaddress.ip_address(str(each[4][0]).partition("%")[0]) for each in found]
    return [getattr(address, "ipv4_mapped", None) or address for address in addresses]
