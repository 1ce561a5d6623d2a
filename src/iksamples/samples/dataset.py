"""One set of samples: inputs of the task and the joint values that answer them."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from iksamples import __version__
from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError, in_a_line
from iksamples.files import checked, require_plain
from iksamples.region import Region
from iksamples.task import Space


_ROLES = ("sample", "validation", "test")
_DRAWING = -1
"""Seed of the rows that are as the drawing has them."""


@dataclass(frozen=True, eq=False)
class SampleSet:
    """Samples of one size, with the fresh points that check the training.

    Attributes:
        label: Name of the set, such as ``grid5``.
        design: How the points are placed, such as ``grid``.
        space: The inputs, with the workspace's limits.
        joint_space: The joints, with theirs.
        region: The usable part of the workspace, which the samples are of.
        x: The samples' inputs [mm or rad], shape (n, d).
        joints: Their joint values by the drawing [rad or mm], shape (n, joints).
        validation_x: Fresh inputs for the validation loss, shape (v, d), may be empty.
        validation_joints: Their joint values, shape (v, joints).
        test_x: Fresh inputs for the test loss, shape (t, d), may be empty.
        test_joints: Their joint values, shape (t, joints).
        offset: What the normalisation subtracts [mm or rad], shape (d,).
        scale: What the normalisation divides by [mm or rad], shape (d,).
        spacing_mm: Longest distance between neighbours of an even grid along a position axis [mm];
            NaN for other designs.
        fill_distance_mm: Largest distance from a point of the region to its nearest sample [mm];
            NaN where angles are among the inputs.
        n_masked: Points left out because the arm cannot use them.
        arms: The seed of each simulated arm that the samples are recorded on; empty: they are as
            the drawing has them.
        arm_joints: Joint values recorded on each, at the samples and then at the fresh points of
            validation and test [rad or mm], shape (arms, n + v + t, joints).
    """

    label: str
    design: str
    space: Space
    joint_space: Space
    region: Region
    x: Floats
    joints: Floats
    validation_x: Floats
    validation_joints: Floats
    test_x: Floats
    test_joints: Floats
    offset: Floats
    scale: Floats
    spacing_mm: float
    fill_distance_mm: float
    n_masked: int
    arms: tuple[int, ...] = ()
    arm_joints: Floats = field(default_factory=lambda: np.empty((0, 0, 0)))

    def of(self, seed: int) -> "SampleSet":
        """The samples as they are recorded on the arm of a seed.

        Raises:
            IksamplesError: They were recorded on other arms.
        """
        if not self.arms:
            return self
        ends = np.cumsum([len(part) for part in self._inputs()])
        joints, validation, test, _ = np.split(self.recorded([seed])[0], ends)
        return replace(
            self,
            joints=joints,
            validation_joints=validation,
            test_joints=test,
            arms=(),
            arm_joints=np.empty((0, 0, 0)),
        )

    def recorded(self, seeds: Sequence[int]) -> Floats:
        """What the arms of some seeds have recorded at all points, samples first.

        Returns:
            Joint values [rad or mm], shape (seeds, n + v + t, joints), or (1, ...) where the
            samples are as the drawing has them.

        Raises:
            IksamplesError: They were recorded on other arms.
        """
        if not self.arms:
            return np.concatenate(self._answers())[None]
        missing = sorted(set(seeds) - set(self.arms))
        if missing:
            raise IksamplesError(
                f"{self.label}: not recorded on the arm of seed {missing[0]}; record the samples "
                "again."
            )
        return self.arm_joints[[self.arms.index(seed) for seed in seeds]]

    @property
    def inputs(self) -> Floats:
        """The inputs at all points, samples first [mm or rad], shape (n + v + t, d)."""
        return np.concatenate(self._inputs())

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.x)

    @property
    def points_per_axis(self) -> int:
        """m of m^d samples, those masked included; the nearest where they are no such number."""
        return round((self.n_samples + self.n_masked) ** (1 / len(self.space)))

    @property
    def region_share(self) -> float:
        """The region's share of the workspace's volume."""
        return self.region.volume / float(np.prod(self.space.upper - self.space.lower))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """One name per joint."""
        return self.joint_space.names

    @property
    def output_scale(self) -> Floats:
        """What joint values are divided by before a network learns them, shape (joints,).

        One for an angle; for a length the power of two [mm] that is nearest to half of what the
        samples need of it, so that the loss weighs it like an angle of about a radian either way.
        A power of two, since a product with it is exact.
        """
        extent = np.ptp(self.joints, axis=0)
        power = np.exp2(np.round(np.log2(np.maximum(extent, 1e-6) / 2)))
        return np.where(self.joint_space.lengths, power, 1.0)

    def normalise(self, x: ArrayLike) -> Floats:
        """Network inputs for inputs of the task, shape (..., d)."""
        return (np.asarray(x, float) - self.offset) / self.scale

    def digest(self) -> str:
        """Twelve hexadecimal digits of everything a training reads from the set.

        Of several arms the first one's records stand for all, so that another arm changes nothing.
        """
        content = hashlib.sha256()
        first = (self.arm_joints[:1],) if self.arms else ()
        scales = (self.offset, self.scale, self.output_scale)
        for array in (*self._inputs(), *self._answers(), *scales, *first):
            content.update(str(array.shape).encode())
            content.update(np.ascontiguousarray(array, float).tobytes())
        content.update("".join(self.joint_space.units).encode())
        return content.hexdigest()[:12]

    def save(self, path: str | Path) -> None:
        """Writes a Parquet file: a row per point, the rest in the schema's metadata."""
        import pyarrow as pa
        from pyarrow import parquet

        # Point by point as the drawing has them, and then as each arm has recorded them.
        of_all = 1 + len(self.arms)
        x = np.tile(self.inputs, (of_all, 1))
        own = self.arm_joints.reshape(-1, len(self.joint_space))
        joints = np.concatenate([*self._answers(), own]) if self.arms else self.recorded([])[0]
        roles = np.repeat(_ROLES, [len(part) for part in self._inputs()])
        columns: dict[str, object] = {"role": np.tile(roles, of_all)}
        if self.arms:
            columns["seed"] = np.repeat([_DRAWING, *self.arms], len(roles))
        columns |= dict(zip(self.space.columns(), x.T, strict=True))
        normal = self.normalise(x).T
        columns |= {f"{name}_input": normal[i] for i, name in enumerate(self.space.names)}
        columns |= dict(zip(self.joint_space.columns("q_"), joints.T, strict=True))
        header = {
            "label": self.label,
            "design": self.design,
            "space": _to_json(self.space),
            "joint_space": _to_json(self.joint_space),
            "region": {
                "lower": self.region.lower.tolist(),
                "upper": self.region.upper.tolist(),
            },
            "offset": self.offset.tolist(),
            "scale": self.scale.tolist(),
            "spacing_mm": self.spacing_mm,
            "fill_distance_mm": self.fill_distance_mm,
            "n_masked": self.n_masked,
            "digest": self.digest(),
            "made_by": f"iksamples {__version__}",
        }
        table = pa.table(columns).replace_schema_metadata({"iksamples": json.dumps(header)})
        parquet.write_table(table, path)

    @classmethod
    def load(cls, path: str | Path) -> "SampleSet":
        """Reads what ``save`` wrote.

        Raises:
            IksamplesError: The file cannot be read or is not a set of samples.
        """
        from pyarrow import parquet

        path = checked(path)
        try:
            require_plain(path)
            table = parquet.read_table(path)
            header = json.loads(table.schema.metadata[b"iksamples"])
            found = cls._of(table, header)
            digest = found.digest()
        except FileNotFoundError:
            raise
        # Whatever a damaged file raises in pyarrow, in JSON and where its parts do not fit.
        except Exception as error:
            raise IksamplesError(f"{path}: not a file of samples ({in_a_line(error)}).") from None
        if digest != header.get("digest"):
            raise IksamplesError(
                f"{path}: not the samples that were written (by their digest). Record them again."
            )
        return found

    @classmethod
    def _of(cls, table: Any, header: dict[str, Any]) -> "SampleSet":
        """The set in a file's table and header."""
        import pyarrow as pa

        space, joint_space = (_from_json(header[key]) for key in ("space", "joint_space"))

        def take(role: str, names: list[str]) -> Floats:
            rows = table.filter(pa.compute.equal(table["role"], role))
            return np.stack([rows[name].to_numpy() for name in names], axis=-1)

        columns = space.columns(), joint_space.columns("q_")
        arms, arm_joints = (), np.empty((0, 0, 0))
        if "seed" in table.column_names:
            own = table["seed"].to_numpy()
            arms = tuple(dict.fromkeys(own[own != _DRAWING].tolist()))
            joints = np.stack([table[name].to_numpy() for name in columns[1]], axis=-1)
            arm_joints = joints[own != _DRAWING].reshape(len(arms), -1, len(joint_space))
            table = table.filter(pa.compute.equal(table["seed"], _DRAWING))
        samples, validation, test = (
            (take(role, columns[0]), take(role, columns[1])) for role in _ROLES
        )
        return cls(
            header["label"],
            header["design"],
            space,
            joint_space,
            Region(header["region"]["lower"], header["region"]["upper"]),
            *samples,
            *validation,
            *test,
            np.array(header["offset"]),
            np.array(header["scale"]),
            header["spacing_mm"],
            header["fill_distance_mm"],
            header["n_masked"],
            arms,
            arm_joints,
        )

    def _inputs(self) -> tuple[Floats, Floats, Floats]:
        return self.x, self.validation_x, self.test_x

    def _answers(self) -> tuple[Floats, Floats, Floats]:
        return self.joints, self.validation_joints, self.test_joints


def _to_json(space: Space) -> dict[str, object]:
    return {
        "names": space.names,
        "units": space.units,
        "lower": space.lower.tolist(),
        "upper": space.upper.tolist(),
    }


def _from_json(entry: dict[str, list]) -> Space:
    return Space(
        tuple(entry["names"]),
        tuple(entry["units"]),
        np.array(entry["lower"]),
        np.array(entry["upper"]),
    )
