"""The page of a study of readings: which words of the paper must be wrong."""

from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from iksamples.paper.equations import paper_table
from iksamples.paper.options import QUESTIONS
from iksamples.paper.readings import DENIABLE, FRESH_SEED, rank, read_parts
from iksamples.report import figures, markdown
from iksamples.report.figures import lines
from iksamples.report.write import Pictures, page, save, text_environment
from iksamples.study import Study


if TYPE_CHECKING:
    from iksamples.report.figures import Drawing

_NEAREST, _LETTER, _PAPER = "the nearest reading", "to the letter", "the paper, Table 1"


def write_page(study: Study, results: str | Path, output: str | Path) -> None:
    """Writes ``index.html`` and ``README.md`` of a finished search.

    Args:
        study: The study, which has a section ``readings``.
        results: Its results folder: ``search/``, ``fresh/`` and ``readings.csv``.
        output: Folder of the report.
    """
    pictures = Pictures()
    template = text_environment().get_template("readings.md.j2")
    title = study.title or f"Study {study.name}"
    text = markdown.tidy(
        template.render(values(study, Path(results)), title=title, figure=pictures)
    )
    save(Path(output), text, page(title, markdown.to_html(text, pictures.inline())), pictures)


def values(study: Study, results: Path) -> dict[str, Any]:
    """Named values for the template."""
    assert study.readings is not None
    # Not whatever lies there: a run with other jobs may have left parts of another search.
    parts = [f"{part}.csv" for part in range(study.readings.jobs)]
    searched, fresh = (
        rank(read_parts([results / step / part for part in parts])) for step in ("search", "fresh")
    )
    everything = pd.concat([searched, fresh])
    fitting = everything[everything["within_twice"] == len(paper_table())]
    fits = fresh["within_twice"] == len(paper_table())
    by_count = searched.groupby("n_contradicted")["off_sd"]
    letter = fresh[fresh["n_contradicted"] == 0].iloc[0]
    return {
        "readings": study.readings,
        "first_seed": FRESH_SEED,
        "nearest": fresh.iloc[0].to_dict(),
        "letter": letter.to_dict(),
        "n_fresh": len(fresh),
        "n_fits": int(fits.sum()),
        "n_fits_letter": int((fits & (fresh["n_contradicted"] == 0)).sum()),
        "wrong": _wrong([set(text.split(", ")) for text in fitting["contradicts"]]),
        "words": _words(fresh),
        "rows": _rows(fresh.iloc[0], letter),
        "drawing": _drawing(fresh.iloc[0], letter),
        "ranked": _ranked(fresh),
        "counts": pd.DataFrame(
            {
                "Contradicted": by_count.size().index,
                "Readings": by_count.size(),
                "Nearest [±]": by_count.min(),
                "Median [±]": by_count.median(),
            }
        ),
        "options": pd.DataFrame(
            [
                {
                    "Question": question,
                    "Option": option.name,
                    "The paper": option.standing,
                    "Its words": f"“{option.words}”",
                    "Section": option.where,
                }
                for question, options in QUESTIONS.items()
                for option in options
            ]
        ),
    }


def _wrong(denied: list[set[str]]) -> pd.DataFrame:
    """The words, and the pairs of words, that no fitting reading keeps.

    Readings of the search count, too, though luck has helped them: a word is not to be blamed for
    want of a reading that was trained again.

    Args:
        denied: The questions that each fitting reading answers against the paper.
    """
    alone = [question for question in DENIABLE if all(question in words for words in denied)]
    rest = [question for question in DENIABLE if question not in alone]
    pairs = [pair for pair in combinations(rest, 2) if all(words & set(pair) for words in denied)]
    said = {q: f"“{_said(q)}”" for q in DENIABLE}
    return pd.DataFrame(
        {
            "Kept by none": [*alone, *(" with ".join(pair) for pair in pairs)],
            "The paper's words": [
                *(said[question] for question in alone),
                *(f"{said[one]} with {said[other]}" for one, other in pairs),
            ],
        }
    )


def _said(question: str) -> str:
    """The paper's words on a question."""
    return next(o.words for o in QUESTIONS[question] if o.standing != "contradicts")


def _words(fresh: pd.DataFrame) -> pd.DataFrame:
    """For each question that may contradict the paper: the nearest reading with and without."""
    rows = []
    for question in DENIABLE:
        broken = fresh["contradicts"].str.split(", ").map(lambda words, q=question: q in words)
        kept = fresh[~broken].iloc[0]
        rows.append(
            {
                "Question": question,
                "The paper's words": f"“{_said(question)}”",
                "Kept [±]": float(kept["off_sd"]),
                "Then contradicted": kept["contradicts"] or "nothing",
                "Not kept [±]": float(fresh.loc[broken, "off_sd"].min()),
            }
        )
    return pd.DataFrame(rows)


def _rows(nearest: "pd.Series[Any]", letter: "pd.Series[Any]") -> pd.DataFrame:
    """Table 1 beside two readings."""
    table = paper_table()

    def column(reading: "pd.Series[Any]") -> list[str]:
        return [
            markdown.plus_minus(reading[f"error_{n}_mm"], reading[f"sd_{n}_mm"])
            for n in table["n_samples"]
        ]

    printed = zip(table["paper_error_mm"], table["paper_error_sd_mm"], strict=True)
    return pd.DataFrame(
        {
            "Samples": table["n_samples"],
            "Paper [mm]": [markdown.plus_minus(*pair) for pair in printed],
            "Nearest reading [mm]": column(nearest),
            "To the letter [mm]": column(letter),
        }
    )


def _drawing(nearest: "pd.Series[Any]", letter: "pd.Series[Any]") -> "Drawing":
    table = paper_table()
    n, mean, spread = (
        table[name].to_numpy(float) for name in ("n_samples", "paper_error_mm", "paper_error_sd_mm")
    )
    frames = [pd.DataFrame({"line": _PAPER, "n": n, "mm": mean})]
    frames[0] = frames[0].assign(low=mean - spread, high=mean + spread)
    for name, reading in ((_NEAREST, nearest), (_LETTER, letter)):
        error = [reading[f"error_{int(size)}_mm"] for size in n]
        frames.append(
            pd.DataFrame({"line": name, "n": n, "mm": error, "low": error, "high": error})
        )
    looks = {
        _NEAREST: {"color": figures.NETWORK, "lw": 1.9},
        _LETTER: {"color": figures.COLOURS[0], "lw": 1.4},
        _PAPER: figures.PAPER_LINE,
    }
    return lines(
        pd.concat(frames), "n", "mm", looks, "number of samples", "mean position error [mm]"
    )


def _ranked(fresh: pd.DataFrame) -> pd.DataFrame:
    names = {"off_sd": "Off [±]", "log_ratio": "Log ratio", "within": "Within ±"}
    shown = fresh[["off_sd", "log_ratio", "within", "within_twice", "contradicts", *QUESTIONS]]
    shown = shown.rename(columns={**names, "within_twice": "Within 2 ±"})
    return shown.rename(columns=lambda name: name[:1].upper() + name[1:])
