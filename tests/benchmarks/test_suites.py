from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path

import pytest

from benchmarks import summary
from benchmarks.__main__ import main
from benchmarks.measurement import Report, by_turns


@pytest.mark.parametrize(
    "suite", ["render", "stream", "http", "estimate", "startup", "scale", "replicas", "memory", "video"]
)
def test_every_suite_runs_and_says_what_it_compared(
    suite: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is one command, and its file names machine, commit, ratios with their bars, and every measurement."""
    file = tmp_path / f"{suite}.json"
    monkeypatch.setenv("UNBEND_DECODERS", "1")
    monkeypatch.setattr("sys.argv", ["benchmarks", suite, "--quick", "--json", str(file)])
    assert main() == 0
    report = json.loads(file.read_text())
    assert report["suite"] == suite
    assert report["machine"]["cores"] >= 1
    assert report["commit"]
    assert report["rows"]
    for ratio in report["ratios"].values():
        assert isinstance(ratio["value"], int | float)
        assert ratio["bar"].split()[0] in ("<=", ">=")


def test_pairs_are_timed_by_turns_and_compared_turn_by_turn() -> None:
    """A machine that slows down in the middle slows both sides, and who goes first alternates."""
    order: list[str] = []
    pair = by_turns(lambda: order.append("ours"), lambda: order.append("peer"), runs=4, warm_up=2)
    assert order == ["peer", "ours", "ours", "peer"] * 3
    assert pair.ours.runs == pair.peer.runs == 4


def test_the_table_hides_no_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every ratio of every machine is in the README, those that missed their bar are marked, and the plot has them."""
    report = Report("render")
    report.add_ratio("fast", 0.9, at_most=1.1)
    report.add_ratio("slow", 0.5, at_least=0.8)
    report.rows.append({"name": "alone", "ours": {"median_s": 0.0125, "iqr_s": 0.001, "runs": 5}})
    report.write(tmp_path / "results" / "some" / "render.json")
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{summary.BEGIN}\nold\n{summary.END}\nafter\n")
    monkeypatch.setattr(summary, "README", readme)
    assert summary.run(Namespace(results=tmp_path / "results")) == 0
    text = readme.read_text()
    assert "| fast | 0.9 | <= 1.1 | met |" in text
    assert "| slow | 0.5 | >= 0.8 | **missed** |" in text
    assert "| alone | 12.50 (1.00) |" in text
    assert "old" not in text
    assert text.startswith("before")
    assert text.endswith("after\n")
    assert (tmp_path / "results" / "some" / "ratios.svg").read_text().count("#c1440e") == 1


def test_the_readme_has_the_committed_results() -> None:
    """What the README of the benchmarks shows is what the committed files say."""
    results = Path(summary.__file__).parent / "results"
    text = summary.README.read_text()
    for folder in results.iterdir():
        suites = [json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))]
        assert summary.table(folder.name, suites) in text
