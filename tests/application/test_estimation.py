from __future__ import annotations

import numpy as np
import pytest

from tests.application.conftest import Application
from tests.fakes import FAKE_MODEL
from unbend_service.domain.errors import InvalidImage, InvalidOption
from unbend_service.domain.fit import CROP
from unbend_service.domain.guides import Guides
from unbend_service.domain.records import Correct, Outcome, Reason


async def test_an_estimate_is_stored_under_its_id_and_counted(application: Application, jpeg: bytes) -> None:
    record = await application.estimation.of_image(jpeg)
    assert record.outcome is Outcome.CORRECTED
    assert (await application.store.get(record.id)).grid.id == record.id
    assert application.meter.estimates == {"corrected": 1}
    assert {"decode", "estimate", "grid"} <= application.meter.stages.keys()


async def test_the_returned_grid_is_the_one_that_fit_and_strength_describe(
    application: Application, jpeg: bytes
) -> None:
    keep = await application.estimation.of_image(jpeg)
    crop = await application.estimation.of_image(jpeg, fit=CROP)
    half = await application.estimation.of_image(jpeg, strength=0.5)
    assert len({keep.id, crop.id, half.id}) == 3
    assert np.abs(crop.grid.source).max() <= 1
    assert half.grid.displacement == pytest.approx(keep.grid.displacement / 2, rel=1e-4)
    assert half.strength == 0.5


async def test_too_little_confidence_leaves_the_picture_alone_and_says_why(
    application: Application, jpeg: bytes
) -> None:
    application.estimator.confidence = 0.4
    record = await application.estimation.of_image(jpeg)
    assert (record.outcome, record.reason) == (Outcome.LEFT_ALONE, Reason.LOW_CONFIDENCE)
    assert record.grid.displacement == 0
    asked_for = await application.estimation.of_image(jpeg, min_confidence=0.3)
    assert asked_for.outcome is Outcome.CORRECTED


async def test_in_doubt_the_card_advises_a_little_and_a_threshold_overrules_it(
    advised: Application, jpeg: bytes
) -> None:
    """The advice is for the lens: everything, when asked for, is corrected all the way."""
    advised.estimator.confidence = 0.4
    doubted = await advised.estimation.of_image(jpeg)
    assert (doubted.outcome, doubted.reason) == (Outcome.CORRECTED, Reason.LOW_CONFIDENCE)
    assert 0 < doubted.strength < 1
    assert doubted.grid.displacement == pytest.approx(FAKE_MODEL.caution.doubtful_displacement, rel=1e-3)
    for certain in (
        await advised.estimation.of_image(jpeg, min_confidence=0.4),
        await advised.estimation.of_image(jpeg, Correct.ALL),
    ):
        assert (certain.outcome, certain.reason, certain.strength) == (Outcome.CORRECTED, Reason.NONE, 1.0)


async def test_straight_guides_leave_the_picture_alone(application: Application, jpeg: bytes) -> None:
    application.estimator.guides = Guides.straight()
    record = await application.estimation.of_image(jpeg, Correct.ALL)
    assert (record.outcome, record.reason) == (Outcome.LEFT_ALONE, Reason.NOTHING_TO_CORRECT)


async def test_a_large_picture_reaches_the_estimator_reduced(application: Application) -> None:
    import cv2

    body = cv2.imencode(".jpg", np.zeros((3000, 4000, 3), np.uint8))[1].tobytes()
    await application.estimation.of_image(body)
    assert max(application.estimator.seen[-1]) <= 2048


@pytest.mark.parametrize("value", [-0.1, 1.1, float("nan")])
async def test_a_confidence_or_strength_out_of_range_is_refused(
    application: Application, jpeg: bytes, value: float
) -> None:
    with pytest.raises(InvalidOption, match="min_confidence"):
        await application.estimation.of_image(jpeg, min_confidence=value)
    with pytest.raises(InvalidOption, match="strength"):
        await application.estimation.of_image(jpeg, strength=value)


async def test_a_truncated_picture_is_refused_and_nothing_is_stored(application: Application, jpeg: bytes) -> None:
    with pytest.raises(InvalidImage):
        await application.estimation.of_image(jpeg[: len(jpeg) // 2])
    assert not application.estimator.seen
