"""The command line: one command per step of the workflow, each usable by hand on files."""

import math
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iksamples.errors import IksamplesError


if TYPE_CHECKING:
    from iksamples.robot.chain import SerialChain
    from iksamples.samples.dataset import SampleSet
    from iksamples.study import Design, Study


class Strategy(StrEnum):
    """How the next poses are chosen."""

    DISAGREEMENT = "disagreement"
    WORST = "worst"


app = typer.Typer(
    help="How many samples does a learned inverse kinematics need?\n\n"
    "The whole study runs with `snakemake --cores 2`; these are its steps, in their order.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # which would take [mm] for markup
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


SamplesFiles = Annotated[
    list[Path], typer.Argument(metavar="SAMPLES...", help="Sets of samples, one file each.")
]
MethodName = Annotated[str, typer.Option(help="Which of the study's methods.")]
MethodFolder = Annotated[
    Path,
    typer.Option(
        "--folder", help="Folder of the method, with a folder for each set of samples in it."
    ),
]


@app.command()
def check(study_file: StudyFile) -> None:
    """Validate a study file, and say what the arm can reach of its workspace."""
    from iksamples.results import networks, sample_sets
    from iksamples.robot.workspace import reach
    from iksamples.samples.record import N_CORNERS, record_samples, region_points

    study, chain = _open(study_file)
    _require_feasible(study, chain)
    typer.echo(
        f"{study.name}: valid; digest {study.digest()}, joints {', '.join(chain.joint_names)}"
    )
    sets, all_recorded = sample_sets(study), []
    for label, (design, m) in sets.items():
        if design == "adaptive":
            typer.echo(f"  {label}: {m**3} samples, chosen in training")
            continue
        recorded = record_samples(study, chain, design, m)
        all_recorded.append(recorded)
        masked = f", {recorded.n_masked} left out" if recorded.n_masked else ""
        typer.echo(f"  {label}: {recorded.n_samples} samples{masked}")
    points = region_points(study, chain, study.evaluation.cube_points)
    left_out = study.evaluation.cube_points + N_CORNERS - len(points)
    masked = f"; {left_out} more left out" if left_out else ""
    typer.echo("  workspace: " + _in_words(reach(study, chain, points).summary()) + masked)
    typer.echo(
        f"  methods: {', '.join(study.all_methods)}; paths: {', '.join(study.evaluation.paths)}"
    )
    seeds = sum(study.all_methods[name].training.seeds for name in networks(study))
    trained = len(sets) * seeds
    typer.echo(f"  {trained} networks to train")
    _advise(study, all_recorded)


@app.command()
def plan(
    study_file: StudyFile,
    cores: Annotated[int, typer.Option(min=1, help="As for snakemake.")] = 2,
    results: Annotated[
        Path | None,
        typer.Option(help="Where trained seeds are looked for; by default results/<study>."),
    ] = None,
) -> None:
    """Say what a study would take: networks to train, time, memory. Nothing is run."""
    from iksamples.plan import plan_study, plan_text
    from iksamples.results import sample_sets
    from iksamples.samples.record import record_samples
    from iksamples.training.step import trained_before

    study, chain = _open(study_file)
    _require_feasible(study, chain)
    sets = [
        record_samples(study, chain, design, m)
        for design, m in sample_sets(study).values()
        if design != "adaptive"
    ]
    cache = (results or Path("results") / study.name) / "cache"
    cached = trained_before(study, sets, cache) if cache.is_dir() else {}
    typer.echo(plan_text(study, plan_study(study, cached), cores))
    _advise(study, sets)


@app.command()
def samples(
    study_file: StudyFile,
    name: Annotated[str, typer.Option(help="Which set of samples, such as grid5 or sobol125.")],
    output: Output,
) -> None:
    """Record one set of samples: positions and the joint angles that reach them."""
    from iksamples.results import sample_sets

    study, chain = _open(study_file)
    _require_feasible(study, chain)
    sets = sample_sets(study)
    _require_one_of(sets, name, f"{study_file}: no samples")
    with _whole(output) as file:
        _record(study, chain, *sets[name]).save(file)


@app.command()
def train(
    study_file: StudyFile,
    samples_files: SamplesFiles,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder that gets <method>/<samples>/.")
    ],
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder of trained seeds; a seed that is there is not trained again."),
    ] = None,
) -> None:
    """Train all seeds of every network of the study on each set of samples."""
    from iksamples.study import read_study
    from iksamples.training.step import train_study

    train_study(read_study(study_file), _load(samples_files), output, cache, progress=True)


@app.command()
def evaluate(
    study_file: StudyFile, samples_files: SamplesFiles, method: MethodName, folder: MethodFolder
) -> None:
    """Send a method along the paths and over the workspace; measure through the FK."""
    from iksamples.evaluation.step import evaluate as measure

    study, chain = _open(study_file)
    _require_one_of(study.all_methods, method, f"{study_file}: no method")
    for samples in _load(samples_files):
        cell = folder / samples.label
        tables, why_not = measure(study, chain, samples, method, cell)
        if why_not:
            typer.echo(why_not, err=True)
        for name, table in tables.items():
            with _whole(cell / f"{name}.parquet") as file:
                table.to_parquet(file)


@app.command()
def bounds(study_file: StudyFile, samples_files: SamplesFiles, folder: MethodFolder) -> None:
    """Compute the paper's bounds for trained networks, and how often each is exceeded."""
    import pandas as pd

    from iksamples.bounds.audit import audit
    from iksamples.training.network import StackedMLP

    study, chain = _open(study_file)
    for samples in _load(samples_files):
        cell = folder / samples.label
        network = StackedMLP.load(cell / "weights.safetensors")
        table = audit(study, chain, samples, network, pd.read_parquet(cell / "cube.parquet"))
        with _whole(cell / "bounds.parquet") as file:
            table.to_parquet(file)


@app.command()
def prove(
    study_file: StudyFile,
    samples_files: SamplesFiles,
    method: MethodName,
    folder: MethodFolder,
    output: Output,
) -> None:
    """Prove the worst and the mean error of a method over the workspace, network by network."""
    import pandas as pd

    from iksamples.bounds.certify_step import certify
    from iksamples.results import certified

    study, chain = _open(study_file)
    _require_one_of(certified(study), method, f"{study_file}: nothing can be proved of")
    rows = [
        certify(study, chain, method, samples, folder / samples.label)
        for samples in _load(samples_files)
    ]
    with _whole(output) as file:
        pd.concat(rows).to_csv(file, index=False)


@app.command("map")
def map_(study_file: StudyFile, results: Results) -> None:
    """Prove where the shown networks miss the tolerance, and their worst case along training."""
    from iksamples.bounds.map_step import map_cell
    from iksamples.results import cells

    study, chain = _open(study_file)
    for cell in cells(study, results):
        for name, rows in map_cell(study, chain, cell).items():
            with _whole(cell.folder / f"{name}.parquet") as file:
                rows.to_parquet(file)


@app.command()
def certify(
    weights: Annotated[
        Path,
        typer.Option(help="Networks: .safetensors, .pt (a state dict of Linear layers) or .onnx."),
    ],
    robot: Annotated[Path, typer.Option(help="URDF of the arm.")],
    box: Annotated[
        tuple[float, float, float, float, float, float],
        typer.Option(help="Workspace [mm]: lower x y z, upper x y z."),
    ],
    activation: Annotated[
        str | None, typer.Option(help="relu or tanh, where the file does not say.")
    ] = None,
    offset_mm: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="What the network's user subtracts from a position first [mm]."),
    ] = None,
    scale_mm: Annotated[
        tuple[float, float, float] | None, typer.Option(help="And then divides it by [mm].")
    ] = None,
    rtol: Annotated[float, typer.Option(min=1e-6, max=1, help="Gap of the bounds.")] = 1e-3,
) -> None:
    """Prove the largest position error of any networks over a box, and check the proof."""
    from iksamples.bounds.certificate.checker import verify
    from iksamples.bounds.certificate.external import load_network
    from iksamples.bounds.certificate.rounding import inference_slack_mm
    from iksamples.bounds.certificate.search import certify_stack
    from iksamples.robot.chain import load_urdf

    network = load_network(weights, activation=activation, offset_mm=offset_mm, scale_mm=scale_mm)
    chain = load_urdf(robot)
    region = box[:3], box[3:]
    slack_mm = inference_slack_mm(network, chain, *region)
    proofs = certify_stack(network, chain, *region, rtol=rtol, keep_leaves=True)
    for row, proof in enumerate(proofs):
        checked = verify(proof, network, row, chain).verified
        where = "({:.4g}, {:.4g}, {:.4g})".format(*proof.argmax_mm)
        typer.echo(
            f"seed {network.seeds[row]}: no position of the box is missed by more than "
            f"{_up(proof.upper_mm)} mm; at {where} mm it is missed by {proof.lower_mm:.4f} mm "
            f"({'checked' if checked else 'NOT CHECKED'}, {proof.boxes} boxes"
            f"{'' if proof.complete else ', search not finished'})"
        )
    if offset_mm is None and scale_mm is None and weights.suffix != ".safetensors":
        typer.echo("Positions go into the network as they are, in mm (no --offset-mm, --scale-mm).")
    typer.echo(
        "Proved for the stored weights read as exact real numbers, in real arithmetic, over the "
        f"closed box; evaluating a network in float32 adds at most {_up(float(slack_mm.max()))} mm."
    )


@app.command()
def table(study_file: StudyFile, results: Results) -> None:
    """Aggregate over seeds: table.csv beside the paper's Table 1, and all certificates in one."""
    import pandas as pd

    from iksamples.results import cells, certified
    from iksamples.sizing.table import study_table
    from iksamples.study import read_study

    study = read_study(study_file)
    proofs = pd.concat(
        [pd.read_csv(results / method / "certificates.csv") for method in certified(study)]
    )
    tables = {
        "certificates.csv": proofs,
        "table.csv": study_table(study, cells(study, results), proofs),
    }
    for name, rows in tables.items():
        with _whole(results / name) as file:
            rows.to_csv(file, index=False)


@app.command()
def answer(study_file: StudyFile, results: Results) -> None:
    """Answer how many samples each method needs: answer.json and samples-needed.csv."""
    from iksamples.sizing.finding import samples_needed
    from iksamples.sizing.outcomes import all_cells, certificates, outcomes
    from iksamples.sizing.size import answer_study
    from iksamples.study import read_study

    study = read_study(study_file)
    found = answer_study(study, results)
    rows = outcomes(study, all_cells(study, results), certificates(results))
    with _whole(results / "samples-needed.csv") as file:
        samples_needed(study, rows).to_csv(file, index=False)
    with _whole(results / "answer.json") as file:
        file.write_text(found.to_json(), encoding="utf-8")


@app.command()
def calibrate(study_file: StudyFile, results: Results, output: Output) -> None:
    """Train the answer's networks again with fresh seeds, and count how many meet the tolerance."""
    from iksamples.sizing.calibration import to_json
    from iksamples.sizing.fresh import calibrate_results

    study, chain = _open(study_file)
    if not study.calibration.seeds:
        raise IksamplesError(
            f"{study_file}: calibration.seeds is 0; say how many fresh trainings, 200 for example."
        )
    found = calibrate_results(study, chain, results, progress=True)
    with _whole(output) as file:
        file.write_text(to_json(found), encoding="utf-8")
    for one in found:
        typer.echo(f"{one.method}, {one.design}: {one.statement}")


@app.command()
def recommend(results: Results) -> None:
    """Print the answer of a finished study: how many samples, by which method, how sure."""
    from iksamples.sizing.answer import recommend as advise
    from iksamples.sizing.calibration import read_calibrations

    typer.echo(advise(results))
    for one in read_calibrations(results):
        typer.echo(f"\n{one.method}, {one.design}, with fresh seeds: {one.statement}")


@app.command("next")
def next_(
    study_file: StudyFile,
    samples_file: Annotated[
        Path,
        typer.Option(
            "--samples",
            help="Samples had so far (CSV or Parquet): x_mm, y_mm, z_mm and q_<joint>_rad.",
        ),
    ],
    output: Output,
    count: Annotated[int, typer.Option("--count", "-k", min=1, help="How many poses.")] = 10,
    strategy: Annotated[
        Strategy,
        typer.Option(help="Where trained seeds disagree most, or where they are worst."),
    ] = Strategy.DISAGREEMENT,
    weights: Annotated[
        Path | None, typer.Option(help="Networks trained on these samples; by default, train now.")
    ] = None,
) -> None:
    """Propose the next poses to record on the arm, inside its limits, as CSV.

    Beside each pose: how far apart the trained seeds send the arm there, and the largest error of
    a seed (disagreement_mm, error_mm), both by the arm's model.
    """
    from iksamples.samples.measured import read_samples
    from iksamples.sizing.next_poses import next_poses

    study, chain = _open(study_file)
    samples = read_samples(study, chain, samples_file)
    poses = next_poses(study, chain, samples, count, strategy.value, weights, progress=True)
    with _whole(output) as file:
        poses.round(4).to_csv(file, index=False)
    typer.echo(f"{len(poses)} poses written to {output}")


@app.command()
def track(
    study_file: StudyFile,
    results: Results,
    output: Annotated[Path, typer.Option("--output", "-o", help="What was logged (JSON).")],
) -> None:
    """Log the study, its grids and their seeds to MLflow; what is there already is kept."""
    from iksamples.results import cells
    from iksamples.study import read_study
    from iksamples.tracking.track import track as log_study

    study = read_study(study_file)
    with _whole(output) as file:
        log_study(study, cells(study, results), results / "table.csv", file)


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
    _require_one_of(study.evaluation.paths, path, f"{study_file}: no path")
    with _whole(output) as file:
        record_path(study, path, cells(study, results), file)


@app.command()
def report(
    study_file: StudyFile,
    results: Results,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the report.")],
    command: Annotated[
        str, typer.Option(help="What the report says to type to run the study.")
    ] = "snakemake --cores 2",
) -> None:
    """Build the report: one page that opens offline, a Markdown twin, and the front page of all."""
    from iksamples.report.front import write_front_page
    from iksamples.report.write import write_report
    from iksamples.study import read_study

    write_report(read_study(study_file), results, output, command)
    write_front_page(output.parent, results.parent)


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


def _record(study: "Study", chain: "SerialChain", design: "Design", m: int) -> "SampleSet":
    """Samples of a design; the adaptive one trains networks to choose them."""
    if design == "adaptive":
        from iksamples.sizing.adaptive import adaptive_sets

        return adaptive_sets(study, chain, [m])[m]
    from iksamples.samples.record import record_samples

    return record_samples(study, chain, design, m)


def _load(files: list[Path]) -> "list[SampleSet]":
    from iksamples.samples.dataset import SampleSet

    return [SampleSet.load(file) for file in files]


def _open(study_file: Path) -> "tuple[Study, SerialChain]":
    from iksamples.robot.workspace import study_chain
    from iksamples.study import read_study

    study = read_study(study_file)
    return study, study_chain(study)


def _advise(study: "Study", sets: "list[SampleSet]") -> None:
    from iksamples.advice import advice

    for line in advice(study, sets):
        typer.echo(f"Note: {line}", err=True)


def _require_one_of(known: Iterable[str], name: str, what: str) -> None:
    if name not in known:
        raise IksamplesError(f"{what} '{name}'; there are {', '.join(known)}.")


def _require_feasible(study: "Study", chain: "SerialChain") -> None:
    """What a job for one set of samples cannot see of the rest, before anything is trained."""
    from iksamples.evaluation.paths import require_reachable
    from iksamples.samples.record import require_workspace

    require_workspace(study, chain)
    require_reachable(study, chain)


def _up(bound_mm: float) -> str:
    """An upper bound in four decimals, rounded up."""
    return f"{math.ceil(bound_mm * 1e4) / 1e4:.4f}"


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
    except FileNotFoundError as error:
        typer.echo(
            f"Error: {error.filename or error}: there is no such file. Either the name is wrong, "
            "or the study is not finished: run it to its end first.",
            err=True,
        )
        sys.exit(2)
    except IksamplesError as error:
        for line in str(error).splitlines():
            typer.echo(f"Error: {line}", err=True)
        sys.exit(2)
