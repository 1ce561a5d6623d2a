"""One set of samples: positions of the tool centre point and the joint values that reach them."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from iksamples import __version__
from iksamples.arm.chain import Floats
from iksamples.errors import IksamplesError


AXES = ("x", "y", "z")
_ROLES = ("sample", "validation", "test")


@dataclass(frozen=True, eq=False)
class SampleSet:
    """Samples of one size, with the fresh points that check the training.

    Attributes:
        label: Name of the set, such as ``grid5``.
        design: How the points are placed, such as ``grid``.
        points_per_axis: m; there are m^3 samples, less those masked.
        joint_names: One name per joint.
        positions_mm: The samples' positions [mm], shape (n, 3).
        joints: The samples' joint values [rad], shape (n, joints).
        validation_mm: Fresh positions for the validation loss [mm], shape (v, 3), may be empty.
        validation_joints: Their joint values [rad], shape (v, joints).
        test_mm: Fresh positions for the test loss [mm], shape (t, 3), may be empty.
        test_joints: Their joint values [rad], shape (t, joints).
        offset_mm: What the normalisation subtracts [mm], shape (3,).
        scale_mm: What the normalisation divides by [mm], shape (3,).
        spacing_mm: Distance d between neighbours of an even grid [mm]; NaN for other designs.
        fill_distance_mm: Largest distance from a point of the region to its nearest sample [mm].
        n_masked: Points left out because the arm cannot use them.
    """

    label: str
    design: str
    points_per_axis: int
    joint_names: tuple[str, ...]
    positions_mm: Floats
    joints: Floats
    validation_mm: Floats
    validation_joints: Floats
    test_mm: Floats
    test_joints: Floats
    offset_mm: Floats
    scale_mm: Floats
    spacing_mm: float
    fill_distance_mm: float
    n_masked: int

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.positions_mm)

    def normalise(self, positions_mm: ArrayLike) -> Floats:
        """Network inputs for positions [mm], shape (..., 3)."""
        return (np.asarray(positions_mm, float) - self.offset_mm) / self.scale_mm

    def digest(self) -> str:
        """Twelve hexadecimal digits of everything a training reads from the set."""
        content = hashlib.sha256()
        for array in (*self._parts("mm"), *self._parts("joints"), self.offset_mm, self.scale_mm):
            content.update(str(array.shape).encode())
            content.update(np.ascontiguousarray(array, float).tobytes())
        return content.hexdigest()[:12]

    def save(self, path: str | Path) -> None:
        """Writes a Parquet file: a row per point, the rest in the schema's metadata."""
        import pyarrow as pa
        from pyarrow import parquet

        positions = self._parts("mm")
        mm, joints = np.concatenate(positions), np.concatenate(self._parts("joints"))
        columns: dict[str, object] = {"role": np.repeat(_ROLES, [len(part) for part in positions])}
        columns |= {f"{axis}_mm": mm[:, i] for i, axis in enumerate(AXES)}
        columns |= {f"{axis}_input": self.normalise(mm)[:, i] for i, axis in enumerate(AXES)}
        columns |= {f"q_{name}_rad": joints[:, i] for i, name in enumerate(self.joint_names)}
        header = {
            "label": self.label,
            "design": self.design,
            "points_per_axis": self.points_per_axis,
            "joint_names": self.joint_names,
            "offset_mm": self.offset_mm.tolist(),
            "scale_mm": self.scale_mm.tolist(),
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
        import pyarrow as pa
        from pyarrow import parquet

        try:
            table = parquet.read_table(path)
            header = json.loads(table.schema.metadata[b"iksamples"])
        except (OSError, pa.ArrowInvalid, KeyError, TypeError) as error:
            raise IksamplesError(f"{path}: not a file of samples ({error}).") from None

        def take(role: str, names: list[str]) -> Floats:
            rows = table.filter(pa.compute.equal(table["role"], role))
            return np.stack([rows[name].to_numpy() for name in names], axis=-1)

        mm = [f"{axis}_mm" for axis in AXES]
        joints = [f"q_{name}_rad" for name in header["joint_names"]]
        samples, validation, test = ((take(role, mm), take(role, joints)) for role in _ROLES)
        return cls(
            header["label"],
            header["design"],
            header["points_per_axis"],
            tuple(header["joint_names"]),
            *samples,
            *validation,
            *test,
            np.array(header["offset_mm"]),
            np.array(header["scale_mm"]),
            header["spacing_mm"],
            header["fill_distance_mm"],
            header["n_masked"],
        )

    def _parts(self, what: str) -> tuple[Floats, Floats, Floats]:
        if what == "mm":
            return self.positions_mm, self.validation_mm, self.test_mm
        return self.joints, self.validation_joints, self.test_joints
