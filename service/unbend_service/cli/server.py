"""The options by which a command reaches a server: --server, and who says so, and over what."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypedDict

import typer

from unbend_service.cli.reporting import errors_reported
from unbend_service.domain.errors import InvalidOption


class ClientArguments(TypedDict):
    """Arguments of ``unbend.Client``."""

    token: str | None
    tls: bool
    ca_file: Path | None
    cert_file: Path | None
    key_file: Path | None


@dataclass(frozen=True, slots=True)
class Server:
    """Where a server is.

    Attributes:
        address: host:port of gRPC.
        token: None: that of the environment variable UNBEND_TOKEN, if there is one.
    """

    address: str
    token: str | None = field(default=None, repr=False)
    tls: bool = False
    ca_file: Path | None = None
    cert_file: Path | None = None
    key_file: Path | None = None

    def __str__(self) -> str:
        return self.address

    @property
    def arguments(self) -> ClientArguments:
        return ClientArguments(
            token=self.token, tls=self.tls, ca_file=self.ca_file, cert_file=self.cert_file, key_file=self.key_file
        )


_Address = Annotated[str | None, typer.Option("--server", metavar="HOST:PORT", help="gRPC address of a server.")]
_TokenFile = Annotated[
    Path | None,
    typer.Option(envvar="UNBEND_SERVER_TOKEN_FILE", help="Holds the token for the server; else UNBEND_TOKEN does."),
]
_Tls = Annotated[bool, typer.Option("--tls", envvar="UNBEND_SERVER_TLS", help="Reach the server over TLS.")]
_Ca = Annotated[
    Path | None,
    typer.Option(envvar="UNBEND_SERVER_CA", help="PEM authorities of the server, if not the system's; with TLS."),
]
_Cert = Annotated[
    Path | None, typer.Option(envvar="UNBEND_SERVER_CERT", help="PEM certificate to show to the server; with TLS.")
]
_Key = Annotated[Path | None, typer.Option(envvar="UNBEND_SERVER_KEY", help="PEM key of that certificate.")]


def _options(
    server: _Address = None,
    token_file: _TokenFile = None,
    tls: _Tls = False,
    ca: _Ca = None,
    cert: _Cert = None,
    key: _Key = None,
) -> Server | None:
    if server is None:
        return None
    return Server(server, None if token_file is None else _token(token_file), tls, ca, cert, key)


def reaches_server(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose parameter ``server`` is made of --server and the options that go with it."""
    given, ours = inspect.signature(command, eval_str=True), inspect.signature(_options, eval_str=True)
    parameters: list[inspect.Parameter] = []
    for parameter in given.parameters.values():
        parameters += ours.parameters.values() if parameter.name == "server" else [parameter]

    @functools.wraps(command)
    def reaching(**values: Any) -> None:
        with errors_reported():
            server = _options(**{name: values.pop(name) for name in ours.parameters})
        command(server=server, **values)

    reaching.__signature__ = given.replace(parameters=parameters)  # type: ignore[attr-defined] # typer reads it
    reaching.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return reaching


def _token(file: Path) -> str:
    """The token, which no message repeats."""
    try:
        token = file.read_text(encoding="ascii").strip()
    except OSError as error:
        raise InvalidOption(f"{file} cannot be read: {error.strerror}.", allowed="a file with a token") from error
    except UnicodeDecodeError as error:
        raise InvalidOption(f"{file} holds no token.", allowed="one line, as `unbend token new` prints it") from error
    if not token or len(token.split()) != 1:
        raise InvalidOption(f"{file} holds no token.", allowed="one line, as `unbend token new` prints it")
    return token
