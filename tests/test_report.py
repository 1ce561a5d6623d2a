"""The report: its numbers, its words, its bytes, and the page in a browser."""

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import html
from scipy import stats

from iksamples.arm.workspace import study_chain
from iksamples.certify.step import certify
from iksamples.errors import IksamplesError
from iksamples.evaluation.errors import cube_errors, summarise, track_paths
from iksamples.network import StackedMLP
from iksamples.paper.audit import audit
from iksamples.paper.table import study_table
from iksamples.report import provenance
from iksamples.report.blocks import Number
from iksamples.report.data import Grid, ReportData, read_benchmarks, read_report_data
from iksamples.report.figures_paper import shown_grids
from iksamples.report.sections_paper import changed_settings
from iksamples.report.statistics import fall_interval, median_interval, slope_interval
from iksamples.report.verdict import verdict
from iksamples.report.write import write_report
from iksamples.results import cells
from iksamples.samples.dataset import SampleSet
from iksamples.samples.record import grid_samples
from iksamples.study import Study, parse_study


pytestmark = pytest.mark.slow


ROOT = Path(__file__).parents[1]
SMALL: dict[str, Any] = {"evaluation": {"cube_points": 256}}


def random_features(samples: SampleSet, seeds: tuple[int, ...]) -> StackedMLP:
    """Networks with a random hidden layer and a least-squares output layer: trained at once."""
    inputs = samples.normalise(samples.positions_mm)
    layers: list[list[Any]] = [[], [], [], []]
    for seed in seeds:
        generator = np.random.default_rng(seed)
        kernel, bias = generator.normal(size=(3, 16)), generator.normal(size=16)
        hidden = np.column_stack([np.maximum(inputs @ kernel + bias, 0), np.ones(len(inputs))])
        out = np.linalg.solve(hidden.T @ hidden + 1e-3 * np.eye(17), hidden.T @ samples.joints)
        for layer, value in zip(layers, (kernel, bias, out[:-1], out[-1]), strict=True):
            layer.append(value)
    first, first_bias, second, second_bias = (np.array(layer, np.float32) for layer in layers)
    return StackedMLP(
        (first, second),
        (first_bias, second_bias),
        "relu",
        samples.offset_mm,
        samples.scale_mm,
        seeds,
    )


def finished(settings: dict[str, Any], folder: Path, losses: bool = True) -> Study:
    """Results of a study as its workflow leaves them, with the training cut short."""
    study = parse_study(settings)
    chain = study_chain(study)
    (folder / "samples").mkdir(parents=True)
    for cell in cells(study, folder):
        samples = grid_samples(study, chain, int(cell.label.removeprefix("grid")))
        samples.save(cell.samples_path)
        cell.folder.mkdir(parents=True)
        network = random_features(samples, study.seeds)
        network.save(cell.folder / "weights.safetensors")
        waypoints, cube = track_paths(study, chain, network), cube_errors(study, chain, network)
        epochs = np.arange(1, 41)
        history = pd.concat(
            pd.DataFrame(
                {
                    "seed": seed,
                    "epoch": epochs,
                    "train_loss_rad2": np.exp(-epochs / 9) + 1e-3 * (1 + seed),
                    "validation_loss_rad2": np.exp(-epochs / 9) + 2e-3 if losses else np.nan,
                }
            )
            for seed in study.seeds
        )
        last = history.groupby("seed").last().reset_index(drop=True)
        members = pd.DataFrame(
            {
                "seed": study.seeds,
                "n_trained": samples.n_samples,
                "n_validation": len(samples.validation_mm),
                "n_test": len(samples.test_mm),
                "steps": 40 * int(np.ceil(samples.n_samples / 8)),
                "diverged": False,
                "validation_loss_rad2": last["validation_loss_rad2"],
            }
        )
        tables = {
            "waypoints": waypoints,
            "cube": cube,
            "errors": summarise(waypoints, cube),
            "bounds": audit(study, chain, samples, network, cube),
            "history": history,
            "members": members,
        }
        for name, table in tables.items():
            table.to_parquet(cell.folder / f"{name}.parquet")
    proofs = pd.concat(
        certify(study, chain, "network", cell.samples, cell.folder) for cell in cells(study, folder)
    )
    for file in (folder / "certificates.csv", folder / "network/certificates.csv"):
        proofs.to_csv(file, index=False)
    table = study_table(study, cells(study, folder), proofs)
    table.to_csv(folder / "table.csv", index=False)
    (folder / "benchmarks" / "evaluate").mkdir(parents=True)
    for m, seconds, memory in ((2, 1.5, "NA"), (3, 2.25, 210.0)):
        record = {"s": seconds, "cpu_time": 1.0, "max_rss": memory}
        (folder / "benchmarks" / "evaluate" / f"grid{m}.jsonl").write_text(
            json.dumps(record) + "\n"
        )
    (folder / "benchmarks" / "train.jsonl").write_text('{"s": 4.0, "max_rss": 500.5}\n')
    return study


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, Path, Path]]:
    """A study with seven seeds on three of the paper's grids and one it does not have."""
    folder = tmp_path_factory.mktemp("project")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "config").symlink_to(ROOT / "config")
        settings = {
            "name": "small",
            "title": "A small study",
            "samples": {"points_per_axis": [2, 3, 5, 9]},
            "training": {"seeds": 7},
            **SMALL,
        }
        study = finished(settings, Path("results/small"))
        write_report(study, "results/small", "reports/small")
        yield study, folder / "results/small", folder / "reports/small"


@pytest.fixture
def data(built: tuple[Study, Path, Path]) -> ReportData:
    study, results, output = built
    return read_report_data(study, results, output, "snakemake --cores 2")


def cells_of(page: html.HtmlElement, table: str) -> list[dict[str, str]]:
    """Printed numbers of a table by the column of the data they come from, row by row."""
    return [
        {cell.get("data-column"): cell.text_content() for cell in row.xpath(".//td[@data-column]")}
        for row in page.xpath(f"//div[@id='{table}']//tbody/tr")
    ]


def test_the_page_prints_the_numbers_of_the_table(built: tuple[Study, Path, Path]) -> None:
    _, results, output = built
    page = html.parse(output / "index.html").getroot()
    table = pd.read_csv(results / "table.csv")
    one, two = cells_of(page, "table-1"), cells_of(page, "table-2")
    assert len(one) == len(two) == len(table)
    for shown, more, (_, row) in zip(one, two, table.iterrows(), strict=True):
        for column, sd in (
            ("error_mean_mm", "error_sd_mm"),
            ("paper_error_mm", "paper_error_sd_mm"),
        ):
            printed = f"{row[column]:.2f} ± {row[sd]:.2f}" if np.isfinite(row[column]) else ""
            assert shown[column] == printed
        for column in (
            "estimate_mm",
            "paper_estimate_mm",
            "error_over_spacing",
            "paper_error_over_spacing",
        ):
            assert shown[column] == (f"{row[column]:.2f}" if np.isfinite(row[column]) else "")
        assert shown["spacing_mm"] == f"{row['spacing_mm']:.1f}"
        assert more["cube_error_max_mm"] == f"{row['cube_error_max_mm']:.2f}"
    # The paper has no grid of nine points per axis.
    assert one[-1]["paper_error_mm"] == one[-1]["paper_estimate_mm"] == ""
    ratios = page.xpath("//div[@id='table-1']//tbody/tr/td[4]/text()")
    assert [float(ratio) for ratio in ratios] == pytest.approx(
        (table["error_mean_mm"] / table["paper_error_mm"]).dropna().to_list(), abs=0.005
    )


def test_the_page_stands_alone_and_is_small(built: tuple[Study, Path, Path]) -> None:
    text = (built[2] / "index.html").read_text(encoding="utf-8")
    assert len(text.encode()) < 3_000_000
    page = html.fromstring(text)
    links = [*page.xpath("//@src"), *page.xpath("//@href")]
    assert links
    assert all(link.startswith(("#", "data:")) for link in links)
    assert "url(http" not in text
    assert "@import" not in text


def test_identifiers_of_the_drawings_do_not_collide(built: tuple[Study, Path, Path]) -> None:
    page = html.parse(built[2] / "index.html").getroot()
    names = page.xpath("//@id")
    assert len(names) == len(set(names))
    text = (built[2] / "index.html").read_text(encoding="utf-8")
    used = re.findall(r"url\(#([^)]+)\)", text) + re.findall(r'href="#([^"]+)"', text)
    assert len(used) > 50
    assert set(used) <= set(names)


def test_the_report_shows_what_was_asked_for(built: tuple[Study, Path, Path]) -> None:
    text = html.parse(built[2] / "index.html").getroot().text_content()
    for figure in (2, 3, 4, 5):
        assert f"Figure {figure}." in text
    for piece in (
        "rerun results/small/recordings/rectangles.rrd",
        "rerun results/small/recordings/heart.rrd",
        "mlflow ui",
        built[0].digest(),
        "snakemake --cores 2",
        provenance.machine(),
        "results/small/network/grid*/history.parquet",
        "iksamples.report.figures_paper.training_progress",
    ):
        assert piece in text, piece


def test_costs_are_those_of_the_benchmark_files(built: tuple[Study, Path, Path]) -> None:
    table = read_benchmarks(built[1] / "benchmarks")
    assert table.groupby("step")["s"].sum().to_dict() == {"evaluate": 3.75, "train": 4.0}
    assert table["max_rss_mb"].max() == 500.5
    assert table["max_rss_mb"].isna().sum() == 1
    page = html.parse(built[2] / "index.html").getroot()
    rows = [row.text_content().split() for row in page.xpath("//div[@id='table-cost']//tbody/tr")]
    assert rows[0] == ["train", "1", "4.0", "52", "4.0", "500"]
    assert rows[1] == ["evaluate", "2", "3.8", "48", "2.2", "2.0", "210"]
    assert rows[2][:3] == ["all", "3", "7.8"]


def test_the_twin_has_the_same_bytes_when_built_again(
    built: tuple[Study, Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    study, results, output = built
    monkeypatch.chdir(results.parents[1])
    monkeypatch.setattr(provenance, "machine", lambda: "another machine")
    monkeypatch.setattr(provenance, "commit", lambda: "another commit")
    write_report(study, "results/small", "reports/again")
    again = output.parent / "again"
    pictures = sorted(path.name for path in (output / "figures").iterdir())
    assert len(pictures) == 8
    for name in ["README.md", *(f"figures/{picture}" for picture in pictures)]:
        assert (again / name).read_bytes() == (output / name).read_bytes(), name
    assert "another machine" in (again / "index.html").read_text(encoding="utf-8")
    readme = (again / "README.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"!\[[^]]+\]\(figures/([^)]+)\)", readme)) == pictures
    for name in pictures:
        content = (again / "figures" / name).read_bytes()
        assert content.startswith(b"\x89PNG")
        assert len(content) < 150_000
    shutil.rmtree(again)


def test_the_twin_is_a_table_of_equal_rows(built: tuple[Study, Path, Path]) -> None:
    """Every row of a Markdown table has as many cells as its head (a | in a cell is escaped)."""
    widths: list[int] = []
    for line in (built[2] / "README.md").read_text(encoding="utf-8").splitlines():
        if line.startswith("|"):
            widths.append(len(re.findall(r"(?<!\\)\|", line)))
            assert widths[-1] == widths[0], line
        else:
            widths = []


def test_the_verdict_says_what_the_table_says(built: tuple[Study, Path, Path]) -> None:
    table = pd.read_csv(built[1] / "table.csv")
    page = html.parse(built[2] / "index.html").getroot()
    lines = page.xpath("//section[@id='verdict']/p")
    errors, claims = (p.text_content().replace("\u00a0", " ") for p in lines)
    assert f"{table['error_mean_mm'].iloc[0]:.2f} mm on average with 8 samples" in errors
    assert f"{table['error_mean_mm'].iloc[-1]:.2f} mm with 729 (mean of 7 seeds)" in errors
    ratio = table["error_mean_mm"] / table["paper_error_mm"]
    assert f"{ratio.min():.2f} to {ratio.max():.2f} times the paper’s Table 1" in errors
    below = int((table["estimate_mm"] < table["error_mean_mm"]).sum())
    assert f"below the measured mean at {below} of 4 grids" in claims
    assert "from 125 to 729 samples" in claims.lower()


def with_errors(data: ReportData, errors_mm: list[list[float]]) -> ReportData:
    """The same study with other errors, one list of seeds for each grid."""
    grids: list[Grid] = []
    for grid, values in zip(data.grids, errors_mm, strict=True):
        errors = pd.DataFrame(
            {"region": data.first_path, "seed": range(len(values)), "error_mean_mm": values}
        )
        grids.append(replace(grid, errors=errors, members=grid.members.iloc[: len(values)]))
    return replace(data, grids=grids)


@pytest.mark.parametrize(
    ("last", "words"),
    [
        (
            [1.0, 1.1, 1.2, 0.9, 1.0, 1.05, 0.95],
            "has not levelled off where the paper says it does",
        ),
        ([2.0, 2.1, 2.2, 1.9, 2.0, 2.05, 1.95], "lost in the scatter of the seeds"),
        ([1.0], "cannot say how sure"),
    ],
)
def test_the_verdict_follows_the_errors(data: ReportData, last: list[float], words: str) -> None:
    before = [2.0, 2.1, 2.2, 1.9, 2.0, 2.05, 1.95][: len(last)]
    changed = with_errors(data, [[30.0] * len(last), [6.0] * len(last), before, last])
    assert words in verdict(changed)[1]


def test_the_verdict_on_an_estimate_that_holds(data: ReportData) -> None:
    above = data.table.assign(estimate_mm=data.table["error_mean_mm"] + 1, above_estimate=0.125)
    assert "exceeded on up to 12.5 % of the workspace" in verdict(replace(data, table=above))[1]
    never = above.assign(above_estimate=0.0)
    assert "was exceeded at no point" in verdict(replace(data, table=never))[1]


def test_a_grid_whose_networks_all_diverged_is_an_empty_row(
    built: tuple[Study, Path, Path], tmp_path: Path
) -> None:
    study, results, _ = built
    copy = tmp_path / "results"
    shutil.copytree(results, copy)
    members = pd.read_parquet(copy / "network/grid2/members.parquet").assign(diverged=True)
    members.to_parquet(copy / "network/grid2/members.parquet")
    table = pd.read_csv(copy / "table.csv")
    measured = [c for c in table if "error_" in c and "paper" not in c] + ["estimate_mm"]
    table.loc[0, measured] = np.nan
    table.to_csv(copy / "table.csv", index=False)
    write_report(study, copy, tmp_path / "report")
    text = (tmp_path / "report/index.html").read_text(encoding="utf-8")
    assert "nan" not in html.fromstring(text).xpath("//main")[0].text_content().lower().split()
    rows = cells_of(html.fromstring(text), "table-1")
    assert rows[0]["error_mean_mm"] == ""
    assert rows[0]["paper_error_mm"] == "19.31 ± 3.75"


@pytest.mark.parametrize(
    ("settings", "losses"),
    [
        ({"samples": {"points_per_axis": [9]}, "training": {"seeds": 1}}, True),
        (
            {
                "samples": {"points_per_axis": [4, 6]},
                "training": {"seeds": 2, "held_out": {"validation_share": 0, "at_least": 0}},
                "workspace": {"lower_mm": [30, 30, 0], "upper_mm": [75, 70, 45]},
                "evaluation": {
                    "cube_points": 128,
                    "paths": {
                        "heart": {"shape": "heart", "centre_mm": [52, 50, 22], "width_mm": 30},
                        "tilted": {
                            "shape": "heart",
                            "centre_mm": [52, 50, 22],
                            "width_mm": 20,
                            "tilt_rad": 0,
                        },
                    },
                },
            },
            False,
        ),
    ],
    ids=["one grid, one seed, not in the paper", "another box, hearts, no validation"],
)
def test_other_studies(settings: dict[str, Any], losses: bool, tmp_path: Path) -> None:
    study = finished({"name": "other", **SMALL, **settings}, tmp_path / "results", losses)
    write_report(study, tmp_path / "results", tmp_path / "report", "snakemake -c 2")
    page = html.parse(tmp_path / "report/index.html").getroot()
    text = page.text_content()
    assert "nan" not in re.findall(r"[a-z]+", page.xpath("//main")[0].text_content().lower())
    assert "± nan" not in text
    assert "snakemake -c 2" in text
    heads = page.xpath("//div[@id='table-1']//thead//text()")
    if study.samples.points_per_axis == [9]:
        assert "paper" not in heads
        assert "a single seed" in text
        assert "Figure 5." not in text
    else:
        assert "paper" in heads
        assert "which is for another arm, workspace or path" in text
        assert "workspace.lower_mm" in text


def test_results_that_are_missing_stop_it_and_leave_the_old_report(
    built: tuple[Study, Path, Path], tmp_path: Path
) -> None:
    study, results, _ = built
    output = tmp_path / "report"
    output.mkdir()
    (output / "README.md").write_text("old")
    copy = tmp_path / "results"
    shutil.copytree(results, copy)
    (copy / "network/grid3/errors.parquet").unlink()
    with pytest.raises(IksamplesError, match=r"not finished.*errors\.parquet"):
        write_report(study, copy, output)
    assert [path.name for path in output.iterdir()] == ["README.md"]
    assert (output / "README.md").read_text() == "old"


def test_a_number_is_printed_with_its_unit_left_to_the_head() -> None:
    assert str(Number(2.0134, 2, 0.355)) == "2.01 ± 0.35"
    assert str(Number(-0.0449, 3)) == "−0.045"
    assert str(Number(32000, 0)) == "32\u202f000"
    assert str(Number(float("nan"))) == ""


@given(st.sets(st.integers(2, 12), min_size=1))
def test_shown_grids_are_the_papers_where_there_are_some(sizes: set[int]) -> None:
    class Fake:
        def __init__(self, m: int) -> None:
            self.m = m

    grids: Any = [Fake(m) for m in sorted(sizes)]
    shown = [grid.m for grid in shown_grids(grids)]
    assert shown == sorted(set(shown))
    assert len(shown) == min(4, len(sizes))
    assert set(shown) >= {2, 3, 5, 7} & sizes


def test_changed_settings_name_the_key_and_both_values() -> None:
    study = parse_study(
        {
            "name": "other",
            "training": {"epochs": 50},
            "evaluation": {"paths": {"heart": {"shape": "heart"}}},
        }
    )
    rows = {row[0]: row[1:] for row in changed_settings(study)}
    assert rows["`training.epochs`"] == ["500", "50"]
    assert rows["`evaluation.paths.rectangles`"][1] == "—"
    assert set(rows) == {"`training.epochs`", "`evaluation.paths.rectangles`"}
    assert changed_settings(parse_study({"name": "same", "title": "Another name"})) == []


def test_intervals_against_scipy(rng: np.random.Generator) -> None:
    values = rng.lognormal(size=25)
    theirs = stats.bootstrap(
        (values,), np.median, method="percentile", n_resamples=4000, rng=rng
    ).confidence_interval
    ours = median_interval(values)
    assert ours.value == np.median(values)
    assert ours.low == pytest.approx(theirs.low, rel=0.1)
    assert ours.high == pytest.approx(theirs.high, rel=0.1)
    assert not median_interval(values[:4]).known


def test_a_power_law_gives_its_exponent(rng: np.random.Generator) -> None:
    n = np.array([64, 125, 216, 343, 512])
    exact = [np.full(6, 3.0 * size**-0.4) for size in n]
    assert slope_interval(n, exact) == pytest.approx((-0.4, -0.4, -0.4))
    noisy = [3.0 * size**-0.4 * rng.lognormal(0, 0.2, 20) for size in n]
    slope = slope_interval(n, noisy)
    line = stats.linregress(np.log(n), np.log([group.mean() for group in noisy]))
    assert slope.value == pytest.approx(line.slope)


def test_the_interval_of_a_slope_holds_the_truth_as_often_as_it_says(
    rng: np.random.Generator,
) -> None:
    n = np.array([64, 125, 216, 343, 512])
    intervals = [
        slope_interval(n, [3.0 * size**-0.4 * rng.lognormal(0, 0.2, 20) for size in n])
        for _ in range(200)
    ]
    held = sum(interval.low < -0.4 < interval.high for interval in intervals)
    # 0.95 promised; a bootstrap of 20 seeds gives a little less.
    assert 0.88 < held / len(intervals) < 0.99


def test_a_fall_is_a_share_of_the_mean(rng: np.random.Generator) -> None:
    before, after = rng.normal(4, 0.1, 30), rng.normal(3, 0.1, 30)
    fall = fall_interval(before, after)
    assert fall.value == pytest.approx(1 - after.mean() / before.mean())
    assert fall.low < fall.value < fall.high
    assert 0.2 < fall.low < fall.high < 0.3


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium: the system's, or the one Playwright brings."""
    from playwright.sync_api import Error, sync_playwright

    arguments = [
        "--no-sandbox",
        "--disable-gpu",
        "--no-first-run",
        "--disable-background-networking",
    ]
    names = ("chromium", "chromium-browser", "google-chrome")
    system = next((path for name in names if (path := shutil.which(name))), None)
    with sync_playwright() as playwright:
        try:
            chromium = playwright.chromium.launch(executable_path=system, args=arguments)
        except Error as error:
            pytest.skip(f"no Chromium here: {error.message.splitlines()[0]}")
        yield chromium
        chromium.close()


@pytest.fixture
def opened(browser: Any, built: tuple[Study, Path, Path]) -> Iterator[Any]:
    """The page in a window; fails on a complaint of the browser or any request but its own."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    complaints: list[str] = []
    requests: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    address = (built[2] / "index.html").as_uri()
    page.goto(address)
    yield page
    assert complaints == []
    assert [url for url in requests if not url.startswith("data:")] == [address]
    page.close()


def pixels(page: Any) -> str:
    return str(page.evaluate("document.querySelector('#viewer canvas').toDataURL()"))


@pytest.mark.slow
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
    # Once released it stays.
    opened.mouse.move(box["x"] + 100, box["y"] + 100)
    assert canvas.get_attribute("data-view").startswith(f"{azimuth:.1f} {elevation:.1f}")


@pytest.mark.slow
def test_the_view_shows_the_chosen_grid_path_and_network(opened: Any, data: ReportData) -> None:
    canvas = opened.locator("#viewer canvas")
    seen = {pixels(opened)}
    for name in ("125", "Heart", "worst"):
        opened.get_by_role("button", name=name, exact=True).click()
        seen.add(pixels(opened))
    assert len(seen) == 4
    assert canvas.get_attribute("data-view").split()[2:] == ["125", "heart", "worst", "0"]
    slider = opened.locator("#viewer input")
    slider.fill("50")
    assert canvas.get_attribute("data-view").endswith(" 50")
    grid = data.grids[2]
    worst = grid.track("heart", grid.ranked_seeds("heart")[-1])
    assert opened.locator("#viewer output").inner_text() == (
        f"{worst.error_mm[50]:.2f} mm off here, {worst.error_mm.max():.2f} mm at most"
    )
    canvas.focus()
    opened.keyboard.press("ArrowLeft")
    assert canvas.get_attribute("data-view").startswith("-57.0 ")


@pytest.mark.slow
def test_pointing_at_a_seed_names_it(opened: Any, data: ReportData) -> None:
    marks = opened.locator("#error-against-samples [data-tip]")
    assert marks.count() == 2 * sum(len(grid.members) for grid in data.grids)
    mark = marks.nth(9)
    mark.scroll_into_view_if_needed()
    box = mark.bounding_box()
    opened.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    errors = pd.read_parquet(data.results / "network/grid3/errors.parquet")
    row = errors[(errors["region"] == "rectangles") & (errors["seed"] == 2)].iloc[0]
    assert opened.locator("#tip").inner_text() == (
        f"27 samples, seed 2: mean {row['error_mean_mm']:.2f} mm, "
        f"worst {row['error_max_mm']:.2f} mm"
    )
    opened.mouse.move(5, 5)
    assert opened.locator("#tip").is_hidden()


@pytest.mark.slow
def test_the_page_fits_a_phone_and_a_dark_screen(opened: Any) -> None:
    background = "getComputedStyle(document.body).backgroundColor"
    light = opened.evaluate(background)
    opened.emulate_media(color_scheme="dark")
    assert opened.evaluate(background) != light
    opened.emulate_media(color_scheme="dark", media="print")
    assert opened.evaluate(background) == light
    opened.emulate_media(media="screen")
    opened.set_viewport_size({"width": 390, "height": 800})
    assert opened.evaluate("document.documentElement.scrollWidth") == 390
