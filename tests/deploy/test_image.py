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


def test_it_names_no_registry_and_no_mirror() -> None:
    assert not re.search(r"https?://|--index-url|--extra-index-url|--trusted-host", DOCKERFILE)
    for image in re.findall(r"^(?:FROM|ARG BASE=)\s*(\S+)", DOCKERFILE, re.MULTILINE):
        assert "." not in image.partition("/")[0] or "/" not in image, image


def test_the_extras_are_installed_with_their_versions() -> None:
    project = {"dependencies": ["b>=1"], "optional-dependencies": {"x": ["a>=2"], "y": ["c"]}}
    assert requirements(project, ["x"]) == ["a>=2", "b>=1"]
    with pytest.raises(KeyError):
        requirements(project, ["z"])
