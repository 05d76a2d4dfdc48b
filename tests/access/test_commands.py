"""Commands that ask a server which asks who they are."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.access.conftest import Guarded
from tests.fakes import RECORD
from unbend_service.cli import app
from unbend_service.domain.access import Scope, new_token


def run(*arguments: object, code: int = 0, env: dict[str, str] | None = None) -> str:
    result = CliRunner().invoke(app, [*map(str, arguments)], env=env)
    assert result.exit_code == code, result.output
    return result.output


def test_a_command_shows_the_token_of_a_file_or_of_the_environment(
    guarded: Guarded, record_file: Path, tmp_path: Path
) -> None:
    """Neither the command line nor what is printed has the token in it."""
    token = guarded.tokens.only[Scope.GRIDS]
    file = tmp_path / "token"
    file.write_text(f"{token}\n")
    reached = ("--server", guarded.server.grpc, "--token-file", file)
    assert RECORD.id in run("grid", "import", record_file, *reached)
    assert RECORD.id in run("grid", "show", RECORD.id, *reached)
    named = {"UNBEND_SERVER_TOKEN_FILE": str(file)}
    assert RECORD.id in run("grid", "show", RECORD.id, "--server", guarded.server.grpc, env=named)
    assert RECORD.id in run("grid", "show", RECORD.id, "--server", guarded.server.grpc, env={"UNBEND_TOKEN": token})


def test_a_command_that_is_refused_says_what_it_needs(guarded: Guarded, tmp_path: Path) -> None:
    """No token, and one that nobody knows: the sentence names the options, and never the token."""
    assert "--token-file" in run("grid", "show", "g" * 8, "--server", guarded.server.grpc, code=1)
    wrong, file = new_token(), tmp_path / "token"
    file.write_text(wrong)
    output = run("grid", "show", "g" * 8, "--server", guarded.server.grpc, "--token-file", file, code=1)
    assert "--token-file" in output
    assert wrong not in output


@pytest.mark.parametrize("content", [None, "", "two words", "a\nb", "tök"])
def test_a_file_without_a_token_is_named(content: str | None, tmp_path: Path) -> None:
    file = tmp_path / "token"
    if content is not None:
        file.write_text(content)
    output = run("grid", "show", "x", "--server", "127.0.0.1:1", "--token-file", file, code=3)
    assert str(file) in output.replace("\n", "")
    assert "two words" not in output
