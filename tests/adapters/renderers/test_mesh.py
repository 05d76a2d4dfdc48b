from __future__ import annotations

import numpy as np
import pytest

from unbend_service.adapters.renderers.mesh import mesh_triangles, mesh_vertices
from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import target_lattice

COARSE = Grid(np.array([[[-0.9, -1.2], [1.1, -0.8]], [[-0.8, 0.9], [0.9, 1.3]]]))


@pytest.mark.parametrize("shape", [(2, 2), (3, 17), (65, 65), (1025, 2)])
def test_triangles_stay_close_to_the_bilinear_grid(shape: tuple[int, int]) -> None:
    """However coarse the lattice, no triangle is further from it than a twentieth of a pixel at 1920."""
    grid = Grid(COARSE(target_lattice(*shape)).astype(np.float32))
    inner = mesh_vertices(grid)[:-1, :-1].astype(np.float64)
    # the middle of the diagonal is where a triangle is furthest from the cell
    middle = (inner[1:, :-1] + inner[:-1, 1:]) / 2
    wanted = grid(middle[..., :2]) - middle[..., :2]
    assert np.abs(middle[..., 2:] - wanted).max() < 6e-5
    np.testing.assert_allclose(inner[..., 2:], grid(inner[..., :2]) - inner[..., :2], atol=1e-6)


def test_the_mesh_covers_the_target_and_goes_on_beyond_two_edges() -> None:
    """Chroma samples that lie on the very edge of the picture are inside the mesh."""
    vertices = mesh_vertices(Grid.identity(5, 9))
    assert vertices[0, 0, :2].tolist() == [-1, -1]
    assert vertices[-2, -2, :2].tolist() == [1, 1]
    assert vertices[-1, -1, :2].tolist() == [2, 2]
    assert not vertices[..., 2:].any()


def test_triangles_tile_every_cell_alike() -> None:
    """Two triangles for each cell, all of one orientation, together as large as the lattice."""
    rows, columns = 4, 6
    corners = target_lattice(rows, columns).reshape(-1, 2)[mesh_triangles(rows, columns)]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    assert len(areas) == 2 * (rows - 1) * (columns - 1)
    np.testing.assert_allclose(areas, 4 / len(areas))
