"""The view that MLflow's page opens on: error against the number of samples, a line per variant.

A named view is an experiment's tag, ``mlflow.sharedViewState.<key>`` (MLflow 3.15 and later); an
address with ``viewStateShareKey=<key>`` opens it.
"""

import json
from typing import Any
from urllib.parse import quote, urlencode

from iksamples.answer.collect import WORKSPACE
from iksamples.study import Study


_TAG = "mlflow.sharedViewState."
_SECTION = "against-n"
_NAME = "Error against the number of samples"


def view_tag(study: Study, owner: str, created_ms: int) -> tuple[str, str]:
    """Name and value of the tag that holds an owner's view.

    Args:
        study: The study, whose regions get a chart each.
        owner: Whose runs are shown.
        created_ms: When the experiment was made [ms since 1970].
    """
    regions = [*study.evaluation.paths, WORKSPACE]
    metrics = [f"{region}/error_mean_mm" for region in regions]
    metrics += [f"{WORKSPACE}/error_max_mm", f"{WORKSPACE}/sup_median_mm"]
    state = {
        "searchFilter": " and ".join(
            f"tags.`iksamples.{name}` = '{value}'"
            for name, value in (("owner", owner), ("current", "true"), ("kind", "variant"))
        ),
        "runsHiddenMode": "SHOW_ALL",
        "compareRunCharts": [_chart(metric) for metric in metrics],
        "compareRunSections": [{"uuid": _SECTION, "name": _NAME, "display": True, "columns": 2}],
        "isAccordionReordered": True,  # else MLflow puts its own sections by name
        "hideEmptyCharts": True,
    }
    value = {"name": _NAME, "createdAt": created_ms, "state": json.dumps(state)}
    return _TAG + _key(owner), json.dumps(value)


def page(experiment_id: str, owner: str) -> str:
    """The part of the address, after the server's, that opens the view."""
    query = {
        "workflowType": "machine_learning",  # else MLflow may open on its page of traces
        "compareRunsMode": "CHART",
        "viewStateShareKey": _key(owner),
    }
    return f"#/experiments/{experiment_id}/runs?{urlencode(query, quote_via=quote)}"


def _key(owner: str) -> str:
    return f"iksamples-{owner}"


def _chart(metric: str) -> dict[str, Any]:
    return {
        "type": "LINE",
        "uuid": metric,
        "metricSectionId": _SECTION,
        "metricKey": metric,
        "deleted": False,
        "isGenerated": False,
        "xAxisKey": "step",
        "useGlobalXaxisKey": False,
        "xAxisScaleType": "log",
        "scaleType": "log",
        "range": {},
        "displayPoints": True,
        "lineSmoothness": 0,
        "useGlobalLineSmoothing": False,
    }
