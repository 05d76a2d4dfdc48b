from __future__ import annotations

from pathlib import Path

from typer.testing import CliRunner

from unbend_service.cli import app
from unbend_service.domain.access import TOKEN, Scope, digest_of, read_tokens


def test_the_token_is_shown_once_with_the_line_of_its_file() -> None:
    result = CliRunner().invoke(app, ["token", "new", "door", "--scope", "correct", "--scope", "grids", "--rate", "2"])
    assert result.exit_code == 0
    found = TOKEN.search(result.output)
    assert found is not None
    (grant,) = read_tokens(result.output.splitlines()[1].partition(": ")[2])
    assert (grant.name, grant.scopes, grant.rate_per_s) == ("door", {Scope.CORRECT, Scope.GRIDS}, 2.0)
    assert grant.digest == digest_of(found[0])


def test_a_file_gets_lines_and_never_a_secret(tmp_path: Path) -> None:
    file, secrets = tmp_path / "tokens", []
    file.write_text("# ours, without a newline at its end")
    for name in ("a", "b"):
        result = CliRunner().invoke(app, ["token", "new", name, "--scope", "metrics", "--file", str(file)])
        assert result.exit_code == 0
        secrets.append(result.stdout.splitlines()[0])
    grants = read_tokens(file.read_text())
    assert [(grant.name, grant.digest) for grant in grants] == [
        (name, digest_of(secret)) for name, secret in zip("ab", secrets, strict=True)
    ]
    assert not TOKEN.search(file.read_text())


def test_a_new_file_is_for_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "tokens"
    assert CliRunner().invoke(app, ["token", "new", "a", "--scope", "admin", "--file", str(file)]).exit_code == 0
    assert file.stat().st_mode & 0o777 == 0o600


def test_what_is_wrong_is_said(tmp_path: Path) -> None:
    assert CliRunner().invoke(app, ["token", "new", "a"]).exit_code == 2
    assert CliRunner().invoke(app, ["token", "new", "a", "--scope", "everything"]).exit_code == 2
    assert CliRunner().invoke(app, ["token", "new", "a b", "--scope", "grids"]).exit_code == 2
    missing = str(tmp_path / "missing" / "tokens")
    assert CliRunner().invoke(app, ["token", "new", "a", "--scope", "grids", "--file", missing]).exit_code == 1
