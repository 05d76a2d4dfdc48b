from __future__ import annotations

import httpx
import numpy as np
import pytest

from tests.fakes import barrel_guides
from unbend_service.domain.fit import Fit, with_fit, with_strength
from unbend_service.domain.grid import Grid
from unbend_service.domain.guides import Guides
from unbend_service.transport.rest.provenance import GridRecordBody

from .conftest import Bench


async def test_the_answer_is_the_json_of_the_design(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """Guides, grid, confidence, outcome and model, in centred coordinates, and nothing that OpenAPI does not say."""
    answer = (await client.post("/v1/estimate", content=jpeg)).json()
    fields = "grid_id confidence confidence_kind outcome reason strength guides grid model"
    assert answer.keys() == set(fields.split())
    GridRecordBody.model_validate(answer)
    assert answer["guides"] == barrel_guides().to_dict()
    grid = answer["grid"]
    assert (grid["rows"], grid["columns"], len(grid["source"])) == (17, 17, 289)
    assert answer["outcome"] == "corrected"
    assert Grid.from_dict(grid).id == answer["grid_id"]


async def test_correct_all_gives_the_map_itself(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """With correct=all the grid is the estimated map, rotation and perspective included."""
    answer = (await client.post("/v1/estimate?correct=all", content=jpeg)).json()
    np.testing.assert_allclose(
        Grid.from_dict(answer["grid"]).source, Grid.from_map(barrel_guides(), 17, 17).source, atol=1e-5
    )


@pytest.mark.parametrize(
    ("query", "fit", "strength"), [("fit=crop", "crop", 1), ("fit=full&strength=0.5", "full", 0.5)]
)
async def test_the_grid_is_the_one_that_the_query_describes(
    bench: Bench, jpeg: bytes, query: str, fit: str, strength: float
) -> None:
    """Fit and strength are in the grid that comes back and that is stored; rescaling happens only when asked for."""
    plain = Grid.from_dict((await bench.client.post("/v1/estimate", content=jpeg)).json()["grid"])
    answer = (await bench.client.post(f"/v1/estimate?{query}", content=jpeg)).json()
    expected = with_fit(with_strength(plain, strength), Fit.parse(fit))
    np.testing.assert_array_equal(Grid.from_dict(answer["grid"]).source, expected.source)
    assert answer["strength"] == strength
    assert (await bench.client.get(f"/v1/grids/{answer['grid_id']}")).json() == answer


async def test_a_straight_picture_is_left_alone(bench: Bench, jpeg: bytes) -> None:
    """Where nothing is bent, the answer says so and gives the grid that changes nothing."""
    bench.estimator.guides = Guides.straight()
    answer = (await bench.client.post("/v1/estimate", content=jpeg)).json()
    assert (answer["outcome"], answer["reason"]) == ("left_alone", "nothing_to_correct")
    np.testing.assert_allclose(
        np.array(answer["grid"]["source"]).reshape(17, 17, 2), Grid.identity(17, 17).source, atol=1e-6
    )


async def test_a_form_gives_the_same_answer(client: httpx.AsyncClient, jpeg: bytes) -> None:
    """Raw or as a form."""
    raw = await client.post("/v1/estimate", content=jpeg)
    assert (await client.post("/v1/estimate", files={"file": ("a.jpg", jpeg)})).content == raw.content
