"""Renderers for worker processes that do what the first byte of the frame tells them. Loaded by name, in the worker."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import cv2

from unbend_service.adapters.renderers.cpu import CpuRenderer
from unbend_service.adapters.renderers.selection import RendererOptions
from unbend_service.application.ports import Bytes, RendererInfo
from unbend_service.domain.errors import RendererUnavailable
from unbend_service.domain.frames import Border, Frame
from unbend_service.domain.grid import Grid

DRAW, SLEEP, CRASH, KILLED_TWICE, KILLED, HANG, RAISE, WHO, STOPPED_ONCE, LOST, LOST_ONCE, THREADS = range(12)
STOPPED_TWICE = 12
SLEEP_S = 0.5


class MisbehavingRenderer:
    """Answers WHO with the number of its process in the first four bytes, THREADS with those of OpenCV in the first."""

    def __init__(self) -> None:
        self._renderer = CpuRenderer()

    @property
    def info(self) -> RendererInfo:
        return RendererInfo("cpu", "misbehaving", hardware=False)

    def render(self, source: Frame, grid: Grid, border: Border, target: Bytes) -> None:
        order = int(source.data[0])
        self._renderer.render(source, grid, border, target)
        if order == SLEEP:
            time.sleep(SLEEP_S)
        elif order == CRASH:
            os._exit(70)
        elif order == KILLED or (order == KILLED_TWICE and times_before() < 2):
            os.kill(os.getpid(), signal.SIGKILL)
        elif order == HANG:
            time.sleep(3600)
        elif (order == STOPPED_ONCE and times_before() < 1) or (order == STOPPED_TWICE and times_before() < 2):
            os.kill(os.getpid(), signal.SIGSTOP)
        elif order == LOST or (order == LOST_ONCE and times_before() < 1):
            raise RendererUnavailable("The OpenGL context is lost.")
        elif order == RAISE:
            raise ValueError("a renderer that fails")
        elif order == WHO:
            time.sleep(0.02)
            target[:4] = list(os.getpid().to_bytes(4))
        elif order == THREADS:
            target[0] = cv2.getNumThreads()

    def rest(self) -> None:
        self._renderer.rest()

    def close(self) -> None:
        self._renderer.close()


def times_before() -> int:
    """How often workers of this test came here before."""
    with Path(os.environ["UNBEND_TEST_MARK"]).open("a") as mark:
        before = mark.tell()
        mark.write("x")
    return before


def open_misbehaving(options: RendererOptions) -> MisbehavingRenderer:
    return MisbehavingRenderer()


def open_nothing(options: RendererOptions) -> MisbehavingRenderer:
    raise RendererUnavailable("There is nothing to render with.", setting="renderer")


def die_at_start(options: RendererOptions) -> MisbehavingRenderer:
    os._exit(3)


def die_at_restart(options: RendererOptions) -> MisbehavingRenderer:
    if times_before():
        os._exit(3)
    return MisbehavingRenderer()
