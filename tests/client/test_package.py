"""The package as it is installed: thin, quick to import, and all of its names on the front door."""

from __future__ import annotations

import ast
import importlib
import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import unbend
from unbend._errors import BY_CODE
from unbend_service.domain import errors as service_errors

FOLDER = Path(unbend.__file__).parent

THIN = """
import sys

class Wall:
    # typing_extensions is grpcio's own
    allowed = {"unbend", "numpy", "grpc", "typing_extensions", *sys.stdlib_module_names}

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.allowed or name == "google":
            return None
        if name.startswith(("google.protobuf", "google._upb")):
            return None
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Wall())
import unbend
for name in unbend.__all__:
    getattr(unbend, name)
"""


def test_nothing_but_numpy_grpc_and_protobuf_is_imported() -> None:
    result = subprocess.run([sys.executable, "-c", THIN], capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, unbend; print(*sorted({'numpy', 'grpc', 'google', 'asyncio'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert result.stdout.strip() == ""


def public_definitions() -> Iterator[tuple[str, str]]:
    """(module, name) of each class and type that the modules behind the front door define for it."""
    for home in unbend._HOMES:
        for node in ast.parse((FOLDER / f"{home}.py").read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield home, node.name


def test_every_public_class_is_on_the_front_door() -> None:
    told = {(home, name) for home, names in unbend._HOMES.items() for name in names}
    assert set(public_definitions()) | {("_types", "Image")} == told


def test_all_is_sorted_complete_and_can_be_loaded() -> None:
    assert unbend.__all__ == sorted(unbend.__all__)
    assert {name for name in unbend.__all__ if getattr(unbend, name) is not None} == set(unbend.__all__)
    assert set(unbend.__all__) <= set(dir(unbend))
    with pytest.raises(AttributeError, match="no_such_name"):
        unbend.no_such_name  # noqa: B018 looking is the point


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse((FOLDER / "__init__.py").read_text())
    guarded = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {
        (node.module.removeprefix("unbend."), alias.asname)
        for node in guarded.body
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
    }
    assert seen == {(home, name) for home, names in unbend._HOMES.items() for name in names}


def test_every_error_of_the_service_has_its_class_here_with_the_same_parents() -> None:
    def family(kind: type[Exception]) -> Iterator[type[Exception]]:
        yield kind
        for child in kind.__subclasses__():
            if child.__module__ == service_errors.__name__:
                yield from family(child)

    for kind in family(service_errors.UnbendError):
        ours = BY_CODE[kind.code]
        assert ours.__name__ == kind.__name__
        theirs = {parent.__name__ for parent in inspect.getmro(kind)}
        assert theirs <= {parent.__name__ for parent in inspect.getmro(ours)}


def test_the_tree_in_the_docstring_is_the_tree() -> None:
    module = importlib.import_module("unbend._errors")
    drawn = {word for line in module.__doc__.splitlines() for word in line.replace("─", " ").split()[:4]}
    defined = {kind.__name__ for kind in BY_CODE.values()}

    assert defined <= drawn
