"""Recordings mutated at random: refused in a line, or read right, or what is odd is named."""

import numpy as np
import pandas as pd
import pytest
from measured_arms import NAMES, recorded

from iksamples.errors import IksamplesError
from iksamples.recorded.doubts import checked
from iksamples.recorded.read import read_recording


DEG = 180 / np.pi
LENGTHS = {"mm": 1.0, "cm": 0.1, "m": 1e-3}
ANGLES = {"rad": 1.0, "deg": DEG}
SEEN_MM = 15.0
"""A wrong position that is no farther off than this may pass for one of an arm off its drawing."""


class Mutant:
    """A recording on its way to a file, and what its records really are."""

    def __init__(self, table, rng):
        self.rng, self.table = rng, table.copy()
        self.table.insert(0, "id", np.arange(len(table)))
        self.encoding = {"sep": ","}
        self.bytes = None

    def pick(self, options):
        return options[self.rng.integers(len(options))]

    def some_rows(self):
        n = len(self.table)
        return self.rng.choice(n, min(n, int(self.rng.integers(1, 12))), replace=False)

    def measured(self):
        return [name for name in self.table.columns if name.startswith(("x", "y", "z", "q"))]

    def other_units(self):
        """Rightly: another unit in the name, and the values with it."""
        for name in self.measured():
            base, _, unit = name.rpartition("_")
            units = LENGTHS if unit in LENGTHS else ANGLES
            if unit in units and self.table[name].dtype == float and self.rng.random() < 0.5:
                other = self.pick(list(units))
                self.table[name] = self.table[name] * (units[other] / units[unit])
                self.table = self.table.rename(columns={name: f"{base}_{other}"})

    def wrong_units(self):
        """A name that says another unit than the values have."""
        name = self.pick(self.measured() or ["x"])
        base, _, unit = name.rpartition("_")
        units = LENGTHS if unit in LENGTHS else ANGLES
        self.table = self.table.rename(columns={name: f"{base}_{self.pick(list(units))}"})

    def no_unit(self):
        name = self.pick(self.measured() or ["x"])
        self.table = self.table.rename(columns={name: name.rpartition("_")[0] or name})

    def rows_in_other_units(self):
        kind = self.pick(["x", "q"])
        names = [one for one in self.measured() if (one[0] == "q") == (kind == "q")]
        factor = self.pick([10, 100, 1e3, 0.1, 0.01, 1e-3] if kind == "x" else [DEG, 1 / DEG])
        rows = self.some_rows()
        self.table[names] = self.table[names].astype(object)
        for name in names:
            at = self.table.columns.get_loc(name)
            for row in rows:
                value = self.table.iat[row, at]
                self.table.iat[row, at] = value * factor if isinstance(value, float) else value

    def odd_cell(self):
        name = self.pick(list(self.table.columns))
        self.table[name] = self.table[name].astype(object)
        odd = [None, np.nan, np.inf, "", "-", "NaN", "1,5", "1e400", "#REF!", "0x1F", 1e9, True]
        self.table.iat[int(self.pick(self.some_rows())), self.table.columns.get_loc(name)] = (
            self.pick(odd)
        )

    def outliers(self):
        name = self.pick(self.measured() or ["id"])
        at = self.table.columns.get_loc(name)
        self.table[name] = self.table[name].astype(object)
        self.table.iat[int(self.some_rows()[0]), at] = float(self.rng.normal() * 300)

    def rows_again(self):
        self.table = pd.concat([self.table, self.table.iloc[self.some_rows()]])

    def no_column(self):
        self.table = self.table.drop(columns=self.pick(list(self.table.columns)))

    def column_twice(self):
        name = self.pick(list(self.table.columns))
        self.table.insert(0, name, self.table[name], allow_duplicates=True)

    def another_order(self):
        self.table = self.table.iloc[self.rng.permutation(len(self.table))]
        self.table = self.table[self.rng.permutation(self.table.columns)]

    def few_rows(self):
        self.table = self.table.head(int(self.rng.integers(0, 12)))

    def swapped_names(self):
        names = list(self.table.columns)
        i, j = self.rng.integers(len(names), size=2)
        names[i], names[j] = names[j], names[i]
        self.table.columns = names

    def another_text(self):
        self.encoding = self.pick(
            [{"sep": ";"}, {"sep": "\t"}, {"sep": ";", "decimal": ","}, {"sep": ",", "quoting": 1}]
        )

    def broken_file(self):
        raw = self.text()
        cut, at = int(self.rng.integers(len(raw) + 1)), int(self.rng.integers(len(raw)))
        flipped = raw[:at] + bytes([int(self.rng.integers(256))]) + raw[at + 1 :]
        self.bytes = self.pick([raw[:cut], flipped, b"PAR1" + raw[:50], b"\x1f\x8b" + raw[:50]])

    def text(self):
        return self.table.to_csv(index=False, **self.encoding).encode()


WAYS = [name for name, one in vars(Mutant).items() if callable(one)][2:-1]
WAYS = [name for name in WAYS if name not in ("some_rows", "measured", "text", "pick")]


def mutated(table, seed):
    rng = np.random.default_rng(seed)
    mutant = Mutant(table, rng)
    done = []
    for _ in range(rng.integers(1, 4)):
        done.append(mutant.pick(WAYS))
        if mutant.bytes is None and mutant.table.size and mutant.table.columns.is_unique:
            getattr(mutant, done[-1])()
    return mutant.bytes or mutant.text(), done


def wrong(table, found):
    """Records whose numbers are not those of their row, by far."""
    names = [name.strip().lower() for name in found.table.names]
    if "id" not in names:
        return []
    ids = np.array([int(float(row[names.index("id")])) for row in found.table.rows])
    right = table.iloc[ids]
    off = np.linalg.norm(found.position_mm - right[NAMES[:3]].to_numpy(), axis=1)
    own = [f"q_{name}_rad" for name in found.joint_names]
    turned = np.abs(found.joints - right[own].to_numpy()).max(axis=1)
    return np.flatnonzero((off > SEEN_MM) | (turned > 0.3))


@pytest.mark.slow
@pytest.mark.parametrize("drawn", [True, False])
def test_no_mutant_is_misread_in_silence(tmp_path, drawn):
    drawing, _, table = recorded()
    known = drawing if drawn else None
    read, messages = 0, []
    for seed in range(1000):
        content, done = mutated(table, [seed, drawn])
        path = tmp_path / "arm.csv"
        path.write_bytes(content)
        try:
            found, lines = checked(read_recording(path, known), known)
        except IksamplesError as error:
            messages.append(str(error))
            continue
        read += 1
        try:
            bad = wrong(table, found)
        except (ValueError, IndexError, OverflowError, KeyError):
            continue  # the mutation spoilt the id
        if "swapped_names" in done and not drawn:
            continue  # nobody can tell
        assert not len(bad) or lines, (seed, done, [found.table.place(int(i)) for i in bad])
    assert min(read, len(messages)) > 200
    assert all(one.startswith(str(path)) and one.count("\n") <= 1 for one in messages)
