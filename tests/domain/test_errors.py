from __future__ import annotations

import re

import pytest

from unbend_service.domain import errors
from unbend_service.domain.errors import InvalidInput, InvalidOption, UnbendError


def classes(root: type[UnbendError] = UnbendError) -> list[type[UnbendError]]:
    return [root, *(leaf for child in root.__subclasses__() for leaf in classes(child))]


def own() -> list[type[UnbendError]]:
    return [one for one in classes() if one.__module__ == errors.__name__]


def test_codes_are_unique() -> None:
    """A client may tell every error by its code."""
    codes = [one.code for one in own()]
    assert len(set(codes)) == len(codes)
    assert all(re.fullmatch(r"[a-z]+(_[a-z]+)*", code) for code in codes)


@pytest.mark.parametrize("one", own(), ids=lambda one: one.__name__)
def test_every_class_has_its_own_code_and_says_what_it_is(one: type[UnbendError]) -> None:
    """No leaf inherits its parent's code by mistake."""
    assert "code" in vars(one)
    assert one.__doc__


def test_the_drawn_tree_is_the_tree() -> None:
    """The module's docstring shows every class, and each below its parent."""
    pattern = re.compile(r"^    ([│ ├└─]*)([A-Z]\w+)$", re.MULTILINE)
    drawn = [(len(match[1]) // 4, match[2]) for match in pattern.finditer(errors.__doc__ or "")]
    path: list[str] = []
    parents = {}
    for depth, name in drawn:
        path[depth:] = [name]
        parents[name] = path[depth - 1] if depth else None
    actual = {one.__name__: None if one is UnbendError else one.__bases__[0].__name__ for one in own()}
    assert parents == actual


def test_the_message_says_how_to_mend_it() -> None:
    """What was wrong, what would have been allowed, and which setting governs it."""
    error = InvalidOption("fit='x' is not known.", allowed="keep, crop", setting="fit")
    assert str(error) == "fit='x' is not known. Allowed: keep, crop. Setting: fit."
    assert str(UnbendError("Broken.")) == "Broken."
    assert UnbendError("Later.", retry_after_s=2.5).retry_after_s == 2.5


def test_errors_are_what_python_calls_them() -> None:
    """A caller who knows only Python catches them as ValueError, LookupError and TimeoutError."""
    assert issubclass(InvalidInput, ValueError)
    assert issubclass(errors.GridNotFound, LookupError)
    assert issubclass(errors.DeadlineExceeded, TimeoutError)
