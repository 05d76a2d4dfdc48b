"""The suites: which pictures are shown to a method, and what is noted of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from unbend_service.domain.dense_maps import pixel_maps
from unbend_service.domain.grid import Grid
from unbend_service.domain.maps import target_lattice
from unbend_service.evaluation.cases import Bytes, Case, Float64, Photograph, grey_of, reduced
from unbend_service.evaluation.chessboards import chessboard_cases, has_chessboards
from unbend_service.evaluation.families import FAMILIES, family_cases, table_one_cases
from unbend_service.evaluation.lenses import lens_cases
from unbend_service.evaluation.measures import as_rendered, displacement_px, map_errors, ssim_and_mse
from unbend_service.evaluation.methods import Look, Method
from unbend_service.evaluation.oblique import oblique_cases
from unbend_service.evaluation.one_camera import TOGETHER, camera_cases, together

SYNTHETIC, NO_HARM, REAL_LENSES, OBLIQUE, TABLE_ONE = "synthetic", "no-harm", "real-lenses", "oblique", "table-1"
ONE_CAMERA, DRAWN_LENSES = "one-camera", "drawn-lenses"
SUITES = (SYNTHETIC, NO_HARM, REAL_LENSES, OBLIQUE, ONE_CAMERA, TABLE_ONE)
"""Of photographs. `DRAWN_LENSES` needs drawn scenes besides."""
_WHOLE_LONG_SIDE_PX = 512
_EVERYWHERE = target_lattice(33, 33).reshape(-1, 2)


@dataclass(frozen=True)
class Measurement:
    """One picture and one method; px are those of a picture whose long side is 256.

    Attributes:
        group: family or camera.
        picture: number of the picture in its suite, the same for every method.
        nothing_px, error_px: EPE of everything, of doing nothing and of `correct=all`.
        lens_nothing_px, lens_px: the same up to a homography, of doing nothing and of `correct=nonlinear`.
        applied_px: of the lens as the service leaves it, with the caution that the model's card advises.
        moved_px, applied_moved_px: mean displacement by `correct=nonlinear`, as estimated and as applied.
        confidence, applies, expected_error_px, seconds: see :class:`~.methods.Look`.
        ssim_nothing, ssim, mse_nothing, mse: of the picture corrected with `all`; None where there is no original.
    """

    group: str
    picture: int
    nothing_px: float
    error_px: float
    lens_nothing_px: float
    lens_px: float
    applied_px: float
    moved_px: float
    applied_moved_px: float
    confidence: float
    applies: bool
    expected_error_px: float | None
    seconds: float
    ssim_nothing: float | None = None
    ssim: float | None = None
    mse_nothing: float | None = None
    mse: float | None = None


#: Called with a case, its number and the look at it: figures are made of them.
Witness = Callable[[Case, Look, Measurement], None]


def run_suite(
    name: str,
    methods: list[Method],
    photographs: list[Photograph],
    *,
    families: Iterable[str] = FAMILIES,
    per_camera: int = 5,
    chessboards: Path | None = None,
    scenes: list[Photograph] | None = None,
    quality: bool = True,
    witness: Witness | None = None,
) -> dict[str, list[Measurement]]:
    """Method name -> its measurements; every method sees the same pictures, each of which is made once.

    Args:
        name: one of SUITES, or DRAWN_LENSES.
        per_camera: photographs a camera of the real lenses.
        chessboards: folder of left01.jpg, right01.jpg and so on, for the real lenses.
        scenes: more straight pictures for the oblique suite; what the lenses of the drawn suite see. Photographs bring
            a mild lens of their own, which counts as error of whoever straightens it; drawn scenes have none.
        quality: whether SSIM and MSE are measured where there is an original.
    """
    if name == ONE_CAMERA:
        return {method.name: list(_cameras(method, photographs)) for method in methods}
    cases: Iterator[Case]
    if name == SYNTHETIC:
        cases = (case for family in families for case in family_cases(family, photographs))
    elif name == NO_HARM:
        cases = (_whole(photograph) for photograph in photographs)
    elif name == REAL_LENSES:
        cases = _real_lenses(photographs, per_camera, chessboards)
    elif name == DRAWN_LENSES:
        cases = lens_cases(scenes or [], per_camera)
    elif name == OBLIQUE:
        cases = oblique_cases(photographs + (scenes or []))
    elif name == TABLE_ONE:
        cases = table_one_cases(photographs)
    else:
        raise ValueError(f"There is no suite {name!r}.")
    measured: dict[str, list[Measurement]] = {method.name: [] for method in methods}
    for number, case in enumerate(cases):
        nothing = errors_of_nothing(case)
        for method in methods:
            look = method.look(case)
            measured_here = quality and name in (SYNTHETIC, TABLE_ONE)
            measurement = measure(case, look, number, quality=measured_here, nothing=nothing)
            measured[method.name].append(measurement)
            if witness is not None and method is methods[0]:
                witness(case, look, measurement)
    return measured


def _cameras(method: Method, photographs: list[Photograph]) -> Iterator[Measurement]:
    for cases in camera_cases(photographs):
        looks = [method.look(case) for case in cases]
        for case, look in zip(cases, looks, strict=True):
            yield measure(case, look, quality=False)
        fused = measure(cases[0], together(looks, method), quality=False)
        yield replace(fused, group=cases[0].group + TOGETHER)


def errors_of_nothing(case: Case) -> tuple[float, float]:
    """EPE of doing nothing, px: of everything, and up to a homography."""
    return map_errors(lambda points: points, *case.correspondences(), case.half_px)


def measure(
    case: Case, look: Look, number: int = 0, *, quality: bool = True, nothing: tuple[float, float] | None = None
) -> Measurement:
    """What one look at one case is worth; `nothing` spares working out again what doing nothing is worth."""
    target, truth = case.correspondences()
    half_px = case.half_px
    lens, everything = as_rendered(look.lens), as_rendered(look.everything)
    nothing_px, lens_nothing_px = nothing or errors_of_nothing(case)
    error_px = float(np.hypot(*((everything(target) - truth) * half_px).T).mean())
    _, lens_px = map_errors(lens, target, truth, half_px)
    moved_px = displacement_px(lens, _EVERYWHERE, half_px)
    applied_px, applied_moved_px = (lens_px, moved_px) if look.applies else (lens_nothing_px, 0.0)
    if look.applies and look.applied.id != look.lens.id:
        applied = as_rendered(look.applied)
        _, applied_px = map_errors(applied, target, truth, half_px)
        applied_moved_px = displacement_px(applied, _EVERYWHERE, half_px)
    ssim_nothing = ssim = mse_nothing = mse = None
    if quality and case.original is not None:
        ssim_nothing, mse_nothing = ssim_and_mse(case.picture, case.original, case.shown)
        ssim, mse = ssim_and_mse(rendered(case.picture, look.everything), case.original, case.shown)
    return Measurement(
        group=case.group,
        picture=number,
        nothing_px=nothing_px,
        error_px=error_px,
        lens_nothing_px=lens_nothing_px,
        lens_px=lens_px,
        applied_px=applied_px,
        moved_px=moved_px,
        applied_moved_px=applied_moved_px,
        confidence=look.confidence,
        applies=look.applies,
        expected_error_px=look.expected_error_px,
        seconds=look.seconds,
        ssim_nothing=ssim_nothing,
        ssim=ssim,
        mse_nothing=mse_nothing,
        mse=mse,
    )


def rendered(picture: Bytes, grid: Grid) -> Bytes:
    """The grey picture corrected, its border continued."""
    height, width = picture.shape
    map_x, map_y = pixel_maps(grid, width, height)
    corrected = cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(corrected, np.uint8)


def _whole(photograph: Photograph) -> Case:
    return Case("undistorted", grey_of(reduced(photograph.pixels, _WHOLE_LONG_SIDE_PX)), _identity)


def _identity(target: Float64) -> Float64:
    return target


def _real_lenses(photographs: list[Photograph], per_camera: int, chessboards: Path | None) -> Iterator[Case]:
    yield from lens_cases(photographs, per_camera)
    if chessboards is not None and has_chessboards(chessboards):
        yield from chessboard_cases(chessboards)
