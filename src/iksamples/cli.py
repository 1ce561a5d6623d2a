"""The command line: one command per step of the workflow, each usable by hand on files."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iksamples.errors import IksamplesError


if TYPE_CHECKING:
    from iksamples.robot.chain import SerialChain
    from iksamples.study import Study

app = typer.Typer(
    help="How many samples does a learned inverse kinematics need?\n\n"
    "The whole study runs with `snakemake --cores 2`; these are its steps, in their order.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)

StudyFile = Annotated[
    Path, typer.Argument(metavar="STUDY", help="Study file (YAML, or the study.json of a run).")
]
Output = Annotated[Path, typer.Option("--output", "-o", help="File to write.")]
Results = Annotated[
    Path,
    typer.Option(
        "--results", help="Results folder of the study, such as results/paper.", file_okay=False
    ),
]


@app.command()
def check(study_file: StudyFile) -> None:
    """Validate a study file, and say what the arm can reach of its workspace."""
    from iksamples.robot.workspace import reach
    from iksamples.samples.dataset import region_points
    from iksamples.samples.designs import full_grid

    study, chain = _open(study_file)
    _require_feasible(study, chain)
    box = study.workspace
    typer.echo(
        f"{study.name}: valid; digest {study.digest()}, joints {', '.join(chain.joint_names)}"
    )
    for m in study.samples.points_per_axis:
        summary = reach(study, chain, full_grid(box.lower_mm, box.upper_mm, m)).summary()
        typer.echo(f"  grid{m}: " + _in_words(summary))
    points = region_points(study, chain, study.evaluation.cube_points)
    typer.echo("  workspace: " + _in_words(reach(study, chain, points).summary()))
    networks = study.training.seeds * len(study.samples.points_per_axis)
    typer.echo(f"  {networks} networks to train, at most {study.training.epochs} epochs each")


@app.command()
def samples(
    study_file: StudyFile,
    points_per_axis: Annotated[
        int, typer.Option("--points-per-axis", "-m", min=2, help="m: the grid has m^3 points.")
    ],
    output: Output,
) -> None:
    """Record one grid of samples: positions and the joint angles that reach them."""
    from iksamples.samples.dataset import grid_samples

    study, chain = _open(study_file)
    # All of the study, not only this grid: whatever cannot be done is known before training.
    _require_feasible(study, chain)
    with _whole(output) as file:
        grid_samples(study, chain, points_per_axis).save(file)


@app.command()
def train(
    study_file: StudyFile,
    samples_files: Annotated[
        list[Path], typer.Argument(metavar="SAMPLES...", help="Sets of samples, one file per grid.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder that gets a folder for each grid.")
    ],
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder of trained seeds; a seed that is there is not trained again."),
    ] = None,
) -> None:
    """Train all seeds on each set of samples."""
    from iksamples.samples.dataset import SampleSet
    from iksamples.study import read_study
    from iksamples.training.run import train as train_all

    sets = [SampleSet.load(file) for file in samples_files]
    outputs = [output / samples.label for samples in sets]
    train_all(read_study(study_file), sets, outputs, cache, progress=True)


@app.command()
def evaluate(
    study_file: StudyFile,
    weights: Annotated[Path, typer.Option(help="Trained networks (weights.safetensors).")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for waypoints, cube and errors.")
    ],
) -> None:
    """Send trained networks along the paths and over the workspace; measure through the FK."""
    from iksamples.evaluation.errors import cube_errors, summarise, track_paths
    from iksamples.training.network import StackedMLP

    study, chain = _open(study_file)
    network = StackedMLP.load(weights)
    waypoints = track_paths(study, chain, network)
    cube = cube_errors(study, chain, network)
    tables = {"waypoints": waypoints, "cube": cube, "errors": summarise(waypoints, cube)}
    for name, table in tables.items():
        with _whole(output / f"{name}.parquet") as file:
            table.to_parquet(file)


@app.command()
def bounds(
    study_file: StudyFile,
    samples_file: Annotated[Path, typer.Option("--samples", help="What the networks learnt from.")],
    weights: Annotated[Path, typer.Option(help="Trained networks (weights.safetensors).")],
    cube: Annotated[Path, typer.Option(help="Errors over the workspace (cube.parquet).")],
    output: Output,
) -> None:
    """Compute the paper's bounds for trained networks, and how often each is exceeded."""
    import pandas as pd

    from iksamples.bounds.audit import audit
    from iksamples.samples.dataset import SampleSet
    from iksamples.training.network import StackedMLP

    study, chain = _open(study_file)
    table = audit(
        study, chain, SampleSet.load(samples_file), StackedMLP.load(weights), pd.read_parquet(cube)
    )
    with _whole(output) as file:
        table.to_parquet(file)


@app.command()
def table(study_file: StudyFile, results: Results, output: Output) -> None:
    """Aggregate over seeds: one row per grid, beside the paper's Table 1."""
    from iksamples.results import cells
    from iksamples.sizing.table import study_table
    from iksamples.study import read_study

    study = read_study(study_file)
    with _whole(output) as file:
        study_table(study, cells(study, results)).to_csv(file, index=False)


@app.command()
def record(
    study_file: StudyFile,
    path: Annotated[str, typer.Option(help="Which of the study's paths.")],
    results: Results,
    output: Output,
) -> None:
    """Record the arm drawing one path, all grids in one file for the Rerun viewer."""
    from iksamples.recording.record import record_path
    from iksamples.results import cells
    from iksamples.study import read_study

    study = read_study(study_file)
    with _whole(output) as file:
        record_path(study, path, cells(study, results), file)


@app.command()
def handbook(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write into.")] = Path(
        "config"
    ),
) -> None:
    """Write README.md and schema.json: every setting of a study file, every column of its table."""
    from iksamples.handbook import schema, settings_page

    for name, text in (("README.md", settings_page()), ("schema.json", schema())):
        with _whole(output / name) as file:
            file.write_text(text, encoding="utf-8")


def _open(study_file: Path) -> "tuple[Study, SerialChain]":
    from iksamples.robot.workspace import study_chain
    from iksamples.study import read_study

    study = read_study(study_file)
    return study, study_chain(study)


def _require_feasible(study: "Study", chain: "SerialChain") -> None:
    """Everything that can be known to fail before a sample is taken."""
    from iksamples.evaluation.paths import require_reachable
    from iksamples.samples.dataset import grid_samples, region_points

    for m in study.samples.points_per_axis:
        grid_samples(study, chain, m)
    region_points(study, chain, study.evaluation.cube_points)
    require_reachable(study, chain)


def _in_words(summary: dict[str, int]) -> str:
    rest = [
        f"{n} {kind.replace('_', ' ')}" for kind, n in summary.items() if n and kind != "points"
    ]
    return f"{summary['points']} points: " + ", ".join(rest)


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """Gives a temporary name beside a file, and the file's own name once all is written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".unfinished-{path.name}")
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def main() -> None:
    """Entry point: an error meant for people ends with its message alone."""
    try:
        app()
    except IksamplesError as error:
        for line in str(error).splitlines():
            typer.echo(f"Error: {line}", err=True)
        sys.exit(2)
