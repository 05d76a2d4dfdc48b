"""What the Dockerfile says; `deploy/verify-image` builds and runs it, which takes minutes and is no test of CI."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.image.requirements import requirements
from unbend_service.settings import Settings

ROOT = Path(__file__).parent.parent.parent
DOCKERFILE = (ROOT / "Dockerfile").read_text()
FINAL = DOCKERFILE.rpartition("\nFROM ")[2]
HADOLINT = Path(sys.executable).parent / "hadolint"


@pytest.mark.deploy
def test_hadolint_finds_nothing_wrong() -> None:
    # DL3008 wants pinned Debian packages, which vanish from the mirrors with every security update
    command = [HADOLINT, "--ignore", "DL3008", ROOT / "Dockerfile"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_it_runs_as_a_user_without_rights_by_number_so_that_kubernetes_can_tell() -> None:
    assert re.search(r"^USER (\d+):(\d+)$", FINAL, re.MULTILINE)


def test_the_environment_names_settings_that_exist() -> None:
    given = {name.lower(): value for name, value in re.findall(r"\bUNBEND_([A-Z_]+)=(\S+)", FINAL)}
    assert given
    assert given.keys() <= Settings.model_fields.keys()
    Settings(**given)


def test_both_ways_to_draw_are_in_it() -> None:
    assert "libgl1-mesa-dri" in FINAL
    assert "NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility" in FINAL
    assert "egl_vendor.d/10_nvidia.json" in FINAL


def test_what_is_copied_is_sent_to_the_builder() -> None:
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    sent = [line[1:] for line in ignored if line.startswith("!")]
    for line in re.findall(r"^COPY (?!--from)(.+)$", DOCKERFILE, re.MULTILINE):
        for source in line.split()[:-1]:
            assert any(f"{each}/".startswith(f"{source}/") or source.startswith(f"{each}/") for each in sent), source


def test_it_names_no_registry_and_no_mirror() -> None:
    assert not re.search(r"https?://|--index-url|--extra-index-url|--trusted-host", DOCKERFILE)
    for image in re.findall(r"^(?:FROM|ARG BASE=)\s*(\S+)", DOCKERFILE, re.MULTILINE):
        assert "." not in image.partition("/")[0] or "/" not in image, image


def test_only_what_the_lock_knows_by_its_hash_is_installed() -> None:
    """Every package of the image is one that was locked: pip refuses whatever has another content."""
    assert "PIP_REQUIRE_HASHES=1" in DOCKERFILE
    assert "constraints.txt" not in DOCKERFILE
    (extras,) = re.findall(r'^ARG EXTRAS="(.+)"$', DOCKERFILE, re.MULTILINE)
    needed = requirements((ROOT / "requirements.lock").read_text(), extras.split())
    names = re.findall(r"^([a-z0-9-]+)==\S+ \\\n    --hash=sha256:[0-9a-f]{64}", needed, re.MULTILINE)
    assert len(names) == needed.count("==")
    assert {"numpy", "fastapi", "redis", "openexr", "lensfunpy", "opentelemetry-sdk"} <= set(names)
    assert "av" not in names


def test_an_image_may_have_fewer_extras() -> None:
    entry = "{}==1 \\\n    --hash=sha256:0\n    # for {}"
    lock = "# Written.\n\n" + "\n".join(
        [entry.format("a", "core x"), entry.format("b-c", "x"), entry.format("d", "y z")]
    )
    assert requirements(lock, []) == entry.format("a", "core x")
    assert requirements(lock, ["z"]).splitlines()[3:] == entry.format("d", "y z").splitlines()
    assert requirements(lock, ["x", "z"], only=["b-c"]) == entry.format("b-c", "x")
    with pytest.raises(KeyError):
        requirements(lock, ["w"])
