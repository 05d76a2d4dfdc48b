from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from unbend_service.adapters.renderers import egl
from unbend_service.adapters.renderers.selection import RendererOptions, open_renderer
from unbend_service.application.ports import RendererInfo
from unbend_service.domain.errors import RendererUnavailable


@dataclass
class FakeEgl:
    """Stands for EglRenderer on another machine."""

    hardware: bool = False
    missing: bool = False
    closed: int = 0
    devices: list[int] = field(default_factory=list)

    def __call__(self, device: int, cache_bytes: int) -> FakeEgl:
        self.devices.append(device)
        if self.missing:
            raise RendererUnavailable("no EGL here")
        return self

    @property
    def info(self) -> RendererInfo:
        return RendererInfo("egl", "NVIDIA H100" if self.hardware else "llvmpipe", self.hardware)

    def rest(self) -> None:
        pass

    def close(self) -> None:
        self.closed += 1


def opened(monkeypatch: pytest.MonkeyPatch, fake: FakeEgl, **options: object) -> str:
    monkeypatch.setattr(egl, "EglRenderer", fake)
    return open_renderer(RendererOptions(**options)).info.name


def test_auto_takes_a_hardware_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is a GPU it does the work, the one that was named."""
    fake = FakeEgl(hardware=True)
    assert opened(monkeypatch, fake, renderer="auto", egl_device=1, require_gpu=True) == "egl"
    assert fake.devices == [1]


@pytest.mark.parametrize("fake", [FakeEgl(), FakeEgl(missing=True)], ids=["software", "missing"])
def test_auto_falls_back_to_the_processor(monkeypatch: pytest.MonkeyPatch, fake: FakeEgl) -> None:
    """Without a GPU the cpu renderer does it: it is faster than OpenGL in software."""
    assert opened(monkeypatch, fake, renderer="auto") == "cpu"
    assert fake.closed == (0 if fake.missing else 1)


def test_egl_is_what_one_gets_when_one_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """egl means EGL, on software too, and an error where there is none."""
    assert opened(monkeypatch, FakeEgl(), renderer="egl") == "egl"
    with pytest.raises(RendererUnavailable, match="no EGL here"):
        opened(monkeypatch, FakeEgl(missing=True), renderer="egl")


def test_cpu_never_looks_for_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """cpu means cpu."""
    fake = FakeEgl(hardware=True)
    assert opened(monkeypatch, fake, renderer="cpu") == "cpu"
    assert fake.devices == []


@pytest.mark.parametrize("renderer", ["auto", "egl", "cpu"])
def test_a_required_gpu_is_never_replaced_by_software(monkeypatch: pytest.MonkeyPatch, renderer: str) -> None:
    """require_gpu turns every fallback into an error that says what is missing."""
    with pytest.raises(RendererUnavailable, match="GPU is required"):
        opened(monkeypatch, FakeEgl(), renderer=renderer, require_gpu=True)
