"""Samples from elsewhere: every usual form of a table is read right or refused in a line."""

import gzip
import io
import time
from dataclasses import replace

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyarrow import parquet

from iksamples.errors import IksamplesError
from iksamples.recorded.learn import read_samples
from iksamples.samples.measured import name_and_unit
from iksamples.samples.record import grid_samples, record_samples
from iksamples.samples.table import read_table
from iksamples.study import parse_study, read_study
from iksamples.task import study_task


@pytest.fixture(scope="module")
def recorded():
    """A study, its task, 27 samples of it, and these as the documented table."""
    study = parse_study({"name": "paper"})
    task = study_task(study)
    samples = grid_samples(study, task, 3)
    columns = dict(zip(("x_mm", "y_mm", "z_mm"), samples.x.T, strict=True))
    columns |= {f"q_{n}_rad": q for n, q in zip(task.q.names, samples.joints.T, strict=True)}
    return study, task, samples, pd.DataFrame(columns)


NAMES = "x_mm,y_mm,z_mm,q_yaw_rad,q_shoulder_rad,q_elbow_rad"


def text(table, **options):
    return table.to_csv(index=False, **options)


def scaled(table, lengths=1.0, angles=1.0):
    return pd.DataFrame({c: v * (lengths if c[0] in "xyz" else angles) for c, v in table.items()})


def renamed(table, names):
    return table.set_axis(names.split(","), axis=1)


DEG = 180 / np.pi
FORMS = {
    "as documented": text,
    "semicolons": lambda t: text(t, sep=";"),
    "tabs": lambda t: text(t, sep="\t"),
    "a sign of control behind a number": lambda t: text(t)[:-1] + "\x1f\n",
    "bars": lambda t: text(t, sep="|"),
    "spaces": lambda t: text(t, sep=" "),
    "aligned": lambda t: t.to_string(index=False, float_format="%.17g") + "\n",
    "decimal commas": lambda t: text(t, sep=";", decimal=","),
    "CRLF": lambda t: text(t, lineterminator="\r\n"),
    "byte order mark": lambda t: text(t).encode("utf-8-sig"),
    "UTF-16": lambda t: text(t).encode("utf-16"),
    "gzipped": lambda t: gzip.compress(text(t).encode()),
    "quoted": lambda t: text(t, quoting=1),
    "comments": lambda t: f"# arm 3\n\n{text(t)}# the end\n",
    "names in a comment": lambda t: "# arm 3\n# " + text(t, sep=" "),
    "empty rows at the end": lambda t: f"{text(t)},,,,,\n,,,,,\n\n",
    "separator at the end": lambda t: text(t).replace("\n", ",\n"),
    "separator at the end of rows": lambda t: (
        text(t).replace("\n", ",\n").replace("rad,\n", "rad\n")
    ),
    "an index": lambda t: t.to_csv(),
    "another order and more columns": lambda t: text(t.iloc[:, ::-1].assign(note="a, b")),
    "capitals": lambda t: text(renamed(t, NAMES.upper())),
    "units below": lambda t: text(renamed(t, "x,y,z,yaw,shoulder,elbow")).replace(
        "elbow\n", "elbow\nmm,mm,mm,rad,rad,rad\n"
    ),
    "units below that are others": lambda t: text(
        renamed(scaled(t, 0.1, DEG), "x,y,z,yaw,shoulder,elbow")
    ).replace("elbow\n", "elbow\n[cm],[cm],[cm],[deg],[deg],[deg]\n"),
    "metres and degrees": lambda t: text(
        renamed(scaled(t, 1e-3, DEG), "x_m,y_m,z_m,q1_deg,q2_deg,q3_deg")
    ),
    "brackets": lambda t: text(
        renamed(scaled(t, 0.1, DEG), "X [cm],Y [cm],Z (cm),q_yaw (deg),Shoulder [°],elbow [deg]")
    ),
    "no units": lambda t: text(renamed(scaled(t, 1e-3, DEG), "x,y,z,q1,q2,q3")),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_table_is_read_in_every_usual_form(recorded, tmp_path, form):
    study, task, samples, table = recorded
    content = FORMS[form](table)
    path = tmp_path / "arm.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    found, said = read_samples(study, task, path)
    assert found.label == "measured27"
    np.testing.assert_allclose(found.x, samples.x, atol=1e-9)
    np.testing.assert_allclose(found.joints, samples.joints, atol=1e-12)
    assert len(said) == (form == "no units")
    for line in said:
        assert "no unit is said for x, y, z, q_yaw" in line
        assert "taken as m and deg, in which" in line


def test_parquet_is_read(recorded, tmp_path):
    study, task, samples, table = recorded
    table.assign(note="a").to_parquet(tmp_path / "arm.parquet")
    found, _ = read_samples(study, task, tmp_path / "arm.parquet")
    np.testing.assert_array_equal(found.joints, samples.joints)
    samples.save(tmp_path / "own.parquet")
    own, said = read_samples(study, task, tmp_path / "own.parquet")
    assert (own.digest(), said) == (samples.digest(), [])
    joints = replace(task.q, names=("a", "b", "c"))
    replace(samples, joint_space=joints).save(tmp_path / "other.parquet")
    with pytest.raises(IksamplesError, match="samples of the joints a, b, c"):
        read_samples(study, task, tmp_path / "other.parquet")


def cells(**changes):
    """Changes of single cells: column -> (row, text)."""

    def change(table):
        table = table.astype(object)
        for column, (row, cell) in changes.items():
            table.loc[row, column] = cell
        return text(table)

    return change


REFUSED = {
    "a value more": (
        lambda t: text(t).replace("\n", ",1\n").replace("rad,1", "rad"),
        "row 1 (line 2) has 7 values, but there are 6 names",
    ),
    "a value more in one row": (
        lambda t: "\n".join(text(t).splitlines()[:5]) + ",9\n",
        "row 4 (line 5) has 7 values",
    ),
    "a value less": (
        lambda t: "# made by hand\n" + "\n".join(text(t).splitlines()[:5])[:-25] + "\n",
        "row 4 (line 6) has 5 values",
    ),
    "rows of another separator": (
        lambda t: text(t, sep=";").replace(";", ",", 5),
        "row 1 (line 2) has 1 values",
    ),
    "no names": (lambda t: text(t, header=False), "no names above the columns"),
    "a column less": (
        lambda t: text(t.drop(columns="y_mm")),
        "no column y_mm; there are x_mm, z_mm",
    ),
    "a column twice": (lambda t: text(t.assign(X_MM=t.x_mm)), "the columns x_mm and X_MM mean the"),
    "the wrong kind of unit": (
        lambda t: text(t.rename(columns={"q_yaw_rad": "q_yaw_mm"})),
        "q_yaw_mm: mm is no unit of q_yaw; it is measured in rad, deg",
    ),
    "thousands": (
        cells(x_mm=(3, "1,025.0")),
        "row 4 (line 5) has '1,025.0' as x_mm, which is no pl",
    ),
    "thousands that look like decimals": (
        lambda t: text(t.assign(x_mm="1,025"), sep=";"),
        "row 1 (line 2) has '1,025' as x_mm",
    ),
    "a word": (cells(z_mm=(0, "none")), "row 1 (line 2) has 'none' as z_mm"),
    "nothing": (cells(q_elbow_rad=(5, "")), "row 6 (line 7) has nothing as q_elbow_rad"),
    "NaN": (
        cells(q_elbow_rad=(5, "NaN"), x_mm=(6, "inf")),
        "has 'NaN' as q_elbow_rad, which is no plain number such as 1025.5 (2 such cells in all)",
    ),
    "degrees called radians": (
        lambda t: text(scaled(t, 1, DEG)),
        "In mm and deg they would: say so in the names, such as x_mm and",
    ),
    "metres called millimetres": (lambda t: text(scaled(t, 1e-3)), "In m and rad they would"),
    "another arm": (
        lambda t: text(t.assign(x_mm=t.x_mm + 300)),
        "Is it another arm, base, tool or",
    ),
    "no units and another arm": (
        lambda t: text(renamed(t + 300, "x,y,z,q1,q2,q3")),
        "Is it another",
    ),
    "one row": (lambda t: text(t[:1]), "1 rows; at least 2"),
    "no rows": (lambda t: text(t[:0]), "there are names but no rows"),
    "a plane": (lambda t: text(t[t.z_mm == t.z_mm[0]]), "z is the same in every record"),
    "empty": (lambda t: "", "the file is empty"),
    "only comments": (lambda t: "# one\n# two\n", "there are only comments"),
    "JSON": (lambda t: t.to_json(orient="records"), "no table (it looks like JSON or HTML)"),
    "spreadsheet": (lambda t: b"PK\x03\x04" + bytes(99), "a spreadsheet or an archive; save it as"),
    "picture": (lambda t: b"\x89PNG\r\n\x1a\n" + bytes(99), "no text in UTF-8"),
    "half of a Parquet file": (lambda t: b"PAR1" + bytes(99), "not a whole Parquet file"),
    "half of a gzip file": (
        lambda t: gzip.compress(text(t).encode())[:99],
        "cannot read the samples",
    ),
    "a spoilt gzip file": (
        lambda t: gzip.compress(text(t).encode())[:20] + bytes(99),
        "cannot read the samples",
    ),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_faulty_table_is_refused_in_a_line(recorded, tmp_path, fault):
    study, task, _, table = recorded
    make, message = REFUSED[fault]
    content, path = make(table), tmp_path / "arm.csv"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(IksamplesError) as caught:
        read_samples(study, task, path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(recorded, tmp_path):
    with pytest.raises(IksamplesError, match="cannot read the samples"):
        read_samples(*recorded[:2], tmp_path / "absent.csv")


def test_what_is_odd_is_named_with_its_rows(recorded, tmp_path):
    study, task, _, table = recorded
    table = table.copy()
    table.loc[4, "x_mm"] += 3.0
    # The other elbow at the same place.
    shoulder, elbow = table.loc[7, "q_shoulder_rad"], table.loc[7, "q_elbow_rad"]
    table.loc[7, "q_shoulder_rad"], table.loc[7, "q_elbow_rad"] = shoulder + elbow, -elbow
    table.loc[9, "q_yaw_rad"] += 2 * np.pi
    table.loc[27] = table.loc[0]
    (tmp_path / "arm.csv").write_text("# by hand\n" + text(table))
    found, lines = read_samples(study, task, tmp_path / "arm.csv")
    assert found.n_samples == 27
    said = "\n".join(lines)
    assert "1 of 28 records stand there twice" in said
    assert "left out (row 28 (line 30))" in said
    assert "1 of 27 records have the tool much farther from where the drawing puts it" in said
    assert "3 mm at most; kept, the farthest first: row 5 (line 7)." in said
    assert "2 of 27 records have joints far from the study's: another branch" in said
    assert "or full turns; a network" in said
    assert "between (row 8 (line 10), row 10 (line 12))" in said
    assert "2 of 27 records are outside the joint limits (row 8 (line 10), row 10" in said


def test_samples_of_the_branch_that_the_study_does_not_have_are_named(recorded, tmp_path):
    """All of them, so that no neighbour has other joints."""
    study, task, samples, table = recorded
    yaw, shoulder, elbow = samples.joints.T
    names = ["q_yaw_rad", "q_shoulder_rad", "q_elbow_rad"]
    other = np.stack([yaw, shoulder + elbow, -elbow], axis=1)
    np.testing.assert_allclose(task.drawing.forward_mm(other), samples.x, atol=1e-9)
    text_of = text(table.assign(**dict(zip(names, other.T, strict=True))))
    (tmp_path / "arm.csv").write_text(text_of)
    _, lines = read_samples(study, task, tmp_path / "arm.csv")
    assert any("27 of 27 records have joints far from the study's" in line for line in lines)


def test_an_arm_off_its_drawing_is_said_to_be(recorded, tmp_path):
    """Alike in all records, so that none of them is odd."""
    study, task, _, table = recorded
    (tmp_path / "arm.csv").write_text(text(table.assign(x_mm=table.x_mm + 2)))
    [line] = read_samples(study, task, tmp_path / "arm.csv")[1]
    assert "half of the records are 2 mm or more from where the drawing puts the tool" in line


def test_angles_that_a_task_asks_for_are_read_as_they_are(tmp_path):
    """Beyond half a turn too, where roll, pitch and yaw of a rotation would come back smaller."""
    study = read_study("config/studies/scara.yaml")
    task = study_task(study)
    samples = record_samples(study, task, "grid", 16)
    names = [*task.x.columns(), *task.q.columns("q_")]
    table = pd.DataFrame(np.hstack([samples.x, samples.joints]), columns=names)
    table["yaw_deg"] = np.degrees(table.pop("yaw_rad")) + 360
    table = table.rename(columns={"x_mm": "tcp"})
    table.to_csv(tmp_path / "arm.csv", index=False)
    found, _ = read_samples(study, task, tmp_path / "arm.csv", {"x_mm": "tcp"})
    turned = np.where(np.array(task.x.names) == "yaw", 2 * np.pi, 0)
    np.testing.assert_allclose(found.x, samples.x + turned, atol=1e-9)
    np.testing.assert_allclose(found.joints, samples.joints, atol=1e-12)


def test_random_samples_in_any_order_are_those_written(recorded, tmp_path):
    study, task, _, table = recorded
    samples = record_samples(study, task, "sobol", 8)
    values = np.hstack([samples.x, samples.joints])
    pd.DataFrame(values, columns=list(table))[::-1].to_csv(tmp_path / "arm.csv", index=False)
    found, said = read_samples(study, task, tmp_path / "arm.csv")
    assert said == []
    assert (found.label, found.n_samples) == ("measured8", 8)
    np.testing.assert_array_equal(found.x, samples.x[::-1])
    inputs = found.normalise(found.x)
    np.testing.assert_allclose((inputs.min(axis=0), inputs.max(axis=0)), ([0] * 3, [1] * 3))


@given(
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=9),
    st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", ","), (" ", ".")]),
)
def test_numbers_come_back_to_the_last_bit(tmp_path_factory, values, form):
    separator, point = form
    path = tmp_path_factory.getbasetemp() / "numbers.csv"
    rows = [f"{separator.join([repr(v).replace('.', point)] * 2)}\n" for v in values]
    # A number that shows which the commas are, since 1,234 alone may be thousands.
    path.write_text(f"a{separator}b\n{''.join(rows)}0{point}5{separator}0{point}5\n")
    found = read_table(path).numbers([0, 1])
    np.testing.assert_array_equal(found[:-1], np.array([values, values]).T)


def test_long_cells_and_names_take_no_time(tmp_path):
    (tmp_path / "s.csv").write_text(f"x_mm\n1\n{'9' * 20_000}x\n")
    began = time.process_time()
    with pytest.raises(IksamplesError, match="which is no plain number"):
        read_table(tmp_path / "s.csv").numbers([0])
    assert name_and_unit("x" + "(" * 20_000)[1] == ""
    assert time.process_time() - began < 2  # twelve seconds where each sign is tried again


def test_a_column_whose_name_is_no_text_is_refused(tmp_path):
    whole = io.BytesIO()
    parquet.write_table(pa.table({"x_mm": [1.0]}), whole, store_schema=False)
    (tmp_path / "s").write_bytes(whole.getvalue().replace(b"x_mm", b"x\xff\xffm"))
    with pytest.raises(IksamplesError, match="not a whole Parquet file"):
        read_table(tmp_path / "s")


def test_a_small_file_of_more_rows_than_memory_is_refused(tmp_path):
    zeros = pa.array(np.zeros(30_000_000, np.int8))
    parquet.write_table(pa.table({"x_mm": zeros}), tmp_path / "s")
    assert (tmp_path / "s").stat().st_size < 1_000_000
    with pytest.raises(IksamplesError, match="30000000 rows of 1 columns"):
        read_table(tmp_path / "s")
    (tmp_path / "s").write_text("x_mm\n1\n2\n3\n")
    with pytest.raises(IksamplesError, match="3 rows of 1 columns; no more than 2 rows"):
        read_table(tmp_path / "s", most_rows=2)
