from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.application.conftest import Application
from unbend_service.application.correction import CorrectOptions
from unbend_service.domain.errors import GridNotFound, InvalidOption, QueueFull
from unbend_service.domain.fit import FULL, KEEP
from unbend_service.domain.frames import Border, Frame, PixelFormat
from unbend_service.domain.guides import Guides
from unbend_service.domain.records import Outcome


async def test_a_picture_comes_back_in_its_own_format_and_size(application: Application, jpeg: bytes) -> None:
    result = await application.correction.of_image(jpeg, CorrectOptions())
    decoded = cv2.imdecode(np.frombuffer(result.body, np.uint8), cv2.IMREAD_COLOR)
    assert result.image_format == "jpeg"
    assert decoded is not None
    assert decoded.shape == (96, 128, 3)
    assert application.meter.frames == {"corrected": 1}


@pytest.mark.parametrize(("image_format", "magic"), [("png", b"\x89PNG"), ("webp", b"RIFF"), ("jpeg", b"\xff\xd8")])
async def test_another_format_is_written_when_asked_for(
    application: Application, jpeg: bytes, image_format: str, magic: bytes
) -> None:
    result = await application.correction.of_image(jpeg, CorrectOptions(image_format=image_format))
    assert result.image_format == image_format
    assert result.body.startswith(magic)


async def test_a_picture_that_is_left_alone_comes_back_byte_for_byte(application: Application, jpeg: bytes) -> None:
    application.estimator.guides = Guides.straight()
    result = await application.correction.of_image(jpeg, CorrectOptions())
    assert result.body == jpeg
    assert result.record.outcome is Outcome.LEFT_ALONE
    assert application.pool.rendered == 0
    assert application.meter.frames == {"left_alone": 1}


async def test_a_known_grid_is_used_without_an_estimate(application: Application, jpeg: bytes) -> None:
    record = await application.estimation.of_image(jpeg)
    seen = len(application.estimator.seen)
    result = await application.correction.of_image(jpeg, CorrectOptions(grid_id=record.id))
    assert result.record.id == record.id
    assert len(application.estimator.seen) == seen


async def test_an_unknown_grid_is_refused(application: Application, jpeg: bytes) -> None:
    with pytest.raises(GridNotFound):
        await application.correction.of_image(jpeg, CorrectOptions(grid_id="g" + "0" * 32))


async def test_an_unknown_format_is_refused_before_anything_is_done(application: Application, jpeg: bytes) -> None:
    with pytest.raises(InvalidOption, match="gif"):
        await application.correction.of_image(jpeg, CorrectOptions(image_format="gif"))
    assert not application.estimator.seen


async def test_fit_full_paints_the_border_and_crop_does_not(application: Application) -> None:
    frame = Frame(PixelFormat.RGB24, 64, 48, np.full(64 * 48 * 3, 200, np.uint8))
    red = Border(255, 0, 0)
    full = await application.correction.of_frame(frame, CorrectOptions(fit=FULL, border=red))
    crop = await application.correction.of_frame(frame, CorrectOptions(border=red))
    assert (full.frame.plane_arrays()[0] == (255, 0, 0)).all(axis=-1).any()
    assert (crop.frame.data == 200).all()


async def test_a_grid_is_fitted_once_and_then_remembered(application: Application, jpeg: bytes) -> None:
    for _ in range(3):
        await application.correction.of_image(jpeg, CorrectOptions())
    assert application.meter.cache == {False: 1, True: 2}
    await application.correction.of_image(jpeg, CorrectOptions(fit=KEEP))
    assert application.meter.cache == {False: 1, True: 2}


async def test_a_frame_that_cannot_be_rendered_is_counted_as_failed(application: Application, jpeg: bytes) -> None:
    application.pool.failure = QueueFull("Too many frames wait.")
    with pytest.raises(QueueFull):
        await application.correction.of_image(jpeg, CorrectOptions())
    assert application.meter.frames == {"failed": 1}
