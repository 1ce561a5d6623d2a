"""Files that appear whole or not at all, and are known again when they are read."""

import hashlib
import signal
import stat
import subprocess
import sys

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

from iksamples.columns import stored_table
from iksamples.errors import IksamplesError, UnwritableError
from iksamples.files import (
    checked,
    digest_file,
    is_intact,
    kept_file,
    put_aside,
    stored_object,
    whole_file,
    write_digest,
)


@pytest.mark.parametrize("writer", [whole_file, kept_file])
def test_a_file_appears_whole_or_not_at_all(tmp_path, writer):
    path = tmp_path / "deep" / "table.csv"
    with writer(path) as file:
        assert file.suffix == ".csv"
        file.write_text("old")
        assert not path.exists()

    def stopped():
        with writer(path) as file:
            file.write_text("half of the ne")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        stopped()
    assert checked(path).read_text() == "old"
    assert not list(path.parent.glob(".unfinished*"))
    with writer(path) as file:
        file.write_text("new")
        file.chmod(0o600)
    assert checked(path).read_text() == "new"
    assert stat.S_IMODE(path.stat().st_mode) & 0o044


def test_the_digest_is_what_sha256sum_says(tmp_path):
    with kept_file(tmp_path / "a.bin") as file:
        file.write_bytes(bytes(range(256)) * 9999)
    kept = digest_file(tmp_path / "a.bin").read_text().strip()
    done = subprocess.run(["sha256sum", tmp_path / "a.bin"], capture_output=True, text=True)
    assert done.stdout.split()[0] == kept == hashlib.sha256(bytes(range(256)) * 9999).hexdigest()


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-1], lambda b: b"", lambda b: b[:7] + b"!" + b[8:], lambda b: b + b" "]
)
def test_a_damaged_file_is_not_read_and_out_of_the_way(tmp_path, damage):
    path = tmp_path / "table.csv"
    with kept_file(path) as file:
        file.write_bytes(b"a,b\n1,2\n3,4\n")
    assert is_intact(path)
    path.write_bytes(damage(path.read_bytes()))
    assert not is_intact(path)
    with pytest.raises(IksamplesError, match=r"table.csv.damaged. Run the study again") as caught:
        checked(path)
    assert "\n" not in str(caught.value)
    assert not path.exists()
    assert (tmp_path / "table.csv.damaged").exists()
    with kept_file(path) as file:
        file.write_bytes(b"new")
    assert checked(path) == path


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: (folder / "a.png").write_bytes(b"other"),
        lambda folder: (folder / "a.png").unlink(),
        lambda folder: (folder / "a.png").rename(folder / "c.png"),
        lambda folder: (folder / "c.png").write_bytes(b""),
    ],
)
def test_a_damaged_folder_is_out_of_the_way(tmp_path, damage):
    def make():
        draft, folder = tmp_path / "draft", tmp_path / "figures"
        draft.mkdir()
        (draft / "a.png").write_bytes(b"a")
        (draft / "b.png").write_bytes(b"b")
        write_digest(draft, folder)
        draft.rename(folder)
        (folder / ".snakemake_timestamp").touch()
        return folder

    for _ in range(2):  # a second time, beside what the first left
        folder = make()
        assert put_aside(folder) is None
        damage(folder)
        assert put_aside(folder) == tmp_path / "figures.damaged"
        assert sorted(tmp_path.iterdir()) == [tmp_path / "figures.damaged"]


def test_a_file_that_was_brought_along_is_taken_as_it_is(tmp_path):
    path = tmp_path / "brought.csv"
    path.write_text("1")
    assert checked(path) == path
    assert not is_intact(path)
    assert checked(tmp_path / "absent") == tmp_path / "absent"
    assert not is_intact(tmp_path / "absent")


WRITERS = {
    "weights": "write_tensors(path, {'a': np.ones(9999)}, {})",
    "cache": "record.save(path)",
    "table": "pd.DataFrame({'a': range(9999)}).to_parquet(path)",
}
STOPPED = """
import resource, signal, sys
from pathlib import Path
import numpy as np
import pandas as pd
from iksamples.network import write_tensors
from iksamples.training.record import Record

path = Path(sys.argv[1])
record = Record(**{name: np.ones((3, 999)) for name in Record.__dataclass_fields__})
signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # as a kill, in the middle of the first write
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
"""


@pytest.mark.parametrize("writer", WRITERS)
def test_what_a_stopped_writer_leaves_is_written_over_by_the_next(tmp_path, writer):
    """It writes to no other name, which nobody would remove."""
    command = [sys.executable, "-c", STOPPED + WRITERS[writer], tmp_path / ".unfinished-file"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == -signal.SIGXFSZ, done.stderr
    assert [file.name for file in tmp_path.iterdir()] == [".unfinished-file"]


def test_a_message_fits_the_screen_and_steers_no_terminal():
    shown = str(IksamplesError("a\x1b[2J\0\u202e\ud800\r\u2028é\nb" + "x" * 9000))
    first, second = shown.split("\n")
    assert first == "a [2J é"
    assert second.startswith("bxxx")
    assert len(second) < 1100


@pytest.mark.parametrize(
    ("said", "about"),
    [
        ({"failed": [None, ""]}, "column failed"),
        ({"failed": [1.0, 2.0]}, "column failed"),
        ({"verified": [0.0, 1.0]}, "column verified"),
        ({"seed": [0.5, 1.0]}, "column seed"),
        ({"error_mm": ["1", "2"]}, "column error_mm"),
        ({"error_mm": np.ones(2, np.float16)}, "column error_mm"),
        ({"seed": [3, 3]}, "two rows of one seed"),
    ],
)
def test_columns_hold_what_their_names_say(tmp_path, said, about):
    columns = {"seed": [0, 1], "error_mm": [1.0, np.nan], "failed": "", "verified": True}
    pd.DataFrame(columns).to_parquet(tmp_path / "t.parquet")
    assert len(stored_table(tmp_path / "t.parquet", ("error_mm",), ("seed",))) == 2
    pd.DataFrame(columns | said).to_parquet(tmp_path / "t.parquet")
    with pytest.raises(IksamplesError, match=rf"t\.parquet: not as it was written .{about}"):
        stored_table(tmp_path / "t.parquet", key=("seed",))


def test_words_that_are_no_utf8_are_not_read(tmp_path):
    parquet.write_table(pa.table({"label": pa.array([b"a\xff"]).view(pa.string())}), tmp_path / "t")
    with pytest.raises(IksamplesError, match=r"cannot be read .*UTF8"):
        stored_table(tmp_path / "t")


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"head": 1}', "[" * 99_999])
def test_an_object_of_results_is_one(tmp_path, text):
    (tmp_path / "t.json").write_text('{"head": "a"}')
    assert stored_object(tmp_path / "t.json", {"head": str}) == {"head": "a"}
    (tmp_path / "t.json").write_text(text)
    with pytest.raises(IksamplesError, match=r"t\.json: .*Run the study again"):
        stored_object(tmp_path / "t.json", {"head": str})


ON_A_FULL_DISK = {
    "text": "file.write_text('0' * 9999)",
    "parquet": "import pandas as pd; pd.DataFrame({'a': range(9999)}).to_parquet(file)",
    "picture": "from matplotlib.figure import Figure; Figure().savefig(file, format='png')",
}
FULL = """
import resource, sys
from pathlib import Path
import numpy as np
from iksamples import cli
from iksamples.files import kept_file
{imports}
def app():
    resource.setrlimit(resource.RLIMIT_FSIZE, (900, 900))
    with kept_file(Path(sys.argv[1]) / "result") as file:
        {write}
cli.app = app
cli.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("writer", ON_A_FULL_DISK)
def test_a_disk_that_takes_no_more_is_said_in_a_line_whoever_writes(tmp_path, writer):
    *imports, write = ON_A_FULL_DISK[writer].split("; ", 1)
    code = FULL.format(imports="\n".join(imports), write=write)
    run = [sys.executable, "-P", "-c", code, str(tmp_path)]
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    said = [line for line in done.stderr.splitlines() if "Error" in line or "Traceback" in line]
    assert said[-1].startswith(f"Error: cannot write {tmp_path / 'result'}: ")
    assert "Make room" in said[-1]
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_folder_that_takes_no_files_is_named():
    with pytest.raises(UnwritableError, match="/proc/no"), kept_file("/proc/no/table.csv") as file:
        file.write_text("never")


def test_what_cannot_be_read_is_not_said_to_be_unwritable(tmp_path):
    """Though it lies beside what is written."""
    with pytest.raises(FileNotFoundError), kept_file(tmp_path / "table.csv") as file:
        file.write_bytes((tmp_path / "runs.csv").read_bytes())
    assert not list(tmp_path.iterdir())
