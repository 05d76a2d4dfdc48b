"""The paper's sixteen numbers as guides."""

from __future__ import annotations

import numpy as np
import pytest

from unbend_service.adapters.estimators.coefficients import mirrored_coefficients
from unbend_service.domain.fitting import guides_from_map


def coefficients_of(bend: float, tilt: float) -> np.ndarray:
    """Of a map that is not its own mirror image, two cubic guides a direction."""

    def backward(target: np.ndarray) -> np.ndarray:
        x, y = target[..., 0], target[..., 1]
        return np.stack([x + bend * y * y + tilt * y, y - bend * x * x * y + 0.5 * tilt * x], -1)

    guides = guides_from_map(backward, (-0.6, 0.6), 3, polish=0)
    return np.stack([guides.rows.coefficients, guides.columns.coefficients])


@pytest.mark.parametrize(("bend", "tilt"), [(0.1, 0.0), (0.0, 0.2), (-0.08, 0.1)])
def test_mirroring_coefficients_is_mirroring_the_picture(bend: float, tilt: float) -> None:
    """What the network says of the mirror image can be averaged with what it says of the picture."""
    there = mirrored_coefficients(coefficients_of(bend, tilt))
    np.testing.assert_allclose(mirrored_coefficients(there), coefficients_of(bend, tilt), atol=1e-12)
    # seen in a mirror, x turns round: what pushed to the right pushes to the left, a turn goes the other way
    np.testing.assert_allclose(there[0, :, 1], -coefficients_of(bend, tilt)[0, :, 1], atol=1e-12)
    np.testing.assert_allclose(there[1, 0], -coefficients_of(bend, tilt)[1, 1], atol=1e-12)
