"""The report of studies run by the steps' own commands: its numbers, its size, and its page."""

import io
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pandas as pd
import pytest
from lxml import html
from markdown_it import MarkdownIt
from report_study import finished, step

from iksamples.answer.answer import read_answer
from iksamples.answer.collect import read_runs
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import median_seed
from iksamples.files import kept_file
from iksamples.recording.record import record_path
from iksamples.report import errors, markdown, run
from iksamples.report.data import ReportData, read_report_data
from iksamples.report.write import write_front_page, write_report
from iksamples.results import cells
from iksamples.study import Study, read_study
from iksamples.task import study_chain


pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
EVIL = "<img src=x onerror=alert(1)> [t](http://t.invalid) | *b*"
SMALL: dict[str, Any] = {
    "name": "small",
    "paper": True,
    "title": f"A small study {EVIL}",
    "samples": {"points_per_axis": [2, 3, 5]},
    "training": {"seeds": 7, "epochs": 60},
    "evaluation": {"cube_points": 256},
    "methods": {"other": {"network": {"activation": "tanh"}}, "table": {"kind": "multilinear"}},
    "tolerance": {"error_mm": 6, "success_share": 0.5},
}
NASTY = "<img src=x onerror=alert(1)> `b` *b* | [t](javascript://a/b) $x$ {{ 1 }} \\"
"""In the names of an arm's links and joints, and but for the slashes of its file."""
ARM_FILE = f"{NASTY.replace('/', '')}.urdf"
BARE: dict[str, Any] = {
    "name": "bare",
    "robot": {"urdf": ARM_FILE},
    "samples": {"points_per_axis": [3], "designs": ["grid", "uniform"]},
    "training": {"seeds": 1, "epochs": 20, "held_out": {"validation_share": 0, "at_least": 0}},
    "evaluation": {"cube_points": 64, "paths": {"loop": {"shape": "heart"}}},
}
TURNED: dict[str, Any] = {
    "name": "turned",
    "robot": {
        "urdf": "config/robots/planar3r.urdf",
        "home_rad": {"shoulder": 0.2, "elbow": 0.9, "wrist": 0.4},
    },
    "task": {"inputs": ["x", "y", "yaw"], "orientation": "fixed", "reference_rpy_rad": [0, 0, 0]},
    "workspace": {
        "lower_mm": [80, 60], "upper_mm": [130, 130], "lower_rad": [1.0], "upper_rad": [1.8]
    },
    "samples": {"sizes": [27, 64]},
    "network": {"activation": "tanh"},
    "training": {"seeds": 3, "epochs": 20},
    "bounds": {"sup_rtol": 0.05, "mean_rtol": 0.5},
    "evaluation": {"cube_points": 64, "paths": {"loop": {"shape": "circle"}}},
    "tolerance": {"error_mm": 6, "angle_deg": 2},
}  # fmt: skip


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with two finished studies and their reports; one is not held against the paper."""
    folder = tmp_path_factory.mktemp("project")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "config").symlink_to(ROOT / "config")
        arm = (ROOT / "config/robots/rrr70.urdf").read_text(encoding="utf-8")
        for name in re.findall('<(?:link|joint) name="([^"]*)"', arm):
            arm = arm.replace(f'"{name}"', quoteattr(f"{name} {NASTY}"))
        (folder / ARM_FILE).write_text(arm, encoding="utf-8")
        for settings, paper in ((SMALL, True), (BARE, False)):
            study = finished(settings, folder, paper)
            benchmarks = folder / "results" / study.name / "benchmarks"
            benchmarks.mkdir()
            (benchmarks / "train.jsonl").write_text('{"s": 4.0, "cpu_time": 3, "max_rss": 500}\n')
            (benchmarks / "table.jsonl").write_text('{"s": 1.0, "max_rss": "NA"}\n')
            write_report(study, f"results/{study.name}", f"reports/{study.name}")
        yield folder


@pytest.fixture
def data(project: Path, monkeypatch: pytest.MonkeyPatch) -> ReportData:
    """The study that is held against the paper."""
    monkeypatch.chdir(project)
    study = Study.model_validate_json((project / "results/small/study.json").read_bytes())
    return read_report_data(study, Path("results/small"), "snakemake")


@pytest.fixture
def page(project: Path) -> html.HtmlElement:
    return html.parse(project / "reports/small/index.html").getroot()


def table_with(page: html.HtmlElement, *heads: str) -> pd.DataFrame:
    """The table of a page that has these heads first, as it is printed."""
    for table in page.xpath("//table"):
        found = [cell.text_content() for cell in table.xpath(".//th")]
        if found[: len(heads)] == list(heads):
            text = io.StringIO(html.tostring(table, encoding="unicode"))
            return pd.read_html(text, converters={i: str for i in range(len(found))})[0]
    raise AssertionError(f"no table with the heads {heads}")


def test_what_is_proved_of_a_part_of_the_workspace_is_not_said_of_all_of_it(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(project / "results/small", tmp_path / "results/small")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config").symlink_to(project / "config")
    study = Study.model_validate_json(Path("results/small/study.json").read_bytes())
    runs = pd.read_parquet("results/small/runs.parquet")
    with kept_file("results/small/runs.parquet") as file:
        runs.assign(region_share=0.8).to_parquet(file)
    write_report(study, "results/small", "reports/small")
    text = " ".join(Path("reports/small/README.md").read_text().split())
    for says in ("Error over", "the worst error over", "holds for every point of"):
        assert f"{says} the usable part of the workspace" in text
    assert "% of the usable part of the workspace has an error" in text


def test_the_answers_table_is_the_answer(project: Path, page: html.HtmlElement) -> None:
    answer = read_answer(project / "results/small")
    shown = table_with(page, "Method", "What it is", "Samples needed").set_index("Method")
    for one in answer.variants:
        row = shown.loc[one.method]
        needed = str(one.n_samples) if one.status == "answered" else None
        assert (needed or str(one.shown.n_samples)) in row["Samples needed"]
        assert row["What it is"] == one.description
    assert page.xpath("string(//blockquote)").strip().replace("\u00a0", " ") == answer.headline
    assert {one.status for one in answer.variants} >= {"answered"}


def test_errors_are_those_of_the_runs(
    data: ReportData, project: Path, page: html.HtmlElement
) -> None:
    runs = read_runs(data.study, project / "results/small")
    everywhere = runs[runs["region"] == "workspace"]
    shown = table_with(page, "Method", "8", "27", "125").set_index("Method")
    medians = everywhere.groupby(["method", "n_samples"])["error_mean_mm"].median()
    for (method, n), value in medians.items():
        assert shown.loc[method, str(n)] == f"{value:.2f}"
    regions = table_with(page, "Region", "Samples").set_index(["Region", "Samples"])
    own = runs[(runs["method"] == "network")].groupby(["region", "n_samples"])
    for (region, n), rows in own:
        row = regions.loc[region, str(n)]
        assert row["Mean [mm]"] == f"{rows['error_mean_mm'].mean():.2f}"
        assert row["Largest of any seed [mm]"] == f"{rows['error_max_mm'].max():.2f}"


def test_proofs_are_those_of_the_certificates(project: Path, page: html.HtmlElement) -> None:
    proofs = pd.read_csv(project / "results/small/certificates.csv").query("method == 'network'")
    shown = table_with(page, "Samples", "Worst error ≥ [mm]").set_index("Samples")
    for n, rows in proofs.groupby("n_samples"):
        row = shown.loc[str(n)]
        for head, value in (
            ("Worst error ≤ [mm]", rows["sup_upper_mm"].median()),
            ("Worst seed ≤ [mm]", rows["sup_upper_mm"].max()),
            ("Mean ≤ [mm]", rows["mean_upper_mm"].median()),
        ):
            assert value <= float(row[head]) < value + 0.01
        assert 0 <= rows["sup_lower_mm"].median() - float(row["Worst error ≥ [mm]"]) < 0.01
        assert row["Networks"] == str(rows["verified"].sum())
    unsafe = pd.read_parquet(project / "results/small/network/grid5/unsafe.parquet")
    seed = int(page.xpath("string(//p[contains(., '(seed ')])").split("(seed ")[1].split(")")[0])
    head = unsafe[unsafe["seed"] == seed].iloc[0]
    said = re.search(r"Between ([\d.]+)\s% and ([\d.]+)\s%", page.text_content())
    assert said
    low, high = map(float, said.groups())
    assert low <= 100 * head["safe_lower"] < low + 0.1
    assert high - 0.1 < 100 * head["safe_upper"] <= high


def test_table_one_is_the_tables(project: Path, page: html.HtmlElement) -> None:
    table = pd.read_csv(project / "results/small/table.csv")
    shown = table_with(page, "Samples", "d [mm]", "Paper [mm]")
    for (_, printed), (_, row) in zip(shown.iterrows(), table.iterrows(), strict=True):
        for head, name in (("Paper [mm]", "paper_error"), ("Here [mm]", "error")):
            mean = row[f"{name}_mm" if name == "paper_error" else f"{name}_mean_mm"]
            assert (
                printed[head].replace("\u00a0", " ") == f"{mean:.2f} ± {row[f'{name}_sd_mm']:.2f}"
            )
        assert printed["Ratio"] == f"{row['error_mean_mm'] / row['paper_error_mm']:.2f}"
        assert printed["Eq. 25 here [mm]"] == f"{row['estimate_mm']:.2f}"
    claims = pd.read_csv(project / "results/small/claims.csv")
    printed = table_with(page, "Claim", "Where", "Verdict")
    assert printed["Verdict"].to_list() == claims["verdict"].to_list()
    assert printed["Claim"].to_list() == claims["claim"].to_list()


def test_ratios_are_those_of_the_answer(project: Path, page: html.HtmlElement) -> None:
    answer = read_answer(project / "results/small")
    shown = table_with(page, "Method", "against", "8").set_index("Method")
    for one in answer.comparisons:
        assert one.ratio.value is not None
        assert float(shown.loc[one.method, str(one.n_samples)]) == pytest.approx(
            100 * one.ratio.value, rel=0.05, abs=0.5
        )


def test_costs_are_those_of_the_benchmark_files(page: html.HtmlElement) -> None:
    shown = table_with(page, "Step", "Jobs").set_index("Step")
    assert shown.loc["train"].to_list() == ["1", "4.0", "80.0", "4.0", "3.0", "500.0"]
    assert shown.loc["table", "Share [%]"] == "20.0"


@pytest.mark.parametrize("name", ["small", "bare"])
def test_it_is_read_in_five_minutes(project: Path, name: str) -> None:
    page = html.parse(project / f"reports/{name}/index.html").getroot()
    for hidden in page.xpath("//details/*[not(self::summary)] | //script | //style"):
        hidden.drop_tree()
    assert len(page.text_content().split()) < 1500
    text = page.text_content().lower()
    assert not {"nan", "none", "inf"} & set(re.findall(r"[a-z]+", text))


@pytest.mark.parametrize("name", ["small", "bare"])
def test_the_page_stands_alone(project: Path, name: str) -> None:
    text = (project / f"reports/{name}/index.html").read_text(encoding="utf-8")
    assert len(text.encode()) < 3_000_000
    page = html.fromstring(text)
    identifiers = page.xpath("//@id")
    assert len(identifiers) == len(set(identifiers))
    links = [*page.xpath("//@src"), *page.xpath("//@href")]
    assert links
    assert {link[1:] for link in links if link.startswith("#")} <= set(identifiers)
    assert all(link.startswith(("#", "data:")) for link in links)
    assert set(re.findall(r"url\(#([^)]+)\)", text)) <= set(identifiers)
    assert "url(http" not in text
    assert "@import" not in text


def test_a_title_is_text_in_the_page_and_in_markdown(project: Path, page: html.HtmlElement) -> None:
    assert page.xpath("string(//h1)") == page.xpath("string(//title)") == SMALL["title"]
    assert not page.xpath("//img | //*[@onerror] | //a[contains(@href, 'invalid')]")
    assert "<img" not in (project / "reports/small/README.md").read_text()


def test_names_of_an_arm_are_text(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(project)
    page = html.parse(project / "reports/bare/index.html").getroot()
    joints = study_chain(read_study(project / "results/bare/study.json")).joint_names
    said = page.text_content()
    assert all(NASTY in name and name in said for name in joints)
    assert not page.xpath("//main//img | //*[@onerror] | //a[contains(@href, 'javascript')]")
    readme = (project / "reports/bare/README.md").read_text()
    # As any other reader of Markdown has it.
    parser = MarkdownIt("commonmark", {"html": True}).enable("table")
    other = html.fromstring(f"<div>{parser.render(readme)}</div>")
    assert all(name in other.text_content() for name in joints)
    assert not other.xpath("//*[@onerror] | //a[contains(@href, 'javascript')]")


def test_names_of_joints_are_each_one_part_of_a_recordings_paths(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from rerun.chunk import RrdReader

    monkeypatch.chdir(project)
    study = read_study(project / "results/bare/study.json")
    record_path(study, "loop", cells(study, project / "results/bare"), tmp_path / "loop.rrd")
    moved = {
        chunk.entity_path
        for chunk in RrdReader(tmp_path / "loop.rrd").stream().to_chunks()
        if chunk.entity_path.startswith("/robot/joints/") and not chunk.is_static
    }
    plain = {re.sub(r"\\(.)", r"\1", path) for path in moved}
    assert plain == {f"/robot/joints/{name}" for name in study_chain(study).joint_names}
    assert all("/" not in path.removeprefix("/robot/joints/").replace("\\/", "") for path in moved)


def test_the_readme_is_the_pages_text(project: Path, page: html.HtmlElement) -> None:
    readme = (project / "reports/small/README.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## (.+)$", readme, flags=re.M)
    on_page = [one.text_content() for one in page.xpath("//h2")]
    assert headings == [one for one in on_page if one != "Cost"]
    pictures = sorted(file.name for file in (project / "reports/small/figures").iterdir())
    assert sorted(re.findall(r"\]\(figures/([^)]+)\)", readme)) == pictures
    assert len(page.xpath("//div[@class='drawing']/*[local-name()='svg']")) == len(pictures)
    for name in pictures:
        content = (project / "reports/small/figures" / name).read_bytes()
        assert content.startswith(b"\x89PNG")
        assert len(content) < 250_000


def test_the_readme_has_the_same_bytes_when_built_again(
    data: ReportData, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "machine", lambda: "another machine")
    monkeypatch.setattr(run, "commit", lambda: "another commit")
    write_report(data.study, "results/small", "again/small")
    one, other = project / "reports/small", project / "again/small"
    names = ["README.md", *(f"figures/{one.name}" for one in (one / "figures").iterdir())]
    for name in names:
        assert (one / name).read_bytes() == (other / name).read_bytes(), name
    assert "another machine" in (other / "index.html").read_text(encoding="utf-8")


def test_a_study_without_the_paper_says_nothing_of_it(project: Path) -> None:
    page = html.parse(project / "reports/bare/index.html").getroot()
    assert "Table 1" not in page.text_content()
    assert "loop" in page.xpath("string(//h2[.='Paths and recordings']/following::em[2])") + str(
        page.xpath("//pre[contains(., 'loop.rrd')]")
    )
    methods = table_with(page, "Method", "Samples placed", "Samples needed")
    assert methods["Samples placed"].to_list() == ["grid", "uniform"]


def test_what_is_missing_stops_it_and_leaves_the_old_report(
    data: ReportData, tmp_path: Path
) -> None:
    output = tmp_path / "report"
    output.mkdir()
    (output / "README.md").write_text("old")
    shutil.copytree(data.results, tmp_path / "results")
    (tmp_path / "results/runs.parquet").unlink()
    with pytest.raises(IksamplesError, match=r"runs\.parquet: there is no such file"):
        write_report(data.study, tmp_path / "results", output)
    assert [path.name for path in output.iterdir()] == ["README.md"]
    assert (output / "README.md").read_text() == "old"


NOT_PROVED = {"sup_upper_mm": np.nan, "sup_lower_mm": np.nan, "verified": False}


def test_networks_that_diverged_are_counted_and_left_out(data: ReportData, tmp_path: Path) -> None:
    no_digests = shutil.ignore_patterns(".*.sha256")  # since the numbers are changed
    shutil.copytree(data.results, tmp_path / "results", ignore=no_digests)
    runs = pd.read_parquet(tmp_path / "results/runs.parquet")
    lost = (runs["method"] == "network") & (runs["n_samples"] == 8)
    runs.loc[lost, list(NOT_PROVED)] = list(NOT_PROVED.values())
    with kept_file(tmp_path / "results/runs.parquet") as file:
        runs.assign(failed=runs["failed"].where(~lost, "it diverged")).to_parquet(file)
    (tmp_path / "results/study.json").write_text(data.study.model_dump_json())
    step("answer", tmp_path / "results/study.json", "--results", tmp_path / "results")
    write_report(data.study, tmp_path / "results", tmp_path / "report")
    page = html.parse(tmp_path / "report/index.html").getroot()
    assert "7 without a result" in page.text_content()
    shown = table_with(page, "Method", "8", "27", "125").set_index("Method")
    assert str(shown.loc["network", "8"]) in ("", "nan")
    compared = table_with(page, "Method", "against", "8", "27")
    assert list(compared["8"]) == ["–"] * len(compared)
    assert compared["27"].map(float).gt(0).all()


@pytest.mark.parametrize(
    "lost", [("network",), ("network", "other"), ("network", "other", "table")]
)
def test_without_a_network_of_its_own_the_report_has_what_others_reached(
    data: ReportData, tmp_path: Path, lost: tuple[str, ...]
) -> None:
    results = tmp_path / "results"
    shutil.copytree(data.results, results, ignore=shutil.ignore_patterns(".*.sha256"))
    runs = pd.read_parquet(results / "runs.parquet")
    gone = runs["method"].isin(lost)
    runs.loc[gone, list(NOT_PROVED)] = list(NOT_PROVED.values())
    runs.assign(failed=runs["failed"].where(~gone, "it diverged")).to_parquet(
        results / "runs.parquet"
    )
    (results / "study.json").write_text(data.study.model_dump_json())
    step("answer", results / "study.json", "--results", results)
    write_report(data.study, results, tmp_path / "report")
    page = html.parse(tmp_path / "report/index.html").getroot()
    text = " ".join(page.text_content().split())
    assert f"{9 - 3 * len(lost)} of 9 combinations" in text
    assert "it diverged" in text
    shown = table_with(page, "Method", "What it is", "Samples needed")
    assert len(shown) == 3
    # All are held against the study's own network, which has no error.
    assert "Comparisons at equal samples" not in text
    if len(lost) < 3:
        curves = table_with(page, "Method", "8", "27", "125")["Method"]
        assert list(curves) == [name for name in ("network", "other", "table") if name not in lost]


def test_a_bound_within_the_tolerance_is_of_all_the_workspace(data: ReportData) -> None:
    label = list(data.cells)[-1]
    proofs = pd.read_csv(data.results / "certificates.csv").set_index(["method", "label", "seed"])
    bound = float(proofs.loc[("network", label, data.shown[label]), "sup_upper_mm"])
    for limit, everywhere in ((0.99 * bound, False), (bound, True)):
        wish = data.study.tolerance.model_copy(update={"error_mm": limit})
        study = data.study.model_copy(update={"tolerance": wish})
        assert errors.worst(replace(data, study=study))["everywhere"] is everywhere


def test_a_proved_angle_is_shown_as_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config").symlink_to(ROOT / "config")
    write_report(finished(TURNED, tmp_path, paper=False), "results/turned", "reports/turned")
    page = html.parse(tmp_path / "reports/turned/index.html").getroot()
    proofs = pd.read_csv("results/turned/certificates.csv")
    shown = table_with(page, "Samples", "Worst error ≥ [mm]")
    most = proofs.groupby("n_samples")["angle_upper_deg"]
    for column, exact in (("Angle ≤ [deg]", most.median()), ("Worst seed ≤ [deg]", most.max())):
        printed = shown[column].astype(float).to_numpy()
        assert (printed >= exact).all()
        np.testing.assert_allclose(printed, exact, rtol=0.1)
    assert (tmp_path / "reports/turned/figures/error-map-orientation.png").exists()
    text = " ".join(page.text_content().split())
    assert markdown.number(float(most.median().iloc[-1]), 2, "up") + "°" in text


def test_slices_are_the_error_of_the_network_shown(data: ReportData) -> None:
    chain = study_chain(data.study)
    for cell in cells(data.study, data.results):
        slices = cell.table("slices")
        assert slices.groupby(["seed", "slice"]).size().unique().tolist() == [49**2]
        seed = data.shown[cell.label]
        waypoints = cell.table("waypoints")
        assert seed == median_seed(waypoints[waypoints["path"] == data.first_path])
        few = slices[slices["seed"] == seed].iloc[::333]
        targets = few[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
        joints = cell.network.predict(targets)[cell.network.seeds.index(seed)]
        error = np.linalg.norm(chain.forward_mm(joints) - targets, axis=-1)
        np.testing.assert_allclose(few["error_mm"], error)
        assert set(slices["z_mm"]) == {0.0, 30.0, 60.0}


def test_the_front_page_has_every_study(project: Path, tmp_path: Path) -> None:
    reports, kept = tmp_path / "reports", tmp_path / "docs/studies"
    shutil.copytree(project / "reports/small", reports / "small")
    for name in ("small", "bare"):  # what was run here hides what was kept
        shutil.copytree(project / f"reports/{name}", kept / name, ignore=lambda *_: ["index.html"])
    write_front_page(reports, kept)
    page = html.parse(reports / "index.html").getroot()
    sections = page.xpath("//section")
    assert len(sections) == 2
    assert {one.xpath("string(.//h2)") for one in sections} == {SMALL["title"], "Study bare"}
    for one in sections:
        link = one.xpath("string(.//h2/a/@href)")
        assert (reports / link).is_file()
        assert "confidence" in one.xpath("string(.//p)")
        assert one.xpath(".//img/@src")[0].startswith("data:image/png;base64,")
    said = page.text_content().replace("\u00a0", " ")
    assert read_answer(project / "results/small").headline in said
    assert not page.xpath("//*[@onerror]")
    kept_page = html.parse(reports / "kept-bare.html").getroot()
    assert kept_page.xpath("//img")
    assert kept_page.xpath("//details")
    assert not list(reports.glob(".unfinished*"))


def test_the_command_writes_report_and_front_page(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(project)
    results = project / "results/bare"
    output = tmp_path / "reports/bare"
    step(
        "report", results / "study.json", "--results", results, "-o", output, "--command", "do 'it'"
    )
    assert (
        "do 'it'" in html.parse(output / "index.html").getroot().xpath("//pre")[-1].text_content()
    )
    assert (tmp_path / "reports/index.html").is_file()


@pytest.fixture
def opened(browser: Any, project: Path) -> Iterator[Any]:
    """The page in a window; fails on a complaint of the browser or any request but its own."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    complaints: list[str] = []
    requests: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    address = (project / "reports/small/index.html").as_uri()
    page.goto(address)
    yield page
    assert complaints == []
    assert [url for url in requests if not url.startswith("data:")] == [address]
    page.close()


def pixels(page: Any) -> str:
    return str(page.evaluate("document.querySelector('#viewer canvas').toDataURL()"))


def test_dragging_turns_the_view(opened: Any) -> None:
    canvas = opened.locator("#viewer canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    before, view = pixels(opened), canvas.get_attribute("data-view")
    opened.mouse.move(box["x"] + 300, box["y"] + 200)
    opened.mouse.down()
    opened.mouse.move(box["x"] + 400, box["y"] + 160, steps=5)
    opened.mouse.up()
    assert pixels(opened) != before
    azimuth, elevation = map(float, canvas.get_attribute("data-view").split()[:2])
    was = list(map(float, view.split()[:2]))
    assert azimuth == pytest.approx(was[0] - 45)
    assert elevation == pytest.approx(was[1] - 18)


def test_the_view_shows_the_chosen_set_path_and_network(opened: Any, project: Path) -> None:
    canvas = opened.locator("#viewer canvas")
    seen = {pixels(opened)}
    for name in ("125", "heart", "worst"):
        opened.get_by_role("button", name=name, exact=True).click()
        seen.add(pixels(opened))
    assert len(seen) == 4
    assert canvas.get_attribute("data-view").split()[2:] == ["125", "heart", "worst", "0"]
    opened.locator("#viewer input").fill("50")
    waypoints = pd.read_parquet(project / "results/small/network/grid5/waypoints.parquet")
    rows = waypoints[waypoints["path"] == "heart"].set_index(["seed", "waypoint"])["error_mm"]
    worst = rows[rows.groupby("seed").mean().idxmax()]
    shown = opened.locator("#viewer output").inner_text()
    assert shown == f"{worst[50]:.2f} mm off here, {worst.max():.2f} mm at most"
    canvas.focus()
    opened.keyboard.press("ArrowLeft")
    assert canvas.get_attribute("data-view").startswith("-57.0 ")


def test_pointing_at_a_training_names_it(opened: Any, data: ReportData, project: Path) -> None:
    opened.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    marks = opened.locator("#figure-trainings [data-tip]")
    runs = read_runs(data.study, project / "results/small").query("method == 'network'")
    assert marks.count() == len(runs)
    mark = marks.nth(9)
    mark.scroll_into_view_if_needed()
    box = mark.bounding_box()
    opened.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    said = opened.locator("#tip").inner_text()
    n, seed = (int(one) for one in re.findall(r"(\d+) samples, seed (\d+)", said)[0])
    own = runs[(runs["n_samples"] == n) & (runs["seed"] == seed)]
    expected = [
        f"mean {row.error_mean_mm:.2f} mm, largest {row.error_max_mm:.2f}"
        for row in own.itertuples()
    ]
    assert any(one in said for one in expected)
    opened.mouse.move(5, 5)
    assert opened.locator("#tip").is_hidden()


def test_the_page_fits_a_phone_and_a_dark_screen(opened: Any) -> None:
    background = "getComputedStyle(document.body).backgroundColor"
    light = opened.evaluate(background)
    opened.emulate_media(color_scheme="dark")
    assert opened.evaluate(background) != light
    opened.emulate_media(color_scheme="dark", media="print")
    assert opened.evaluate(background) == light
    opened.emulate_media(media="screen")
    opened.set_viewport_size({"width": 390, "height": 800})
    opened.evaluate("document.querySelectorAll('details').forEach(one => one.open = true)")
    assert opened.evaluate("document.documentElement.scrollWidth") == 390


@pytest.mark.parametrize("name", ["small/index.html", "index.html", "kept-other.html"])
def test_what_others_put_into_a_page_does_not_run(
    browser: Any, project: Path, tmp_path: Path, name: str
) -> None:
    """Should escaping ever fail: the page's policy knows its own scripts by their digests."""
    shutil.copytree(project / "reports/small", tmp_path / "reports/small")
    shutil.copytree(
        project / "reports/bare", tmp_path / "kept/other", ignore=lambda *_: ["index.html"]
    )
    write_front_page(tmp_path / "reports", tmp_path / "kept")
    file = tmp_path / "reports" / name
    (tmp_path / "evil.js").write_text("evil = 2")
    (tmp_path / "evil.css").write_text("h1 { color: red }")
    here = tmp_path.as_uri()
    injected = f"""<script>evil = 1</script><script src="{here}/evil.js"></script>
        <img src="x.png" onerror="evil = 3"><svg onload="evil = 4"></svg>
        <img src="http://127.0.0.1:9/seen.png"><link rel="stylesheet" href="{here}/evil.css">
        <iframe srcdoc="<script>parent.evil = 5</script>"></iframe>
        <object data="{here}/evil.js"></object><base href="http://127.0.0.1:9/">
        <a id="bait" href="javascript:evil=6">a</a>
        <form id="form" action="http://127.0.0.1:9/"><input name="a"></form>
        <style>@import "http://127.0.0.1:9/a.css"; h2 {{ background: url(http://127.0.0.1:9/b) }}
        @font-face {{ font-family: f; src: url(http://127.0.0.1:9/f) }} p {{ font-family: f }}
        </style>"""
    page = browser.new_page()
    complaints: list[str] = []
    requests: list[str] = []
    refused: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(file.as_uri())
    assert complaints == []
    shown = "[...document.images].every((one) => one.complete && one.naturalWidth > 0)"
    assert page.evaluate(shown)
    assert page.evaluate("document.querySelectorAll('img, .drawing svg').length") > 0
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("<main>", f"<main>{injected}", 1), encoding="utf-8")
    page.on("requestfinished", lambda request: requests.append(request.url))
    page.on("requestfailed", lambda request: refused.append(request.failure))
    page.goto(file.as_uri())
    page.locator("#bait").click()
    page.evaluate("document.getElementById('form').submit()")
    page.wait_for_timeout(200)
    assert page.evaluate("typeof evil") == "undefined"
    assert page.url == file.as_uri()
    loaded = [url for url in requests if not url.startswith(("data:", "about:"))]
    assert (loaded, set(refused)) == ([file.as_uri()], {"csp"})
    assert page.evaluate("document.baseURI") == file.as_uri()
    assert len(complaints) >= 10
    page.close()


def test_the_scene_of_a_page_is_data(project: Path) -> None:
    text = (project / "reports/small/index.html").read_text(encoding="utf-8")
    assert json.loads(html.fromstring(text).xpath("string(//script[@id='scene'])"))["grids"]
