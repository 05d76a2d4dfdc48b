"""``unbend eval``: how good the models are on pictures whose distortion is known."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markdown import Markdown

from unbend_service.adapters.cores import usable_cores
from unbend_service.adapters.estimators.catalogue import load_estimator
from unbend_service.cli.reporting import console, errors_reported
from unbend_service.domain.errors import InvalidOption
from unbend_service.evaluation.cases import Photograph, read_photographs
from unbend_service.evaluation.chessboards import OPENCV_DOC
from unbend_service.evaluation.families import FAMILIES
from unbend_service.evaluation.figures import Gallery
from unbend_service.evaluation.methods import Method, model_method, peer_methods
from unbend_service.evaluation.report import REPORT, Evaluation
from unbend_service.evaluation.suites import DRAWN_LENSES, OBLIQUE, SUITES, SYNTHETIC, run_suite

_FACADES = "facades_spb"


def evaluate(
    photos: Annotated[Path, typer.Option(help="Straight photographs; the validation split of an index.csv.")],
    model: Annotated[list[str] | None, typer.Option(help="Of a shipped model, or a path; may be repeated.")] = None,
    suite: Annotated[str, typer.Option(help=f"Any of {', '.join(SUITES)}, {DRAWN_LENSES}.")] = ",".join(SUITES),
    families: Annotated[str, typer.Option(help="Of the synthetic suite.")] = ",".join(FAMILIES),
    limit: Annotated[int, typer.Option(min=1, help="Most photographs of a suite.")] = 150,
    per_camera: Annotated[int, typer.Option(min=1, help="Photographs for each of the real lenses.")] = 5,
    facades: Annotated[str, typer.Option(help="Source in index.csv of the oblique suite's photographs.")] = _FACADES,
    scenes: Annotated[Path | None, typer.Option(help=f"Drawn scenes: more for oblique; {DRAWN_LENSES}.")] = None,
    chessboards: Annotated[Path, typer.Option(help="left01.jpg, right01.jpg ... of two real cameras.")] = OPENCV_DOC,
    show: Annotated[str, typer.Option(help="Sources whose photographs may appear in figures.")] = _FACADES,
    peers: Annotated[bool, typer.Option(help="Also measure doing nothing, peers, floors and the true map.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for the page, its figures and all measurements.")] = Path(
        "evaluation"
    ),
) -> None:
    """Measure models on straight photographs under known distortions, and write tables of it."""
    with errors_reported():
        chosen = suite.split(",")
        for name in chosen:
            if name not in (*SUITES, DRAWN_LENSES):
                raise InvalidOption(f"There is no suite {name!r}.", allowed=", ".join((*SUITES, DRAWN_LENSES)))
            if name == DRAWN_LENSES and scenes is None:
                raise InvalidOption(f"The suite {name} needs --scenes.", allowed="a folder of pictures")
        estimators = [load_estimator(name, usable_cores()) for name in model or ["lineset"]]
        methods: list[Method] = [model_method(estimator) for estimator in estimators]
        if peers:
            methods += peer_methods(estimators[0])
        photographs = read_photographs(photos, limit)
        evaluation = Evaluation(
            f"{len(photographs)} photographs of {photos.name}",
            {estimator.model.name: estimator.model.sha256 for estimator in estimators},
        )
        evaluation.gallery = Gallery(frozenset(show.split(",")))
        for name in chosen:
            evaluation.measured[name] = run_suite(
                name,
                methods,
                _facades(photos, limit, facades) if name == OBLIQUE else photographs,
                families=families.split(","),
                per_camera=per_camera,
                chessboards=chessboards,
                scenes=None if scenes is None else read_photographs(scenes, limit),
                witness=evaluation.gallery.see if name == SYNTHETIC else None,
            )
        evaluation.write(out)
    console.print(Markdown(evaluation.markdown()) if console.is_terminal else evaluation.markdown(), markup=False)
    console.print(f"{out / REPORT}", soft_wrap=True)


def _facades(folder: Path, limit: int, source: str) -> list[Photograph]:
    """Those of the source that is named; of a folder without an index, all."""
    photographs = read_photographs(folder, 10**9)
    return ([p for p in photographs if p.source == source] or photographs)[:limit]
