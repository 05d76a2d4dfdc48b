from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from unbend_service.adapters.annotations.folder import AnnotationFolder
from unbend_service.domain.annotation import Annotation, Curve
from unbend_service.domain.errors import InvalidGuides


def annotation(image: str) -> Annotation:
    rows, columns = (tuple(Curve(np.array([[0.1, at]]), upright) for at in (-0.5, 0.5)) for upright in (False, True))
    return Annotation(image, 640, 480, rows, columns)


def test_the_pictures_of_the_folder_itself_are_listed_in_order(tmp_path: Path) -> None:
    """Neither other files nor what lies deeper."""
    for name in ("b.JPG", "a.png", "notes.txt", "a.png.unbend.json"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "deeper.jpg").mkdir()
    (tmp_path / "deeper.jpg" / "c.jpg").write_bytes(b"x")
    store = AnnotationFolder(tmp_path)
    assert store.names() == ["a.png", "b.JPG"]
    assert store.title == tmp_path.name


def test_an_annotation_lies_beside_its_picture_and_comes_back(tmp_path: Path) -> None:
    """Another sitting goes on where the last one stopped; nothing half written stays behind."""
    (tmp_path / "a.jpg").write_bytes(b"x")
    store = AnnotationFolder(tmp_path)
    assert store.read("a.jpg") is None
    store.write(annotation("a.jpg"))
    store.write(replace(annotation("a.jpg"), width=320))
    kept = AnnotationFolder(tmp_path).read("a.jpg")
    assert kept is not None
    assert kept.to_dict() == replace(annotation("a.jpg"), width=320).to_dict()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.jpg", "a.jpg.unbend.json"]


@pytest.mark.parametrize("name", ["../secret.jpg", "/etc/passwd", "b.jpg", "", "a.jpg.unbend.json"])
def test_no_name_leads_out_of_the_folder(tmp_path: Path, name: str) -> None:
    """Names are looked up among those that were found, never joined to a path."""
    folder = tmp_path / "folder"
    folder.mkdir()
    (tmp_path / "secret.jpg").write_bytes(b"secret")
    (folder / "a.jpg").write_bytes(b"x")
    store = AnnotationFolder(folder)
    assert store.picture(name) is None
    assert store.read(name) is None
    with pytest.raises(KeyError):
        store.write(annotation(name))


def test_a_file_that_is_no_annotation_is_said_and_not_lost(tmp_path: Path) -> None:
    """The error names it, and reading changes nothing."""
    (tmp_path / "a.jpg").write_bytes(b"x")
    (tmp_path / "a.jpg.unbend.json").write_text("{")
    with pytest.raises(InvalidGuides, match=r"a\.jpg\.unbend\.json is not JSON"):
        AnnotationFolder(tmp_path).read("a.jpg")
    assert (tmp_path / "a.jpg.unbend.json").read_text() == "{"
