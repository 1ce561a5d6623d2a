"""Measures this project's training against other ways to do the same work.

    python benchmarks/training.py            # 15 to 25 minutes; writes docs/benchmarks.md
    python benchmarks/training.py --quick    # a minute or two, to see that it runs

Everything runs on one core, in this process, in turn: each round runs every way once, and ratios
are medians of the rounds' own ratios. Peers that are not installed are left out and named
(``pip install -e .[bench]`` brings them; the product does not need them).
"""

import argparse
import importlib.util
import os
import platform
import sys
import time
from dataclasses import dataclass
from pathlib import Path


ROOT = Path(__file__).parents[1]
UNITS = "µs per seed and optimiser step"


def _one_core(core: int | None) -> None:
    """Before anything that starts threads is imported."""
    if core is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {core})
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("CUDA_VISIBLE_DEVICES", "-1")
    flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ.setdefault("XLA_FLAGS", flags)


@dataclass
class Way:
    """A way to train: its function in ``peers``, what it needs, all seeds at once or not."""

    title: str
    function: str
    needs: str | None = None
    stacked: bool = True


WAYS = {
    "fused": Way("this project, fused engine", "fused"),
    "kernel": Way("... without Lightning around it", "kernel"),
    "reference": Way("this project, reference engine", "reference"),
    "floor": Way("hand-written C kernel (floor.c)", "floor_c"),
    "jax": Way("JAX, vmap + scan", "jax_vmap", "jax"),
    "sklearn": Way("scikit-learn MLPRegressor", "scikit_learn", "sklearn", False),
    "torch": Way("plain PyTorch loop", "torch_loop", "torch", False),
    "lightning": Way("Lightning, per seed", "lightning_per_seed", "pytorch_lightning", False),
    "keras": Way("Keras fit, per seed", "keras", "keras", False),
}

# First guess of the cost [µs per seed and step], to choose how many epochs are measured.
_GUESS = {
    **{"fused": 0.2, "kernel": 0.2, "reference": 10, "floor": 0.2, "jax": 4},
    **{"sklearn": 250, "torch": 350, "lightning": 1500, "keras": 4500},
}


def main() -> None:
    """Measures, checks and writes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a minute instead of ten")
    parser.add_argument("--core", type=int, default=0, help="the core to run on")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of the report")
    options = parser.parse_args()
    _one_core(options.core)
    os.chdir(ROOT)
    sys.path.insert(0, str(Path(__file__).parent))
    from report import write_report

    ways = [
        name
        for name, way in WAYS.items()
        if not way.needs or importlib.util.find_spec(way.needs) is not None
    ]
    bench = Bench(options.quick, ways)
    started = time.perf_counter()
    results = {
        "seeds": bench.over_seeds(),
        "grids": bench.over_grids(),
        "shapes": bench.over_shapes(),
        "study": bench.whole_study(),
        "errors": bench.same_errors(),
    }
    facts = bench.facts() | {
        "minutes": (time.perf_counter() - started) / 60,
        "missing": [WAYS[name].title for name in WAYS if name not in ways],
        "quick": options.quick,
    }
    path = write_report(options.out, {name: WAYS[name].title for name in ways}, results, facts)
    print(f"written: {path}")


class Bench:
    """The measurements."""

    def __init__(self, quick: bool, ways: list[str]) -> None:
        """Loads the arm of the paper's study."""
        import logging

        import peers
        import torch

        from iksamples.samples.record import region_points
        from iksamples.study import parse_study
        from iksamples.task import study_task

        logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
        torch.set_num_threads(1)
        self.peers, self.quick, self.ways = peers, quick, ways
        self.rounds = 2 if quick else 7
        self.study = parse_study({"name": "benchmark"})
        self.task = study_task(self.study)
        self.points = region_points(self.task.region, 1024)
        self._samples: dict[int, object] = {}

    def problem(self, m: int, seeds: int, hidden=(16,)):
        """The paper's problem for m points per axis."""
        from iksamples.samples.record import grid_samples
        from iksamples.training.problem import pose_problem

        if m not in self._samples:
            self._samples[m] = grid_samples(self.study, self.task, m)
        network = self.study.network.model_copy(update={"hidden": list(hidden)})
        study = self.study.model_copy(update={"network": network})
        return pose_problem(study, self._samples[m], range(seeds))

    def measure(self, cases: dict[tuple, tuple], label: str) -> dict[tuple, list[float]]:
        """Cost of each case [µs per seed and step] in every round.

        Args:
            cases: Key (its first entry is the way) -> problem, width factor of the first guess.
            label: For the line of progress.
        """
        plan = {}
        for key, (problem, factor) in cases.items():
            way = WAYS[key[0]]
            work = problem.n_seeds * problem.steps_per_epoch * _GUESS[key[0]] * factor * 1e-6
            aim = 0.15 if self.quick else 0.4 if way.stacked else 0.8
            epochs = int(min(500, max(3 if way.stacked else 2, aim / work)))
            if key[0] in ("fused", "kernel", "floor"):  # all of it: a fixed cost counts in full
                epochs = 500
            plan[key] = (getattr(self.peers, way.function), problem, epochs)
        costs: dict[tuple, list[float]] = {key: [] for key in cases}
        for key, (function, problem, epochs) in plan.items():
            print(f"  {label}: warming up {key}, {epochs} epochs", flush=True)
            function(problem, epochs)  # compiles, fills caches
        for index in range(self.rounds):
            print(f"  {label}: round {index + 1} of {self.rounds}", flush=True)
            for key, (function, problem, epochs) in plan.items():
                seconds, _ = function(problem, epochs)
                steps = epochs * problem.steps_per_epoch * problem.n_seeds
                costs[key].append(seconds / steps * 1e6)
        return costs

    def over_seeds(self):
        """Grid 5 (125 samples) with 1 to 1000 seeds."""
        counts = (1, 20, 100) if self.quick else (1, 10, 20, 100, 1000)
        cases = {}
        for name in self.ways:
            for count in counts if WAYS[name].stacked else (1,):
                # A stacked step costs much the same for few seeds.
                factor = max(1.0, 60 / count) if name == "reference" else 1.0
                cases[name, count] = self.problem(5, count), factor
        return self.measure(cases, "seeds")

    def over_grids(self):
        """Every grid with 20 seeds (peers that train a seed at a time: one seed, three grids)."""
        cases = {}
        for name in self.ways:
            stacked = WAYS[name].stacked
            grids = (2, 3, 4, 5, 6, 7, 8) if stacked and not self.quick else (2, 5, 8)
            for m in grids:
                factor = 4.0 if name == "reference" else 1.0
                cases[name, m] = self.problem(m, 20 if stacked else 1), factor
        return self.measure(cases, "grids")

    def over_shapes(self):
        """Grid 5 with 32 seeds and wider and deeper networks."""
        shapes = [(8,), (16,), (32,), (64,), (128,), (16, 16), (32, 32), (64, 64), (16, 16, 16)]
        shapes = shapes[1::3] if self.quick else shapes
        base = self.peers.flops_per_seed_step(self.problem(5, 1))
        cases = {}
        for name in ("fused", "reference", "jax"):
            for hidden in shapes if name in self.ways else ():
                problem = self.problem(5, 32, hidden)
                cases[name, hidden] = problem, self.peers.flops_per_seed_step(problem) / base
        return self.measure(cases, "shapes")

    def whole_study(self) -> dict[str, list[float]]:
        """Seconds for the paper's study (7 grids, 20 seeds, 500 epochs), every round."""
        problems = [self.problem(m, 20) for m in self.study.samples.points_per_axis]
        names = [name for name in ("fused", "kernel", "floor", "jax") if name in self.ways]
        names = [name for name in names if name != "jax" or not self.quick]
        seconds: dict[str, list[float]] = {name: [] for name in names}
        for index in range(self.rounds + 1):
            print(f"  study: round {index} of {self.rounds}", flush=True)
            for name in names:
                function = getattr(self.peers, WAYS[name].function)
                spent = sum(function(problem, 500)[0] for problem in problems)
                if index:  # the first round compiles
                    seconds[name].append(spent)
        return seconds

    def same_errors(self) -> dict[str, tuple[int, float, float]]:
        """Seeds, mean error over the workspace [mm] and its standard error, after 500 epochs."""
        import numpy as np

        errors = {}
        epochs = 500
        for name in self.ways:
            count = 100 if WAYS[name].stacked else 20 if name in ("sklearn", "torch") else 6
            count = min(count, 2 if self.quick and not WAYS[name].stacked else count)
            problem = self.problem(3, count)
            print(f"  errors: {name}, {count} seeds, {epochs} epochs", flush=True)
            _, parameters = getattr(self.peers, WAYS[name].function)(problem, epochs)
            found = self.peers.errors_mm(
                problem, self._samples[3], self.task.drawing, self.points, parameters
            )
            errors[name] = count, float(np.mean(found)), float(np.std(found, ddof=1) / count**0.5)
        return errors

    def facts(self) -> dict[str, object]:
        """The machine, the versions and the floor."""
        from importlib.metadata import PackageNotFoundError, version

        problem = self.problem(5, 1)
        versions = {"python": platform.python_version()}
        names = (
            "iksamples numpy numba torch pytorch-lightning jax keras tensorflow-cpu scikit-learn"
        )
        for name in names.split():
            try:
                versions[name] = version(name)
            except PackageNotFoundError:
                continue
        cpu = "unknown"
        if Path("/proc/cpuinfo").exists():
            lines = Path("/proc/cpuinfo").read_text().splitlines()
            cpu = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), cpu)
        return {
            "cpu": cpu,
            "cores": os.cpu_count(),
            "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
            "system": platform.platform(),
            "versions": versions,
            "peak": self.peers.peak_flops(),
            "flops": self.peers.flops_per_seed_step(problem),
            "rounds": self.rounds,
        }


if __name__ == "__main__":
    main()
