"""Decoders that die, hang, run out of memory, or lie."""

from __future__ import annotations

import gc
import io
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import psutil
import pytest
from PIL import Image

from tests.fakes import RecordingMeter
from unbend_service.adapters.codecs.pillow import PillowCodec
from unbend_service.adapters.decoding.codec import IsolatedCodec
from unbend_service.adapters.decoding.pool import DecoderPool
from unbend_service.adapters.decoding.process import Verdict
from unbend_service.domain.errors import ImageTooCostly, InvalidImage, MemoryFull
from unbend_service.settings import Settings


def png(width: int, height: int) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (width, height), (10, 20, 30)).save(out, "png", compress_level=1)
    return out.getvalue()


SMALL = png(64, 48)
LARGE = png(6000, 4000)

Open = Callable[..., IsolatedCodec]


@pytest.fixture
def meter() -> RecordingMeter:
    return RecordingMeter()


@pytest.fixture
def open_codec(meter: RecordingMeter) -> Iterator[Open]:
    opened = []

    def build(**settings: Any) -> IsolatedCodec:
        built = Settings(**{"decoders": 1, **settings})
        codec = IsolatedCodec(DecoderPool(built, meter), PillowCodec(built))
        codec.start()
        codec.decode(SMALL)  # it is up
        opened.append(codec)
        return codec

    yield build
    for codec in opened:
        codec.close()


def decoder() -> psutil.Process:
    """The one decoder that runs."""
    children = psutil.Process().children()
    (found,) = [child for child in children if "unbend_service.adapters.decoding.decoder" in child.cmdline()]
    return found


def struck(codec: IsolatedCodec, number: int) -> list[object]:
    """What comes of a large picture whose decoder gets a signal in the middle of it."""
    results: list[object] = []

    def decode() -> None:
        try:
            results.append(codec.decode(LARGE).frame.width)
        except Exception as error:
            results.append(error)

    process = decoder()
    thread = threading.Thread(target=decode)
    thread.start()
    before = process.cpu_times().user
    while thread.is_alive() and process.cpu_times().user < before + 0.02:
        time.sleep(0.005)
    process.send_signal(number)
    thread.join()
    return results


def test_a_picture_that_needs_too_much_memory_is_refused(open_codec: Open) -> None:
    """The bound is that of the process; the next picture finds a decoder again."""
    codec = open_codec(decode_memory_bytes=64 << 20)
    with pytest.raises(ImageTooCostly) as caught:
        codec.decode(LARGE)
    assert caught.value.code == "image_too_costly"
    assert codec.decode(SMALL).frame.width == 64


def test_a_picture_that_takes_too_long_is_given_up(open_codec: Open, meter: RecordingMeter) -> None:
    """The decoder is ended, whatever it does, and replaced."""
    codec = open_codec(decode_deadline_s=1.0)
    hung = decoder()
    hung.suspend()
    started = time.monotonic()
    with pytest.raises(ImageTooCostly) as caught:
        codec.decode(SMALL)
    assert 1 <= time.monotonic() - started < 15
    assert caught.value.setting == "decode_deadline_s"
    assert not hung.is_running()
    assert meter.restarts["decoder_exhausted"] == 1


def test_a_picture_that_crashes_its_decoder_is_refused(open_codec: Open, meter: RecordingMeter) -> None:
    """It is not tried again, and takes nothing else down."""
    codec = open_codec()
    (result,) = struck(codec, signal.SIGSEGV)
    assert isinstance(result, InvalidImage)
    assert meter.restarts["decoder_crashed"] == 1
    assert codec.decode(SMALL).frame.width == 64


def test_a_decoder_that_is_killed_costs_nobody_his_picture(open_codec: Open, meter: RecordingMeter) -> None:
    """A kill comes from outside: the picture goes to another decoder."""
    codec = open_codec()
    assert struck(codec, signal.SIGKILL) == [6000]
    assert meter.restarts["decoder_killed"] == 1


def test_a_decoder_that_died_idle_is_replaced(open_codec: Open) -> None:
    """Nobody notices."""
    codec = open_codec()
    decoder().kill()
    time.sleep(0.2)
    assert codec.decode(SMALL).frame.width == 64


def test_the_memory_of_decoded_pictures_is_bounded(open_codec: Open) -> None:
    """Pictures that are held leave no room for more, and room again when they go; the decoder lives on."""
    codec = open_codec(pictures_bytes=100 << 20)
    process = decoder()
    held = codec.decode(LARGE)
    with pytest.raises(MemoryFull) as caught:
        codec.decode(LARGE)
    assert caught.value.setting == "pictures_bytes"
    assert decoder() == process
    del held
    gc.collect()
    assert codec.decode(LARGE).frame.width == 6000


def test_pictures_keep_their_pixels(open_codec: Open) -> None:
    """Memory is used again only when nobody looks at it any more."""
    codec = open_codec()
    pictures = [codec.decode(png(64 + i, 48)) for i in range(20)]
    views = [picture.frame.data[:3] for picture in pictures]
    del pictures
    for _ in range(20):
        codec.decode(png(100, 100))
    assert all((view == (10, 20, 30)).all() for view in views)


def test_a_decoder_knows_no_setting_and_holds_no_foreign_descriptor(
    monkeypatch: pytest.MonkeyPatch, open_codec: Open
) -> None:
    """Whoever takes a decoder over finds no token there, no socket, and no way to write a core."""
    monkeypatch.setenv("UNBEND_TOKEN", "secret")
    open_codec()
    process = decoder()
    assert "secret" not in str(process.environ())
    names = [os.readlink(f"/proc/{process.pid}/fd/{fd}") for fd in os.listdir(f"/proc/{process.pid}/fd")]
    assert sum(name.startswith("socket:") for name in names) == 1
    assert process.rlimit(psutil.RLIMIT_CORE) == (0, 0)
    limit, _ = process.rlimit(psutil.RLIMIT_AS)
    assert 0 < limit < 8 << 30


def test_nothing_is_left_when_the_pool_closes(meter: RecordingMeter) -> None:
    """No process, no descriptor."""
    gc.collect()
    before, others = len(os.listdir("/proc/self/fd")), psutil.Process().children()
    settings = Settings(decoders=2)
    codec = IsolatedCodec(DecoderPool(settings, meter), PillowCodec(settings))
    codec.start()
    codec.decode(SMALL)
    children = [child for child in psutil.Process().children() if child not in others]
    codec.close()
    gc.collect()
    assert len(children) == 2
    assert not any(child.is_running() for child in children)
    assert len(os.listdir("/proc/self/fd")) == before


LIES: list[tuple[dict[str, Any], tuple[int, ...]]] = [
    ({}, ()),
    ({"width": 10, "height": 10, "pixel_format": "rgb24", "part": 0}, (299,)),
    ({"width": -10, "height": -10, "pixel_format": "rgb24", "part": 0}, (300,)),
    ({"width": 10, "height": 10, "pixel_format": "nv12", "part": 0}, (150,)),
    ({"width": 10, "height": 10, "pixel_format": "rgb24", "part": 5}, (300,)),
    ({"width": 10, "height": 10, "pixel_format": "rgb24", "part": 0, "exif": 10**9}, (300, 10)),
    ({"width": 10.5, "height": "10", "pixel_format": "rgb24", "part": 0}, (300,)),
    ({"width": 10, "height": 10, "pixel_format": "rgb24", "part": 0, "chroma": "9:9:9"}, (300,)),
    ({"width": 10, "height": 10, "pixel_format": ["rgb24"], "part": 0, "icc": -4}, (300, 4)),
]


@pytest.mark.parametrize(("fields", "sizes"), LIES)
def test_a_decoder_that_lies_is_not_believed(fields: dict[str, Any], sizes: tuple[int, ...]) -> None:
    """Whatever it says, the service reads no byte beyond what it gave."""

    class Liar(DecoderPool):
        def __init__(self) -> None:
            pass

        def work(self, work: str, body: bytes, **options: Any) -> Verdict:
            return Verdict(fields, tuple(np.zeros(size, np.uint8) for size in sizes))

    codec = IsolatedCodec(Liar(), PillowCodec(Settings()))
    with pytest.raises(InvalidImage):
        codec.decode(SMALL)
