"""Where the worst error of a network is not proved, the results say so, and why."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from lxml import html
from report_study import finished

from iksamples.answer.collect import read_runs
from iksamples.certify import step as proving
from iksamples.report.write import write_report
from iksamples.study import read_study
from iksamples.tracking.content import study_runs


pytestmark = pytest.mark.slow

SMALL: dict[str, Any] = {
    "name": "small",
    "paper": False,
    "samples": {"points_per_axis": [2, 3]},
    "training": {"seeds": 3, "epochs": 20, "snapshots": 2},
    "methods": {"other": {}, "table": {"kind": "multilinear"}},
    "tolerance": {"error_mm": 100},
    "evaluation": {"cube_points": 64, "paths": {"heart": {"shape": "heart", "waypoints": 20}}},
    "bounds": {"sup_rtol": 1, "mean_rtol": 1},
}
LOST = np.linalg.LinAlgError("Singular matrix")
NUMBERS = "the numbers of the proof: Singular matrix."
CHECKER = "the separate checker found no finite bound."
SEARCH = "the search found no finite bound."


def all_of_one_method(method: str, label: str, seed: int) -> str:
    return NUMBERS if method == "network" else ""


def one_network(method: str, label: str, seed: int) -> str:
    return CHECKER if (method, label, seed) == ("other", "grid3", 1) else ""


def some_by_each(method: str, label: str, seed: int) -> str:
    if method == "network":
        return SEARCH if seed else NUMBERS
    return CHECKER if method == "table" and label == "grid2" else ""


def none(method: str, label: str, seed: int) -> str:
    return ""


WAYS = [all_of_one_method, one_network, some_by_each, none]


def run(way: Any, folder: Path) -> pd.DataFrame:
    """A finished study whose proofs fail in one way; what was to fail, and why."""
    search, rows = proving.checked, proving._rows
    at = {"method": "", "label": ""}

    def rows_of(study: Any, task: Any, method: str, samples: Any, *rest: Any) -> Any:
        at.update(method=method, label=samples.label)
        return rows(study, task, method, samples, *rest)

    def checked(answers: Any, *rest: Any, **how: Any) -> Any:
        whys = [way(**at, seed=seed) for seed in getattr(answers, "seeds", (0,))]
        if NUMBERS in whys:
            raise LOST
        for (found, proof), why in zip(search(answers, *rest, **how), whys, strict=True):
            proof = replace(proof, upper=np.inf) if why else proof
            yield replace(found, upper=np.inf) if why == SEARCH else found, proof

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proving, "checked", checked)
        patch.setattr(proving, "_rows", rows_of)
        patch.chdir(folder)
        (folder / "config").symlink_to(Path(__file__).parents[1] / "config")
        finished(SMALL, folder, paper=False)
    cells = itertools.product(["network", "other", "table"], ["grid2", "grid3"], range(3))
    columns = ["method", "label", "seed"]
    each = [cell for cell in cells if cell[0] != "table" or not cell[2]]
    table = pd.DataFrame(each, columns=columns)
    return table.assign(why=[way(*cell) for cell in table.itertuples(index=False)])


@pytest.fixture(scope="module", params=WAYS, ids=lambda way: way.__name__)
def study(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp(request.param.__name__)
    return folder, run(request.param, folder)


def text_of(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.chdir(folder)
    results = Path("results/small")
    write_report(read_study(results / "study.json"), results, Path("reports/small"))
    page = html.parse("reports/small/index.html").getroot().text_content()
    readme = Path("reports/small/README.md").read_text(encoding="utf-8")
    return [" ".join(text.replace("`", "").split()) for text in (readme, page)]


def test_the_tables_say_which_and_why(study: Any) -> None:
    folder, expected = study
    results = folder / "results/small"
    table = pd.read_csv(results / "certificates.csv", keep_default_na=False)
    told = table.set_index(["method", "label", "seed"])["failed"]
    wanted = expected.set_index(["method", "label", "seed"])["why"]
    assert told.to_dict() == wanted.to_dict()
    assert (table["verified"] == table["failed"].eq("")).all()
    runs = read_runs(read_study(results / "study.json"), results).query("region == 'workspace'")
    assert runs.set_index(["method", "label", "seed"])["unproved"].to_dict() == wanted.to_dict()


def test_the_report_counts_them_and_says_why(study: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, expected = study
    lost = expected[expected["why"].ne("")]
    for text in text_of(folder, monkeypatch):
        told = f"Proved: {len(expected) - len(lost)} of {len(expected)} worst errors"
        assert (told in text) == bool(len(lost))
        for (method, why), rows in lost.groupby(["method", "why"]):
            where = " and ".join(rows["label"].unique())
            labels = expected["label"].isin(rows["label"])
            asked = (labels & expected["method"].eq(method)).sum()
            assert f"{method}, {where}: {len(rows)} of {asked}: {why}" in text
        assert ("found no finite bound" in text) == lost["why"].str.contains("bound").any()


def test_a_logged_run_says_why(study: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, expected = study
    monkeypatch.chdir(folder)
    results = Path("results/small")
    settings = read_study(results / "study.json")
    logged = {one.name: one for one in study_runs(settings, results, read_runs(settings, results))}
    for (method, label), rows in expected.groupby(["method", "label"]):
        run = logged[f"{method}, {label}"]
        numbers = {name: value for name, value, _ in run.metrics}
        assert numbers["n_unproved"] == rows["why"].ne("").sum()
        for why in set(rows["why"]) - {""}:
            assert why in run.note
        assert ("Proved:" in run.note) == rows["why"].ne("").any()
