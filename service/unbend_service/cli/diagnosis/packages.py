"""Versions of what matters, and the extras."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata

from unbend_service.adapters.codecs.planar_jpegs import LIBRARY, PlanarJpegs
from unbend_service.cli.diagnosis.finding import Finding

#: Their versions are what a bug report needs.
_TOLD = (
    "numpy",
    "grpcio",
    "protobuf",
    "onnxruntime",
    "moderngl",
    "opencv-python-headless",
    "pillow",
    "simplejpeg",
    "fastapi",
    "uvicorn",
)


@dataclass(frozen=True, slots=True)
class Extra:
    """An extra of the distribution.

    Attributes:
        distribution, module: what it installs, and what is imported of that.
        purpose: what does not work without it.
    """

    distribution: str
    module: str
    purpose: str


#: Every extra but ``service``, without which this would not run.
EXTRAS = {
    "redis": Extra("redis", "redis", "grids shared by replicas"),
    "video": Extra("av", "av", "unbend video, PyAV frames in the client"),
    "export": Extra("openexr", "OpenEXR", "STMaps as EXR"),
    "lensfun": Extra("lensfunpy", "lensfunpy", "grids from lensfun profiles"),
    "otel": Extra("opentelemetry-sdk", "opentelemetry.sdk", "traces"),
}


def examine_versions() -> Iterator[Finding]:
    """Unbend, Python and the packages that matter."""
    yield Finding("unbend", "ok", f"{metadata.version('unbend')} on Python {sys.version.split()[0]}")
    found, missing = [], []
    for name in _TOLD:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            missing.append(name)
    if missing:
        detail = f"without {', '.join(missing)}; {', '.join(found)}"
        yield Finding("packages", "bad", detail, "pip install 'unbend[service]'")
    else:
        yield Finding("packages", "ok", ", ".join(found))


def examine_turbojpeg() -> Finding:
    """The library of the system that keeps JPEGs in planes."""
    if PlanarJpegs().available:
        return Finding(LIBRARY, "ok", "JPEGs of 4:2:0 stay in planes")
    detail = "not found; JPEGs go the longer way, through RGB"
    return Finding(LIBRARY, "note", detail, "apt-get install libturbojpeg0, or the package of your system")


def examine_extras() -> Iterator[Finding]:
    """Each extra, by importing it: a package that is there and does not load is as good as missing."""
    for name, extra in EXTRAS.items():
        remedy = f"pip install 'unbend[{name}]'"
        try:
            importlib.import_module(extra.module)
        except ModuleNotFoundError as error:
            if f"{extra.module}.".startswith(f"{error.name}."):  # it, or a package around it
                yield Finding(f"extra {name}", "note", f"not installed; needed for {extra.purpose}", remedy)
            else:
                yield Finding(f"extra {name}", "note", f"{extra.module} lacks {error.name}", remedy)
        except ImportError as error:
            reinstall = f"{remedy} --force-reinstall, and the system library that it names"
            yield Finding(f"extra {name}", "note", f"does not load: {error}", reinstall)
        else:
            yield Finding(f"extra {name}", "ok", f"{extra.distribution} {_version(extra.distribution)}")


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "of unknown version"
