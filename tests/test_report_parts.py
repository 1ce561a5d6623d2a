"""The report's parts: text that stays text, tables, lines, and what a study differs in."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lxml import html
from markupsafe import Markup

from iksamples.errors import IksamplesError, one_line
from iksamples.report import figures, markdown
from iksamples.report.data import read_benchmarks
from iksamples.report.figures import lines
from iksamples.report.run import differing
from iksamples.report.views import Strokes, arm, error_map, plans
from iksamples.study import Method, parse_study
from iksamples.task import study_task


ROOT = Path(__file__).parents[1]
PRINTED = st.text(st.characters(blacklist_categories=["Cc", "Cs", "Zs", "Zl", "Zp"]), min_size=1)
"""Text without blanks, which HTML is free to join."""


@given(PRINTED)
def test_any_text_shows_as_itself(text: str) -> None:
    """In a sentence, in bold, in a table and as code, in the page as in any CommonMark reader."""
    shown = markdown.escaped(text)
    page = html.fromstring(
        "<div>"
        + markdown.to_html(
            f"# a {shown}\n\na **{shown}** b\n\n"
            + str(markdown.table(pd.DataFrame({"Name": [text], "Value": [1]})))
            + f"\n\na {markdown.code(text)} b\n",
            {},
        )
        + "</div>"
    )
    assert page.xpath("string(//h1)") == f"a {text}"
    assert page.xpath("string(//p/strong)") == text
    assert page.xpath("string(//tbody//td[1])") == text
    assert page.xpath("string(//p/code)") == text
    assert {one.tag for one in page.iter()} <= {
        *("div", "h1", "p", "strong", "code"),
        *("table", "thead", "tbody", "tr", "th", "td"),
    }


@given(st.text(st.characters(blacklist_categories=["Cs"])))
def test_no_text_ends_its_line(text: str) -> None:
    """Whatever ends lines for anybody: the text stays where its sentence, cell or fence is."""
    shown = markdown.escaped(text)
    table = markdown.table(
        pd.DataFrame({"Name": [text], "Code": markdown.objects([markdown.code(text)])})
    )
    whole = markdown.tidy(
        f"# a {shown} b\n\na {shown} b\n\n- a {shown} b\n\n{table}\n\n"
        f"```bash\na {one_line(text)} b\n```\n"
    )
    page = html.fromstring(f"<div>{markdown.to_html(whole, {})}</div>")
    assert [one.tag for one in page.iter()] == [
        *("div", "h1", "p", "ul", "li", "div", "table", "thead", "tr", "th", "th"),
        *("tbody", "tr", "td", "td", "code", "pre", "code"),
    ]
    plain = " ".join(f"a {one_line(text)} b".split())
    for place in ("h1", "p", "ul/li", "pre"):
        assert " ".join(page.xpath(f"string({place})").split()) == plain


@pytest.mark.parametrize(
    "text",
    ["<img src=x onerror=alert(1)>", "[x](http://a.b)", "![x](y.png)", "<script>x</script>", "$x$"],
)
def test_marks_and_elements_of_others_are_inert(text: str) -> None:
    shown = markdown.escaped(text)
    page = html.fromstring(f"<div>{markdown.to_html(f'# {shown}', {})}</div>")
    assert [one.tag for one in page.iter()] == ["div", "h1"]
    assert page.text_content().strip() == text
    assert "<" not in shown


def test_a_float_has_to_be_rounded() -> None:
    with pytest.raises(TypeError, match="rounds"):
        markdown.escaped(1 / 3)


@pytest.mark.parametrize(
    ("value", "digits", "shown"),
    [
        (2.0134, 2, "2.01"),
        (0.0449, 2, "0.045"),
        (-0.0449, 3, "−0.045"),
        (0.000996, 2, "0.0010"),
        (32000, 0, "32\u202f000"),
        (8, 0, "8"),
        (0, 2, "0.00"),
        (3e-9, 2, "0.00"),
        (float("nan"), 2, ""),
    ],
)
def test_numbers(value: float, digits: int, shown: str) -> None:
    assert markdown.number(value, digits) == shown


@given(st.floats(1e-5, 1e6), st.integers(1, 3))
def test_bounds_are_rounded_outward(value: float, digits: int) -> None:
    low, high = (
        float(markdown.number(value, digits, way).replace("\u202f", "")) for way in ("down", "up")
    )
    assert low <= value <= high
    assert high - low <= max(10.0**-digits, 0.11 * value) * (1 + 1e-9)
    share = value / 1e6
    at_least = markdown.percent(share, digits, "down").removesuffix("\u00a0%")
    assert float(at_least) <= 100 * share * (1 + 1e-12)


@pytest.mark.parametrize("share", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("rounding", ["", "up", "down"])
def test_a_share_that_is_not_finite_is_a_dash(share: float, rounding: str) -> None:
    assert markdown.percent(share, 1, rounding) == "–"


def test_a_table_keeps_its_columns() -> None:
    frame = pd.DataFrame(
        {"Name": ["a|b", Markup("**c**")], "n": [1, 2], "|x|": [0.5, float("nan")]}, dtype=object
    )
    rows = markdown.table(frame).splitlines()
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} == {4}
    assert rows[1] == "| --- | --: | --: |"
    assert rows[3] == "| **c** | 2 |  |"


def test_paragraphs_are_a_line_each() -> None:
    text = "# a\n\n\n\nb\nc\n| x |\n| - |\n\n```\nd\n e\n```\n*f\n`g`*\n"
    assert markdown.tidy(text) == "# a\n\nb c\n| x |\n| - |\n\n```\nd\n e\n```\n*f `g`*\n"


def test_lines_are_medians_with_the_middle_half(rng: np.random.Generator) -> None:
    table = pd.DataFrame(
        [
            {"n": n, "mm": rng.lognormal() / n, "line": line, "panel": panel, "tip": f"{n} {seed}"}
            for n in (8, 27, 64)
            for line in ("a", "b")
            for panel in ("one", "two")
            for seed in range(9)
        ]
    )
    looks = {"b": {"color": "#123456"}, "a": {"color": "#654321"}}
    figure, tips = lines(table, "n", "mm", looks, "n", "mm", panel="panel", tolerance=0.5)
    assert [axis.get_title("left") for axis in figure.axes] == ["One", "Two"]
    [axis, _] = figure.axes
    part = table[(table["panel"] == "one") & (table["line"] == "b")].groupby("n")["mm"]
    drawn = axis.get_lines()[0]
    assert drawn.get_color() == "#123456"
    np.testing.assert_array_equal(drawn.get_xdata(), [8, 27, 64])
    np.testing.assert_allclose(drawn.get_ydata(), part.apply(np.median))
    band = axis.collections[0].get_paths()[0].vertices[:, 1]
    quartiles = part.apply(lambda one: np.percentile(one, [25, 75])).to_list()
    np.testing.assert_allclose(sorted(set(band)), sorted(np.ravel(quartiles)))
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    assert set(tips) == {"marks-0-0", "marks-0-1", "marks-1-0", "marks-1-1"}
    assert all(len(one) == 27 for one in tips.values())
    svg = figures.svg(figure, "name", "words", tips)
    assert svg.count("data-tip") == 4 * 27
    assert svg.count('id="name-') == len(re.findall(r'\bid="', svg))


def test_a_band_that_is_given_is_drawn() -> None:
    table = pd.DataFrame({"n": [1, 2], "y": [3.0, 4.0], "low": [2.0, 3.5], "high": [5.0, 6.0]})
    figure, tips = lines(table.assign(line="a"), "n", "y", {"a": {"color": "k"}}, "", "")
    band = figure.axes[0].collections[0].get_paths()[0].vertices[:, 1]
    assert set(band) == {2.0, 3.5, 5.0, 6.0}
    assert tips == {}


def test_strokes_are_lifted_where_the_table_says() -> None:
    table = pd.DataFrame(
        {
            "waypoint": [2, 1, 0, 3],
            "target_a_mm": [2.0, 1.0, 0.0, 3.0],
            "target_b_mm": 0.0,
            "reached_a_mm": [2.5, 1.0, 0.0, 3.0],
            "reached_b_mm": 0.0,
            "target_yaw_rad": 1.0,
            "q_j_rad": 0.1,
            "error_mm": [0.5, 0.0, 0.0, 0.0],
            "seed": 0,
            "pen_up": [True, False, True, False],
        }
    )
    strokes = Strokes(table)
    assert strokes.names == ["a_mm", "b_mm"]
    assert strokes.breaks == [2]
    np.testing.assert_array_equal(strokes.error, [0, 0, 0.5, 0])
    assert np.isnan(strokes.lifted(strokes.target)[2]).all()


def test_an_axis_ends_where_only_rounding_is_left() -> None:
    table = pd.DataFrame({"n": [8, 27] * 2, "e": [1e-13, 2e-13, 3.0, 0.1], "line": list("aabb")})
    [axis] = lines(table, "n", "e", figures.colours(["a", "b"]), "n", "e").figure.axes
    low, high = axis.get_ylim()
    assert 1e-7 < low < 0.1 < 3 < high


def test_a_planar_workspace_has_one_map_and_one_plan() -> None:
    side = np.linspace(0, 1, 9)
    a, b = (one.ravel() for one in np.meshgrid(side, side))
    slices = pd.DataFrame({"slice": "", "a_mm": a, "b_mm": b, "error_mm": a + 2 * b})
    slices.loc[0, "error_mm"] = np.nan  # outside the region
    [axis, bar] = error_map(slices, "error_mm", 1.5).axes
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("a [mm]", "b [mm]")
    [worst] = axis.get_lines()
    assert (worst.get_xdata()[0], worst.get_ydata()[0]) == (1, 1)
    assert bar.get_ylim()[1] >= 3
    waypoints = pd.DataFrame(
        {
            "waypoint": range(9),
            "target_a_mm": side,
            "target_b_mm": side,
            "reached_a_mm": side + 0.1,
            "reached_b_mm": side,
            "q_j_mm": side,
            "error_mm": 0.1,
            "seed": 0,
            "pen_up": False,
        }
    )
    figure = plans([(4, Strokes(waypoints), np.array([[0.0, 0], [0, 1], [1, 0], [1, 1]]))])
    [axis] = [one for one in figure.axes if one.get_visible()]
    np.testing.assert_array_equal(axis.get_lines()[1].get_xdata(), side + 0.1)


def test_planes_of_different_inputs_have_axes_of_their_own() -> None:
    side = np.linspace(0, 1, 5)
    a, b = (one.ravel() for one in np.meshgrid(side, side))
    coordinates = {"x_mm": 1.0, "y_mm": 1.0, "z_mm": 1.0, "yaw_rad": 1.0}
    slices = pd.concat(
        pd.DataFrame(coordinates | {i: a, j: b, "slice": i, "error_mm": a, "angle_deg": a * b})
        for i, j in (("x_mm", "y_mm"), ("z_mm", "yaw_rad"))
    )
    first, second, bar = error_map(slices, "angle_deg", None).axes
    assert (first.get_xlabel(), first.get_ylabel()) == ("x [mm]", "y [mm]")
    assert (second.get_xlabel(), second.get_ylabel()) == ("z [mm]", "yaw [rad]")
    assert [text.get_text() for text in second.texts] == ["1.0°"]
    assert "deg" in bar.get_ylabel()


def test_what_differs_is_named_as_the_study_file_has_it() -> None:
    changed = {"network": {"activation": "tanh"}, "training": {"early_stopping": {"patience": 7}}}
    other = parse_study({"name": "s", "methods": {"other": changed}}).methods["other"]
    sides = [one.model_dump(mode="json") for one in (Method(), other)]
    rows = {str(key): (str(there), str(here)) for key, there, here in differing(*sides)}
    assert rows["`network.activation`"] == ("`relu`", "`tanh`")
    assert rows["`training.early_stopping`"][0] == "`null`"
    assert "patience: 7" in rows["`training.early_stopping`"][1]
    assert len(rows) == 2
    assert list(differing(sides[0], sides[0])) == []


def test_benchmark_files_are_read_job_by_job(tmp_path) -> None:
    (tmp_path / "evaluate").mkdir()
    (tmp_path / "evaluate" / "a.jsonl").write_text('{"s": 1.5, "cpu_time": 1.0, "max_rss": "NA"}\n')
    (tmp_path / "evaluate" / "b.jsonl").write_text('{"s": 2.25, "max_rss": 210.0}\n\n')
    (tmp_path / "train.jsonl").write_text('{"s": 4.0, "max_rss": 500.5}\n')
    table = read_benchmarks(tmp_path)
    assert table.groupby("step")["s"].sum().to_dict() == {"evaluate": 3.75, "train": 4.0}
    assert table["max_rss_mb"].max() == 500.5
    assert table["max_rss_mb"].isna().sum() == 1
    assert read_benchmarks(tmp_path / "none").empty
    for line in ('{"s": 4.0, "max', "[]", "\xff"):  # a run was killed, or a hand was there
        (tmp_path / "train.jsonl").write_bytes(line.encode("latin1"))
        with pytest.raises(IksamplesError, match=r"train\.jsonl: .*Delete it"):
            read_benchmarks(tmp_path)


@pytest.mark.parametrize(
    "file", [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *ROOT.glob("docs/**/*.md")], ids=str
)
def test_links_between_the_files_kept_resolve(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)\s#]+)[^)]*\)", re.sub(r"`[^`]*`", "", text))
    for link in links:
        assert "://" in link or (file.parent / link).exists(), link


def test_the_arm_is_drawn_with_its_tool_where_it_went() -> None:
    """Each seed's arm is another one, and none is the drawing."""
    task = study_task(parse_study({"name": "arms", "arm": {"deviation_mm": 5}}))
    joints = np.array([[0.8, 0.4, -1.2], [0.7, 0.5, -1.1]])
    reached = task.arm_of(3).forward_mm(joints)
    rows = pd.DataFrame(
        {"waypoint": [0, 1], "seed": 3, "pen_up": False, "error_mm": [5.0, 6.0]}
        | {f"target_{axis}_mm": reached[:, i] + 3 for i, axis in enumerate("xyz")}
        | {f"reached_{axis}_mm": reached[:, i] for i, axis in enumerate("xyz")}
        | {f"q_{name}_rad": joints[:, i] for i, name in enumerate(task.q.names)}
    )
    corners = np.array([20.0, 20, 0]), np.array([80.0, 80, 60])
    figure = arm(task.chain_of, corners, [(8, Strokes(rows), reached)])
    by_label = {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
    (links,) = (line.get_xydata() for line in figure.axes[0].lines if line.get_linewidth() == 5)
    np.testing.assert_allclose(links[-1], by_label["largest error"][-1], atol=1e-9)
