from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

from deploy.audit import LOCK, verdict
from deploy.lock import EXTRAS, wanted

ROOT = Path(__file__).resolve().parents[2]


def test_an_audit_that_was_not_made_is_not_passed() -> None:
    """No answer, an unknown package and an empty list are failures; only a complete answer without a finding is not."""
    fine = {"name": "a", "version": "1", "vulns": []}
    assert verdict("", "connection refused")[0] == 2
    assert verdict(json.dumps({"dependencies": []}), "")[0] == 2
    assert verdict(json.dumps({"dependencies": [fine, {"name": "b", "skip_reason": "unknown"}]}), "")[0] == 2
    assert verdict(json.dumps({"dependencies": [{**fine, "vulns": [{"id": "CVE-1"}]}]}), "")[0] == 1
    assert verdict(json.dumps({"dependencies": [fine]}), "")[0] == 0


def test_the_lock_holds_what_is_asked_for_at_the_versions_that_are_tested() -> None:
    """Every requirement is in the lock, with a hash, at the version of constraints.txt; no address is in it."""
    text = LOCK.read_text()
    assert "://" not in text
    locked = dict(re.findall(r"^([a-z0-9-]+)==(\S+) \\\n    --hash=sha256:[0-9a-f]{64}", text, re.MULTILINE))
    assert len(locked) == text.count("==")
    tested = dict(re.findall(r"^([A-Za-z0-9._-]+)==(\S+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE))
    for name, version in tested.items():
        key = re.sub(r"[-_.]+", "-", name).lower()
        assert locked.get(key, version) == version, name
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(EXTRAS) == set(project["optional-dependencies"])
    for requirement in wanted():
        assert re.split(r"[^A-Za-z0-9._-]", requirement)[0].lower() in locked, requirement
