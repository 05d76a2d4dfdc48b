"""Asks for known vulnerabilities of what requirements.lock names: ``python deploy/audit.py [pip-audit's options]``.

pip-audit takes a package that its service does not know, or an answer that is not the service's, for one to be passed
over, and still ends well. Here that is a failure: exits 0 only if every package was looked up and none is vulnerable, 1
if one is, 2 if the question could not be asked.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

LOCK = Path(__file__).resolve().parent.parent / "requirements.lock"


def verdict(report: str, complaint: str) -> tuple[int, str]:
    """Exit status and last line, from what pip-audit wrote: its JSON, and its standard error."""
    try:
        packages = json.loads(report)["dependencies"]
    except (ValueError, KeyError):
        last = (complaint.strip().splitlines() or ["pip-audit said nothing"])[-1]
        return 2, f"NOT AUDITED: the service of advisories was not reached: {last}"
    bad = [f"{one['name']} {one['version']}: {each['id']}" for one in packages for each in one.get("vulns", [])]
    skipped = [one["name"] for one in packages if "skip_reason" in one]
    if bad:
        return 1, f"VULNERABLE: {', '.join(bad)}"
    if skipped or not packages:
        return 2, (
            f"NOT AUDITED: {len(skipped)} of {len(packages)} packages are unknown to the service of advisories. "
            "Without a network to it, nothing is known; try -s osv, or --osv-url for one of your own."
        )
    return 0, f"OK: {len(packages)} packages, no known vulnerability"


def main() -> int:
    command = [sys.executable, "-m", "pip_audit", "--requirement", str(LOCK), "--disable-pip", "--require-hashes"]
    command += ["--format", "json", "--progress-spinner", "off", *sys.argv[1:]]
    asked = subprocess.run(command, capture_output=True, text=True, check=False)
    status, line = verdict(asked.stdout, asked.stderr)
    print(line)
    return status


if __name__ == "__main__":
    sys.exit(main())
